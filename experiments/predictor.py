"""Claim: seeing a few points of the arm tells valid edges from blocked ones for less than a check.

    python -m experiments.predictor

How well motion networks of several sizes tell a roadmap's valid edges from its blocked ones (area
under the ROC curve), over the operations that asking them about an edge takes. The edges are those
of labelled roadmaps of the validation set, whose nodes are valid. Networks look at each edge in
pieces of several largest lengths, without being trained anew.

Operations are those on an edge of 3 rad. What a network sees of the arm (kinematics, distances of
points to boxes), and a configuration check of the fused kernel, are counted in the compiled program
by `operations.py`: sums, products, comparisons, roots, sines and so on, one each. An
edge of n pieces is seen at n + 1 configurations. The network's own are counted by formula for each
piece: two for every weight, and ten for every point's features. A check of the edge tests what is
between its ends every 0.05 rad. Boxes are as many as the scenes have in the mean, rounded.
"""

import dataclasses
import itertools
import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from experiments import training
from experiments.edges import (
    EDGE_LENGTH,
    Edges,
    areas_under_curve,
    check_operations,
    labelled_edges,
    network_operations,
    view_operations,
)
from experiments.measure import ExperimentConfig
from experiments.record import Experiment, Finding, Measurement, judge, main
from experiments.results import Row
from experiments.tables import markdown, span
from gnnjax.collision.checker import EDGE_RESOLUTION
from gnnjax.guide.motion import MotionNetwork
from gnnjax.train_motion import TrainMotionConfig
from gnnjax.training.weights import load_network

TOLD_APART = 0.99  # area under the curve from which on a network is said to tell edges apart


@dataclasses.dataclass(frozen=True)
class PredictorConfig(ExperimentConfig):
    """Motion networks of several sizes: how well they tell edges, and what that takes."""

    robots: tuple[str, ...] = ("kuka_iiwa14", "kinova_gen3")
    """Arms whose edges are told apart, and which the networks are trained on."""
    num_points: tuple[int, ...] = (6, 12)
    """Points of the arm that are looked at."""
    channels: tuple[int, ...] = (16,)
    """Widths of the networks."""
    spacings: tuple[float, ...] = (1.5, 0.8, 0.5, 0.35)
    """Largest lengths of the pieces, rad."""
    steps: int = 300
    """Of each training."""
    num_roadmaps: int = 40
    """Labelled roadmaps of each arm."""
    num_nodes: int = 200
    """Of the roadmaps."""
    trained: Path = Path("runs/predictor")
    """Where the networks go."""


def measurement(config: PredictorConfig) -> Measurement:
    """Rows of networks and spacings, and what checking an edge takes."""
    if config.robot:
        config = dataclasses.replace(config, robots=(config.robot,), robot=None)
    sets = [labelled_edges(name, config.num_roadmaps, config.num_nodes) for name in config.robots]
    head = {
        "check_operations": {edges.robot.name: check_operations(edges) for edges in sets},
        "edge_length": EDGE_LENGTH,
        "resolution": EDGE_RESOLUTION,
    }
    return Measurement(_rows(config, sets), head)


def _rows(config: PredictorConfig, sets: list[Edges]) -> Iterator[Row]:
    for name, command, network in _networks(config):
        areas = [areas_under_curve(network, edges, config.spacings) for edges in sets]
        seen = [view_operations(edges, network.num_points) for edges in sets]
        for number, spacing in enumerate(config.spacings):
            row = {"network": name, "spacing": spacing, "command": command}
            row |= {"num_points": network.num_points, "channels": network.channels}
            pieces = math.ceil(EDGE_LENGTH / spacing)
            each = network_operations(network)
            row["arms"] = {
                edges.robot.name: {
                    "area": area[number],
                    "operations": (pieces + 1) * view + pieces * each,
                    "num_edges": int(edges.mask.sum()),
                    "share_valid": float(edges.valid[edges.mask].mean()),
                }
                for edges, area, view in zip(sets, areas, seen, strict=True)
            }
            yield row


def _networks(config: PredictorConfig) -> Iterator[tuple[str, str, MotionNetwork]]:
    """Names, commands of the trainings, and networks: those of all sizes, then the shipped one."""
    for points, channels in itertools.product(config.num_points, config.channels):
        arms = "-".join(Path(robot).stem for robot in config.robots)
        made = TrainMotionConfig(
            robots=config.robots,
            out=config.trained / f"{arms}_{points}_{channels}_{config.steps}",
            steps=config.steps,
            num_points=points,
            channels=channels,
            **({"scenes": 2, "motions": 16} if config.quick else {}),
        )
        network = load_network(training.trained(made))
        assert isinstance(network, MotionNetwork)
        name = f"{points} points, {channels} wide, {config.steps} steps"
        yield name, training.command(made), network
    network = load_network("motion")
    assert isinstance(network, MotionNetwork)
    yield "shipped", "python -m gnnjax.train_motion", network


def draw(results: Row) -> Figure:
    """Draws the area over operations, a panel an arm and a line a network; grey: the best."""
    rows, checks = results["rows"], results["check_operations"]
    figure = Figure(figsize=(6.5 * len(checks), 4.6), dpi=110, layout="constrained")
    panels = np.atleast_1d(figure.subplots(1, len(checks)))
    for axes, (arm, check) in zip(panels, checks.items(), strict=True):
        points = [(row["arms"][arm]["operations"], row["arms"][arm]["area"]) for row in rows]
        for name in dict.fromkeys(row["network"] for row in rows):
            line = [p for p, row in zip(points, rows, strict=True) if row["network"] == name]
            style = {"color": "black", "lw": 2} if name == "shipped" else {"lw": 1}
            axes.plot(*zip(*sorted(line), strict=True), ".-", label=name, **style)
        front = pareto(points)
        axes.step(*zip(*front, strict=True), where="post", color="0.7", lw=5, zorder=0)
        axes.axvline(check, color="black", ls=":")
        axes.annotate(
            "checking the edge", (check, 0.02), xycoords=("data", "axes fraction"), rotation=90
        )
        axes.set(
            xscale="log",
            title=arm,
            xlabel=f"operations for an edge of {results['edge_length']:g} rad",
        )
    panels[0].set_ylabel("area under the ROC curve")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4)
    return figure


def pareto(points: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """Points `(cost, gain)` that gain more than all that cost no more, by cost."""
    front: list[tuple[float, float]] = []
    for cost, gain in sorted(points, key=lambda point: (point[0], -point[1])):
        if not front or gain > front[-1][1]:
            front.append((cost, gain))
    return front


def table(results: Row) -> str:
    """Area under the curve and operations of each network and spacing."""
    checks = results["check_operations"]
    lines = []
    for row in results["rows"]:
        line = [row["network"], f"{row['spacing']:g}"]
        for arm, check in checks.items():
            part = row["arms"][arm]
            share = 100 * part["operations"] / check
            line += [f"{part['area']:.4f}", f"{part['operations'] / 1e3:.0f}", f"{share:.0f}"]
        lines.append(line)
    head = ["network", "pieces up to, rad"]
    for arm in checks:
        head += [f"{arm}: area", "thousand operations", "% of a check"]
    each = ", ".join(f"{count / 1e3:.0f} thousand ({arm})" for arm, count in checks.items())
    note = (
        f"Operations on an edge of {results['edge_length']:g} rad; checking it every "
        f"{results['resolution']:g} rad takes {each}.\n"
    )
    return note + "\n" + markdown(head, lines)


def verdict(results: Row) -> str:
    """Whether there are pieces from which on every network tells the edges of every arm apart, and
    takes fewer operations than the check."""
    checks = results["check_operations"]
    told = None
    for spacing in sorted({row["spacing"] for row in results["rows"]}):
        parts = [
            (part["area"], part["operations"] / checks[arm])
            for row in results["rows"]
            if row["spacing"] <= spacing
            for arm, part in row["arms"].items()
        ]
        areas, shares = zip(*parts, strict=True)
        if min(areas) < TOLD_APART or max(shares) >= 1:
            break
        told = spacing, areas, shares
    if told is None:
        return judge(Finding(False, f"not every area is {TOLD_APART:g} for less than a check"))
    spacing, areas, shares = told
    text = (
        f"in pieces of {spacing:g} rad and less, the area is {span(areas, '.4f')} in all networks "
        f"and arms, for {span(shares, '.0f', 100)} % of the operations of a check"
    )
    return judge(Finding(True, text))


EXPERIMENT = Experiment(
    name="predictor",
    title="Telling edges apart",
    claim="A few points of the arm tell valid edges from blocked ones for less than a check costs.",
    config=PredictorConfig,
    quick={
        "robots": ("kuka_iiwa14",),
        "num_points": (6,),
        "spacings": (1.5, 0.8),
        "steps": 2,
        "num_roadmaps": 2,
        "num_nodes": 30,
    },
    measure=measurement,
    draw=draw,
    table=table,
    verdict=verdict,
)

if __name__ == "__main__":
    main(EXPERIMENT)
