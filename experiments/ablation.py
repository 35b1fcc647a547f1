"""Claim: every part of the network saves edge checks.

    python -m experiments.ablation

Networks that lack one part are trained on the same roadmaps, for as many steps and from the same
seed, and plan the Kuka's 300 test problems on the same roadmaps: one each, no second try. Parts are
taken out of the default network and of the paper's architecture, which learns here as the default
one does (from all nodes, soft labels, AdamW); the preset `paper` also learns as the paper's. It
takes a step a roadmap and so sees as many roadmaps, in more steps. With fewer training problems
there are more epochs, not fewer steps.

The budget is small, an eighth of the default's epochs on a third of its roadmaps: what is compared
are networks early in their training, one training each. Intervals are over problems and do not hold
how much a network changes from one seed of its training to the next.
"""

import functools
import itertools
from collections.abc import Iterator

from matplotlib.figure import Figure

from experiments.cases import first_roadmap_case
from experiments.measure import difference, measure, problem_set
from experiments.record import Experiment, Finding, Measurement, judge, main
from experiments.results import Row
from experiments.style import draw_lines
from experiments.tables import DETAIL, both, interval, listing, markdown
from experiments.training import command, trained
from experiments.variants import (
    AblationConfig,
    full_network,
    num_weights,
    training,
    training_set,
    variants,
)
from gnnjax.evaluate import EvaluateConfig
from gnnjax.training.weights import read_metadata

_WITHOUT_NETWORK = {"distance to the goal": "distance", "exact cost-to-go": "oracle"}


def measurement(config: AblationConfig) -> Measurement:
    """Rows of networks, and of planners that have none."""
    return Measurement(_rows(config))


def _rows(config: AblationConfig) -> Iterator[Row]:
    robot = config.robot or "kuka_iiwa14"
    path = problem_set(config, robot, num_problems=config.num_problems)
    cases: dict[str, EvaluateConfig] = {}
    case = functools.partial(
        first_roadmap_case,
        path,
        robot,
        num_nodes=config.num_nodes,
        num_problems=config.num_problems,
    )
    chosen, others = variants(config), dict(_WITHOUT_NETWORK)
    if config.quick:  # compiling all of them takes minutes
        chosen = dict(itertools.islice(chosen.items(), 2))
        del others["exact cost-to-go"]
    data = training_set(config, robot, config.num_roadmaps, config.num_nodes)
    for name, changes in chosen.items():
        made = training(config, name, data, robot, changes)
        weights = trained(made)
        cases[name] = case("gnn", weights=weights)
        yield {
            "variant": name,
            "training": command(made),
            "last_epoch": read_metadata(weights)["training"]["log"][-1],
            "num_weights": num_weights(weights),
            **measure(config, cases[name]),
            "difference": difference(config, cases[name], cases[full_network(name)]),
        }
    for name, planner in others.items():
        yield {
            "variant": f"no network, {name}",
            **measure(config, case(planner)),
            "difference": difference(config, case(planner), cases["default"]),
        }


PANELS = (
    ("edge_checks", "edge checks", 1.0, True),
    ("success", "solved on the first roadmap [%]", 100.0, False),
    ("cost", "path cost [rad]", 1.0, True),
)


def draw(results: Row) -> Figure:
    """Draws means with 95 % intervals, a line a variant."""
    rows = results["rows"]
    figure = Figure(figsize=(12, 1.6 + 0.28 * len(rows)), dpi=110, layout="constrained")
    draw_lines(figure, rows, [_line_name(row) for row in rows], PANELS)
    figure.suptitle(
        "Means with 95 % intervals; *: edge checks differ from those of the full network"
    )
    return figure


def _line_name(row: Row) -> str:
    """The variant, with a star where its edge checks differ from the full network's."""
    difference = row["difference"]["edge_checks"]
    differs = difference is not None and not difference["low"] <= 0.0 <= difference["high"]
    return row["variant"] + " *" * differs


def table(results: Row) -> str:
    """What each variant of the network does, one roadmap, no second try."""
    lines = [
        [row["variant"]] + [both(row, write) for _, write in DETAIL] for row in results["rows"]
    ]
    return markdown(["variant", *[title for title, _ in DETAIL]], lines)


def verdict(results: Row) -> str:
    """Whether every network that lacks a part needs more edge checks than the whole one, by
    intervals of the difference on the same problems."""
    rows = {row["variant"]: row for row in results["rows"]}

    def checked(network: str) -> Finding:
        begin = f"{network} without "
        parts = {
            name.removeprefix(begin): row["difference"]["edge_checks"]
            for name, row in rows.items()
            if name.startswith(begin)
        }
        idle = [part for part, more in parts.items() if not more or more["low"] <= 0]
        saved = {part: more for part, more in parts.items() if part not in idle}
        words = [f"{part} save {interval(more, '.1f')}" for part, more in saved.items()]
        words += [f"{listing(idle)} none that is measurable"] * bool(idle)
        text = f"{network}: of edge checks a problem, {listing(words)}"
        return Finding(len(saved) == len(parts), text)

    networks = list(dict.fromkeys(full_network(v) for v in rows if " without " in v))
    trained_otherwise = rows.get("paper's network and training")
    beside = []
    if trained_otherwise:
        part = trained_otherwise["summary"]["all"]
        beside = [
            f"The preset `paper`, on this budget, solves {100 * part['success']['mean']:.1f} % "
            f"with {part['edge_checks']['mean']:.1f} edge checks."
        ]
    return judge(*map(checked, networks), beside=beside)


EXPERIMENT = Experiment(
    name="ablation",
    title="Parts of the guidance network",
    claim="Every part of the network saves edge checks.",
    config=AblationConfig,
    quick={"num_roadmaps": 10, "epochs": 2, "num_nodes": 30, "num_problems": 3},
    measure=measurement,
    draw=draw,
    table=table,
    verdict=verdict,
)

if __name__ == "__main__":
    main(EXPERIMENT)
