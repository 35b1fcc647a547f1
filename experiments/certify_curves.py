"""Claim: a rounded path that the certificate calls free is free, all along the curve.

    python -m experiments.certify_curves

Problems among obstacles of all kinds are planned by the default planner, for the shipped arms, and
the corners of the paths are rounded as far as is certified. MuJoCo's C engine looks at the whole
curve every 0.001 rad, straight pieces and rounded corners (`judge.py`), at the very places that
motions take their states from. Each corner is looked at twice: as it is, and with an obstacle that
is pushed towards the arm for as long as the corner's certificate holds, by bisection.

Results are written as they come (`campaign.py`); the same command goes on where it was cut off, and
one with more problems goes on from there, as long as the code is the same.
"""

import dataclasses
import functools
import time
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from experiments.campaign import (
    SHIPPED,
    Block,
    enter,
    folder_of_campaign,
    how_near,
    run_blocks,
    seed_of,
    told,
)
from experiments.campaign_edges import Edges, draw_shapes
from experiments.grazing import Pieces, push
from experiments.judge import Arm, Judge
from gnnjax.arguments import parse_arguments
from gnnjax.arm.robot import load_robot
from gnnjax.collision.certify import certify_edges
from gnnjax.collision.clearances import clearances
from gnnjax.errors import InputError, check_seed, run_command
from gnnjax.files import check_target
from gnnjax.planning.load import make_planner
from gnnjax.planning.options import PlannerOptions
from gnnjax.planning.query import QueryPlanner
from gnnjax.problems.problem import Problem
from gnnjax.scene.batches import stack_scenes
from gnnjax.scene.scene import Scene, scene_from_shapes
from gnnjax.scene.shapes import Shape
from gnnjax.trajectory.curve import (
    Curve,
    blend_chords,
    distinct,
    edges_of,
    make_curve,
    places,
    size_of,
    straight_pieces,
)
from gnnjax.trajectory.smooth import smooth_paths

_BLOCK = 128  # problems between two writes of the results
_PAIRS = 8  # of ends that are drawn for a scene
_BLEND = 1.0  # configuration units, of an edge
_CHORDS = 6  # of a corner, to be certified anew
_COUNTS = "problems,solved,stops,straight,corners,pushed,scanned,noise".split(",")


@dataclasses.dataclass(frozen=True)
class CurvesConfig:
    """Certify rounded paths, and scan them with MuJoCo's C engine."""

    num_problems: int = 12_600
    """Planned problems, shared out over the arms."""
    step: float = 0.001
    """Largest distance of neighbouring configurations of the scan, rad (or m)."""
    seed: int = 1
    """Of scenes, ends and roadmaps."""
    runs: Path = Path("runs")
    """Where the folder goes of what was found problem by problem."""
    json: Path = Path("results/certify_curves.json")
    """Where the summary goes."""


class Corner(NamedTuple):
    """A rounded corner of a curve."""

    path: np.ndarray  # [L D]
    curve: Curve
    number: int  # from 0
    shapes: list[Shape]

    @property
    def blend(self) -> float:
        """Of the path before and behind it, configuration units."""
        return float(self.curve.blends[self.number])

    def at(self, shares: np.ndarray) -> np.ndarray:
        """Configurations `[N, D]` at shares `[N]`, as motions have them."""
        low, high = self.curve.entries[self.number], self.curve.exits[self.number]
        return np.asarray(places(self.curve, low + shares * (high - low)).q)

    @property
    def most(self) -> np.ndarray:
        """How fast each joint is at most, `[D]` rad or m: on either edge."""
        _, directions = edges_of(self.path)
        return 2 * self.blend * np.abs(directions[self.number : self.number + 2]).max(axis=0)


def measure_block(arm: Arm, planner: QueryPlanner, seed: tuple[int, ...], step: float) -> dict:
    """Plans, rounds and scans a block of problems."""
    begin, rng = time.process_time(), np.random.default_rng(seed)
    judge = Judge(arm)
    found: dict[str, Any] = dict.fromkeys(_COUNTS, 0)
    found |= {"gaps": [], "least": 1.0, "refuted": [], "problems": _BLOCK}
    shapes, problems = draw_problems(rng, arm)
    plans = planner.plan_batch(problems, seed=seed[-1])
    solved = [i for i, plan in enumerate(plans) if plan.success]
    scenes = jax.tree.map(lambda x: np.asarray(x)[solved], problems.scene)
    paths = [distinct(plans[i].path) for i in solved]
    found["solved"] = len(solved)
    corners, owner = [], []
    smoothed = smooth_paths(arm.robot, scenes, paths, _BLEND, proven=True) if paths else []
    for row, (path, blends, _) in enumerate(smoothed):
        judge.place(own := shapes[solved[row]])
        found["stops"] += int((blends == 0).sum())
        curve = make_curve(path, blends, size_of(path))
        for start, end in zip(*straight_pieces(path, blends), strict=True):
            found["straight"] += 1
            motion = {"start": start.tolist(), "end": end.tolist(), "shapes": told(own)}
            enter(found, judge.scan(start, end, step), "plain", motion)
        for number in np.flatnonzero(blends).tolist():
            corners.append(Corner(path, curve, number, own))
            owner.append(row)
            _look(judge, corners[-1], "plain", step, found)
    if corners:
        chosen = jax.tree.map(lambda x: x[owner], scenes)
        for corner in pushed(rng, arm, corners, chosen):
            judge.place(corner.shapes)
            _look(judge, corner, "pushed", step, found)
    found["seconds"] = round(time.process_time() - begin, 1)
    return found


def _look(judge: Judge, corner: Corner, kind: str, step: float, found: dict) -> None:
    found["corners" if kind == "plain" else "pushed"] += 1
    seen = judge.scan_curve(corner.at, corner.most, 2 * corner.blend, step)
    motion = {
        "path": corner.path.tolist(),
        "blend": corner.blend,
        "corner": corner.number + 1,
        "shapes": told(corner.shapes),
    }
    enter(found, seen, kind, motion)


def draw_problems(rng: np.random.Generator, arm: Arm) -> tuple[list[list[Shape]], Problem]:
    """Scenes, and in each of them two free configurations that no straight line joins."""
    robot, kept, shapes = arm.robot, [], []
    while len(kept) < _BLOCK:
        drawn = [draw_shapes(rng, arm.reach) for _ in range(_BLOCK)]
        scenes = [scene_from_shapes(own) for own in drawn]
        stacked, owner = stack_scenes(scenes), np.repeat(np.arange(_BLOCK), _PAIRS)
        size = 2, len(owner), robot.num_dof
        starts, goals = rng.uniform(robot.joint_lower, robot.joint_upper, size).astype("f4")
        free = np.all([clearances(robot, stacked, q, owner, 0.0) > 0 for q in (starts, goals)], 0)
        rows = np.flatnonzero(free)
        joined = certify_edges(robot, stacked, starts[rows], goals[rows], owner[rows])
        rows = rows[~joined]
        _, first = np.unique(owner[rows], return_index=True)
        for row in rows[first].tolist():
            kept.append(Problem(starts[row], goals[row], scenes[owner[row]]))
            shapes.append(drawn[owner[row]])
    kept = kept[:_BLOCK]
    starts, goals = np.stack([x.start for x in kept]), np.stack([x.goal for x in kept])
    return shapes[:_BLOCK], Problem(starts, goals, stack_scenes([x.scene for x in kept]))


def pushed(
    rng: np.random.Generator, arm: Arm, corners: list[Corner], scenes: Scene
) -> list[Corner]:
    """Corners `[C]` with an obstacle pushed towards the arm, in scenes `[C M ...]`."""
    chords = [
        blend_chords(x.path, np.array([x.number + 1]), np.array([x.blend]), _CHORDS)
        for x in corners
    ]
    points, slack = (np.concatenate(x) for x in zip(*chords, strict=True))
    owner = np.repeat(np.arange(len(corners)), _CHORDS)
    starts, ends, slack = (
        x.reshape(len(owner), -1) for x in (points[:, :-1], points[:, 1:], slack)
    )

    edges = Edges(
        [x.shapes for x in corners],
        scenes,
        [None] * len(corners),
        *np.stack([x.at(np.array([0.0, 1.0])) for x in corners], axis=1),
    )
    moved = push(rng, arm, edges, Pieces(starts, ends, owner, slack))
    return [x._replace(shapes=own) for x, own in zip(corners, moved.shapes, strict=True)]


def summarize(blocks: list[dict]) -> dict:
    """Counts of an arm's curves, how close those corners come that graze, and CPU time."""
    total = {name: sum(block[name] for block in blocks) for name in (*_COUNTS, "seconds")}
    pieces = total["straight"] + total["corners"] + total["pushed"]
    return {
        **{name: total[name] for name in _COUNTS},
        **how_near(blocks),
        "pieces": pieces,
        "cpu_ms_a_piece": float(1e3 * total["seconds"] / max(1, pieces)),
        "refuted": sum(len(block["refuted"]) for block in blocks),
    }


def run(config: CurvesConfig) -> dict:
    """Does what is missing of the campaign and returns its summary."""
    if config.num_problems < 1 or not config.step > 0:
        raise InputError(
            f"num_problems is {config.num_problems} and step {config.step}; give at least 1, and "
            "more than 0"
        )
    check_seed(config.seed)
    check_target(config.json)
    folder = folder_of_campaign(config.runs, "certify_curves", config.step, config.seed)
    planner = functools.cache(lambda name: make_planner(load_robot(name), PlannerOptions()))

    def block(name: str, number: int) -> Block:
        stem = Path(name).stem

        def measure() -> dict:
            seed = seed_of(config.seed, stem, number)
            return measure_block(Arm(load_robot(name)), planner(name), seed, config.step)

        return Block(name, f"{stem}_{number}.json", measure)

    rounds = -(-config.num_problems // (len(SHIPPED) * _BLOCK))
    blocks = [block(name, number) for number in range(rounds) for name in SHIPPED]
    settings = {"num_problems": config.num_problems, "step": config.step, "seed": config.seed}
    doing = "planning, certifying and scanning"
    return run_blocks(folder, blocks, summarize, config.json, settings, doing)


if __name__ == "__main__":
    run_command(lambda: run(parse_arguments(CurvesConfig)) and None)
