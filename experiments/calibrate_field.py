"""Claim: the field guide's calibration, picked by hand, needs no more checks than a fitted one.

    python -m experiments.calibrate_field

The price of a motion is softplus((offset - margin) / scale), the negative logarithm of a logistic
probability, so that offset and scale are fitted by logistic regression on labelled edges: those of
a stored roadmap between free nodes, in scenes half of which are the paper's and half of all
families, drawn for training. What is told of fits is on other scenes, and edges of another roadmap.

Cells along the field's longest side, and places along a motion, are varied: area under the ROC
curve beside look-ups (places times spheres) and time an edge, the reading of a lone scene shared
out over its edges. Then pairs and resolutions plan problems drawn for validation, in turn; checks
are said to be dear, or exact shortcuts, which ask no guide, would be most of what is counted.
"""

import dataclasses
import functools
import itertools
import json
from collections.abc import Iterator, Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

from experiments.cases import DEAR
from experiments.field_fits import Margins, clocks, edge_margins, fit, log_loss_of, num_pieces
from experiments.guide_edges import stored_edges
from experiments.in_turn import plan_in_turn
from experiments.measure import ExperimentConfig
from experiments.record import Experiment, Finding, Measurement, judge, main
from experiments.results import Row
from experiments.statistics import ratio_of_means, summarize_seeds
from experiments.style import make_logarithmic
from experiments.tables import cell, interval, markdown
from experiments.turns import folder_of, kept
from gnnjax.arm.robot import Robot, load_robot
from gnnjax.guide.field import CALIBRATION, CELLS, SPACING, field_guide
from gnnjax.planning.load import own_planner
from gnnjax.planning.options import make_options
from gnnjax.planning.planner import Planner
from gnnjax.problems.labelled import generate_labelled, problem_keys
from gnnjax.problems.problem import Problem
from gnnjax.train_motion import area_under_curve
from gnnjax.training.motions import scene_sampler


@dataclasses.dataclass(frozen=True)
class CalibrateFieldConfig(ExperimentConfig):
    """Fits the field guide's offset and scale; of the seeds, the first alone plans."""

    robots: tuple[str, ...] = ("kuka_iiwa14", "kinova_gen3", "franka_panda")
    """Arms whose edges are fitted."""
    cells: tuple[int, ...] = (12, 16, 24, 32, 48)
    """Of the field, along the longest side of its grid."""
    spacings: tuple[float, ...] = (0.2, 0.35, 0.5, 0.7)
    """Largest distances of places along a motion, rad (or m)."""
    scenes: int = 40
    """To fit in, and as many others to tell how well that went, for each arm."""
    num_nodes: int = 200
    """Of the roadmaps."""
    plan_robots: tuple[str, ...] = ("kuka_iiwa14", "kinova_gen3")
    """Arms that plan."""
    plan_cells: tuple[int, ...] = (16, 24, 32)
    """Fields that they plan with, each with the pair that fits it."""
    num_problems: int = 200
    """Problems of each arm, drawn for validation."""


def measurement(config: CalibrateFieldConfig) -> Measurement:
    """Rows of fits, then of planners."""
    if config.robot:
        only = (config.robot,)
        config = dataclasses.replace(config, robots=only, plan_robots=only, robot=None)
    shared = {field.name for field in dataclasses.fields(ExperimentConfig)}
    settings = {n: v for n, v in dataclasses.asdict(config).items() if n not in shared}
    for name in ("robots", "plan_robots"):
        settings[name] = [Path(robot).stem for robot in settings[name]]
    settings = json.loads(json.dumps(settings))
    head = {"settings": settings | {"seed": config.seeds[0]}, "calibration": list(CALIBRATION)}
    head |= {"default": {"cells": CELLS, "spacing": SPACING}}
    arms = [load_robot(named).path for named in (*config.robots, *config.plan_robots)]
    folder = folder_of(config.runs, "calibrate_field", settings, *arms)
    return Measurement(_rows(config, folder), head)


def _rows(config: CalibrateFieldConfig, folder: Path) -> Iterator[Row]:
    fits = kept(folder / "fits.json", functools.partial(_fits, config))
    yield from fits
    pairs = {row["cells"]: row["pair"] for row in fits if row["spacing"] == SPACING}
    for named in config.plan_robots:
        robot = load_robot(named)
        drawn = generate_labelled(robot, 0)(problem_keys(0, "validation", 0, config.num_problems))
        assert isinstance(drawn, Problem)
        wanted = {"by hand": (CELLS, CALIBRATION)}
        wanted |= {f"fitted, {cells} cells": (cells, pairs[cells]) for cells in config.plan_cells}
        makers = {
            name: functools.partial(_planner, robot, config.num_nodes, cells, tuple(pair))
            for name, (cells, pair) in wanted.items()
        }
        problems = jax.tree.map(np.asarray, drawn)
        planned = plan_in_turn(robot, makers, problems, config.seeds[:1], folder / Path(named).stem)
        for name, (cells, pair) in wanted.items():
            yield {
                "kind": "plans",
                "robot": robot.name,
                "calibration": name,
                "cells": cells,
                "pair": list(pair),
                "summary": summarize_seeds(planned[name]),
                "to_hand": {
                    quantity: ratio_of_means(planned[name], planned["by hand"], quantity)
                    for quantity in ("configuration_checks", "edge_checks", "total_time_s")
                },
            }


def _planner(robot: Robot, num_nodes: int, cells: int, pair: tuple[float, float]) -> Planner:
    guide = field_guide(robot, cells)._replace(weights=jnp.array(pair))
    options = make_options("guided", num_nodes=num_nodes, check_cost=DEAR)
    return own_planner(robot, options, guide)


def _fits(config: CalibrateFieldConfig) -> list[Row]:
    """Rows of all fields and spacings: the pair that fits all arms, and what it is worth."""
    edges, spent = {}, {}
    for named in config.robots:
        robot = load_robot(named)
        draw = jax.jit(jax.vmap(scene_sampler(robot)))
        for number, split in enumerate(("fit", "tell")):
            key = jax.random.fold_in(jax.random.key(0), number)
            scenes = jax.tree.map(np.asarray, draw(jax.random.split(key, config.scenes)))
            edges[named, split] = stored_edges(robot, scenes, config.num_nodes, seed=number)
        print(f"labelled {named}", flush=True)
    found: dict[tuple[int, float, str, str], Margins] = {}
    for named, cells in itertools.product(config.robots, config.cells):
        robot = load_robot(named)
        for split in ("fit", "tell"):
            margins = edge_margins(robot, cells, edges[named, split], config.spacings)
            for spacing, part in zip(config.spacings, margins, strict=True):
                found[cells, spacing, named, split] = part
        spent[named, cells] = clocks(robot, cells, edges[named, "tell"].scenes)
        print(f"read {named}, {cells} cells", flush=True)
    rows = []
    for cells, spacing in itertools.product(config.cells, config.spacings):
        own = {named: found[cells, spacing, named, "fit"] for named in config.robots}
        pair = fit(Margins(*(np.concatenate(x) for x in zip(*own.values(), strict=True))))
        arms = {}
        for named in config.robots:
            told, asked = found[cells, spacing, named, "tell"], edges[named, "tell"]
            lengths = np.linalg.norm(asked.ends - asked.starts, axis=1)
            places = float(num_pieces(lengths, spacing).mean()) + 1
            field_s, place_s, spheres = spent[named, cells]
            arms[load_robot(named).name] = {
                "own_pair": fit(own[named]),
                "area": area_under_curve(told.margin, told.valid),
                "log_loss": log_loss_of(told, pair),
                "log_loss_own_pair": log_loss_of(told, fit(own[named])),
                "log_loss_by_hand": log_loss_of(told, CALIBRATION),
                "num_edges": len(told.valid),
                "lookups": places * spheres,
                "edge_s": field_s / len(asked.starts) + places * place_s,
            }
        rows.append(
            {"kind": "fit", "cells": cells, "spacing": spacing, "pair": list(pair), "arms": arms}
        )
    return rows


def _kind(results: Row, kind: str) -> list[Row]:
    return [row for row in results["rows"] if row["kind"] == kind]


def draw(results: Row) -> Figure:
    """Draws how well fields tell edges apart over the time an edge takes: a panel an arm."""
    rows = _kind(results, "fit")
    arms = list(rows[0]["arms"])
    figure = Figure(figsize=(5 * len(arms) + 1, 4.4), dpi=100, layout="constrained")
    panels = np.atleast_1d(figure.subplots(1, len(arms), sharey=True))
    for axes, arm in zip(panels, arms, strict=True):
        for cells in dict.fromkeys(row["cells"] for row in rows):
            chosen = [row for row in rows if row["cells"] == cells]
            parts = [row["arms"][arm] for row in chosen]
            spent, missed = [1e6 * p["edge_s"] for p in parts], [1 - p["area"] for p in parts]
            axes.plot(spent, missed, "o-", ms=4, label=f"{cells} cells")
            for row, x, y in zip(chosen, spent, missed, strict=True):
                axes.annotate(f"{row['spacing']:g}", (x, y), fontsize=7)
        axes.set(title=arm, xlabel="us an edge, field included")
        make_logarithmic(axes, "xy")
    panels[0].set_ylabel("1 - area under the ROC curve")
    panels[0].legend()
    figure.suptitle("Numbers: spacing of places, rad")
    return figure


def table(results: Row) -> str:
    """Fits of all fields, then what pairs and fields need when they plan."""
    offset, scale = results["calibration"]
    fits, plans = _kind(results, "fit"), _kind(results, "plans")
    arms = list(fits[0]["arms"])
    lines = []
    for row in fits:
        parts = [row["arms"][arm] for arm in arms]
        line = [str(row["cells"]), f"{row['spacing']:g}", _pair(row["pair"])]
        for name, form, factor in (
            ("area", ".4f", 1),
            ("log_loss", ".3f", 1),
            ("log_loss_by_hand", ".3f", 1),
            ("lookups", ".0f", 1),
            ("edge_s", ".2f", 1e6),
        ):
            line.append(" / ".join(f"{factor * part[name]:{form}}" for part in parts))
        lines.append(line)
    head = ["cells", "spacing, rad", "fitted offset, scale, mm", "area", "log loss"]
    head += [f"by hand ({_pair((offset, scale))})", "look-ups an edge", "us an edge"]
    note = f"For {' / '.join(arms)}; one pair for all of them.\n"
    own = next(row for row in fits if results["default"] == {n: row[n] for n in results["default"]})
    each = ", ".join(f"{arm} {_pair(own['arms'][arm]['own_pair'])}" for arm in arms)
    parts = [note, markdown(head, lines), f"Pairs that fit one arm alone: {each}.\n"]
    head = ["arm", "calibration", "offset, scale, mm", "solved, %", "edge checks, mean"]
    head += ["configuration checks, mean", "median", "of those by hand", "cost, mean"]
    head += ["total, ms, median", "mean", "of that by hand"]
    lines = []
    for row in plans:
        part, ratios = row["summary"]["hard"], row["to_hand"]
        lines.append(
            [
                row["robot"],
                row["calibration"],
                _pair(row["pair"]),
                cell(part["success"], ".1f", 100),
                interval(part["edge_checks"], ".1f"),
                interval(part["configuration_checks"], ".0f"),
                cell(part["configuration_checks"], ".0f", key="median"),
                interval(ratios["configuration_checks"], ".3f"),
                cell(part["cost"], ".2f"),
                cell(part["total_time_s"], ".1f", 1e3, "median"),
                cell(part["total_time_s"], ".1f", 1e3),
                interval(ratios["total_time_s"], ".3f"),
            ]
        )
    num = plans[0]["summary"]["hard"]["num_problems"]
    parts += [
        f"Planning where checks are dear, problems whose straight line is blocked ({num} of the "
        "first arm's); ratios are of means over all problems:\n",
        markdown(head, lines),
    ]
    return "\n".join(parts)


def _pair(pair: Sequence[float]) -> str:
    return ", ".join(f"{1e3 * value:.1f}" for value in pair)


def verdict(results: Row) -> str:
    """Whether any other pair or field needs measurably fewer configuration checks on some arm."""
    findings = []
    for row in _kind(results, "plans"):
        if row["calibration"] == "by hand":
            continue
        ratio = row["to_hand"]["configuration_checks"]
        text = (
            f"{row['calibration']} ({_pair(row['pair'])} mm) takes {interval(ratio, '.3f')} times "
            f"the configuration checks on {row['robot']}"
        )
        findings.append(Finding(ratio["high"] >= 1, text))
    return judge(*findings)


EXPERIMENT = Experiment(
    name="calibrate_field",
    title="Calibration of the distance field",
    claim="The field's calibration, picked by hand, needs no more checks than a fitted one.",
    config=CalibrateFieldConfig,
    quick={
        "cells": (24,),
        "spacings": (0.35, 0.7),
        "scenes": 2,
        "num_nodes": 30,
        "plan_cells": (24,),
        "num_problems": 3,
    },
    measure=measurement,
    draw=draw,
    table=table,
    verdict=verdict,
)


if __name__ == "__main__":
    main(EXPERIMENT)
