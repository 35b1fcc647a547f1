"""Claim: trained until its loss hardly falls, the paper's network adds nothing to the distance.

    python -m experiments.converged

The preset `paper` (the paper's network, losses, optimizer and rates), from several seeds of its
training, in the paper's algorithm: one roadmap, no second try. Beside it the same search by the
distance to the goal, on the same problems and roadmaps; differences are of pairs, with 95 %
intervals over problems. A training takes a quarter of an hour on two cores; the first one's weights
are those that are shipped.
"""

import dataclasses
import functools
from collections.abc import Iterator
from pathlib import Path

from matplotlib.figure import Figure

from experiments.cases import first_roadmap_case
from experiments.measure import ExperimentConfig, difference, measure, problem_set
from experiments.record import Experiment, Finding, Measurement, judge, main
from experiments.results import Row
from experiments.style import draw_lines
from experiments.tables import DETAIL, both, interval, markdown
from experiments.training import command, trained
from experiments.variants import training_set
from gnnjax.train import PRESETS, TrainConfig
from gnnjax.training.weights import read_metadata


@dataclasses.dataclass(frozen=True)
class ConvergedConfig(ExperimentConfig):
    """The paper's network after many epochs, and the distance to the goal."""

    epochs: int = 60
    """Passes over the training set."""
    training_seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of the trainings."""
    num_nodes: int = 200
    """Nodes of the roadmaps."""
    num_problems: int = 300
    """Test problems."""
    num_roadmaps: int | None = None
    """Training problems; by default all of the paper's 3,000."""
    channels: int = 32
    """Of the network."""
    trained: Path = Path("runs/converged")
    """Where the networks go."""


def training(config: ConvergedConfig, robot: str, data: Path, seed: int) -> TrainConfig:
    """The preset `paper`, longer."""
    return dataclasses.replace(
        PRESETS["paper"],
        data=data,
        robot=robot,
        out=config.trained / f"{Path(robot).stem}_{config.epochs}epochs_seed{seed}",
        epochs=config.epochs,
        seed=seed,
        channels=config.channels,
        num_roadmaps=config.num_roadmaps,
        **({"validation_problems": 0} if config.quick else {}),
    )


def measurement(config: ConvergedConfig) -> Measurement:
    """A row a training, and one of the distance."""
    return Measurement(_rows(config))


def _rows(config: ConvergedConfig) -> Iterator[Row]:
    robot = config.robot or "kuka_iiwa14"
    path = problem_set(config, robot, num_problems=config.num_problems)
    case = functools.partial(
        first_roadmap_case,
        path,
        robot,
        num_nodes=config.num_nodes,
        num_problems=config.num_problems,
    )
    distance = case("distance")
    yield {"variant": "distance to the goal", **measure(config, distance), "difference": None}
    data = training_set(config, robot, config.num_roadmaps, config.num_nodes)
    for seed in config.training_seeds:
        made = training(config, robot, data, seed)
        weights = trained(made)
        network = case("gnn", weights=weights)
        yield {
            "variant": f"paper's network, training seed {seed}",
            "training": command(made),
            "last_epoch": read_metadata(weights)["training"]["log"][-1],
            **measure(config, network),
            "difference": difference(config, network, distance),
        }


PANELS = (
    ("success", "solved on the one roadmap [%]", 100.0, False),
    ("edge_checks", "edge checks", 1.0, False),
    ("cost", "path cost [rad]", 1.0, False),
)


def draw(results: Row) -> Figure:
    """Draws means with 95 % intervals, a line a training."""
    rows = results["rows"]
    figure = Figure(figsize=(12, 1.4 + 0.4 * len(rows)), dpi=110, layout="constrained")
    draw_lines(figure, rows, [row["variant"] for row in rows], PANELS)
    figure.suptitle("Means with 95 % intervals")
    return figure


def table(results: Row) -> str:
    """What each training does, and how it differs from the distance on the same roadmaps."""
    lines = []
    for row in results["rows"]:
        loss = f"{row['last_epoch']['loss']:.3f}" if "last_epoch" in row else "-"
        more = row["difference"] or {}
        lines.append(
            [row["variant"], loss]
            + [both(row, write) for _, write in DETAIL]
            + [
                interval(more.get("success"), "+.1f", 100),
                interval(more.get("edge_checks"), "+.1f"),
            ]
        )
    head = ["", "loss, last epoch", *[title for title, _ in DETAIL]]
    head += ["solved more than by the distance, %", "edge checks more"]
    return markdown(head, lines)


def verdict(results: Row) -> str:
    """Whether no training solves measurably more, or checks measurably fewer edges."""
    findings = []
    for row in results["rows"]:
        more = row["difference"]
        if more is None:
            continue
        text = (
            f"{row['variant']} (loss {row['last_epoch']['loss']:.2f}) solves "
            f"{interval(more['success'], '+.1f', 100)} % more and checks "
            f"{interval(more['edge_checks'], '+.1f')} edges more a problem"
        )
        adds = more["success"]["low"] > 0 or more["edge_checks"]["high"] < 0
        findings.append(Finding(not adds, text))
    return judge(*findings)


EXPERIMENT = Experiment(
    name="converged",
    title="The paper's network, trained to the end",
    claim="Trained until its loss hardly falls, the paper's network adds nothing measurable to "
    "the distance to the goal.",
    config=ConvergedConfig,
    quick={
        "epochs": 1,
        "training_seeds": (0,),
        "num_nodes": 30,
        "num_problems": 3,
        "num_roadmaps": 10,
        "channels": 8,
    },
    measure=measurement,
    draw=draw,
    table=table,
    verdict=verdict,
)

if __name__ == "__main__":
    main(EXPERIMENT)
