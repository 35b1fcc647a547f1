"""Claim: what the certificate calls free is free, however close it comes.

    python -m experiments.certify_campaign

Motions of the shipped arms, of what these become when their MJCF is distorted, of arms that hold
something, and of arms drawn at random (`random_arm.py`) are certified among obstacles of all kinds
and clouds, and looked at by MuJoCo's C engine every 0.001 rad (`judge.py`). A fourth of them graze:
an obstacle is pushed towards the arm, or the motion made longer, for as long as the certificate
holds, by bisection.

The engine reads the MJCF itself, not what the package made of it. Results are written as they come
(`campaign.py`); the same command goes on where it was cut off, and one with more edges, or arms,
goes on from there, as long as the code is the same.
"""

import dataclasses
import functools
import time
from collections.abc import Callable
from pathlib import Path

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
from experiments.campaign_edges import Edges, draw_edges, draw_points
from experiments.grazing import lengthen, push
from experiments.judge import Arm, Judge
from experiments.random_arm import BASE, distorted_arm, random_arm
from gnnjax.arguments import parse_arguments
from gnnjax.arm.robot import load_robot
from gnnjax.collision.clearances import is_self_free
from gnnjax.errors import InputError, check_seed, run_command
from gnnjax.files import atomic_write, check_target
from gnnjax.scene.shapes import Shape, box, capsule, cylinder

_HOLDERS = {"kuka_iiwa14": "link_7", "kinova_gen3": "bracelet_link", "franka_panda": "hand"}
_BLOCK = 2_000  # edges between two writes of the results


@dataclasses.dataclass(frozen=True)
class CampaignConfig:
    """Certify edges, and scan what was certified with MuJoCo's C engine."""

    num_edges: int = 1_000_000
    """Certified edges, shared out over the arms."""
    random_arms: int = 9
    """Arms drawn at random, beside the others."""
    distorted: int = 1
    """Distorted forms of each of the shipped arms."""
    step: float = 0.001
    """Largest distance of neighbouring configurations of the scan, rad (or m)."""
    seed: int = 1
    """Of arms, scenes and edges."""
    runs: Path = Path("runs")
    """Where the folder goes of the arms' MJCF and of what was found edge by edge."""
    json: Path = Path("results/certify_campaign.json")
    """Where the summary goes."""


def make_arms(config: CampaignConfig, folder: Path) -> dict[str, Arm]:
    """The shipped arms; with something in the hand; distorted; and random ones. Of the last two
    those that are free of self-collision often enough; their MJCF goes into the folder."""
    often_free = functools.partial(_often_free, folder, config.seed)
    arms = {name: Arm(load_robot(name)) for name in SHIPPED}
    for name, holder in _HOLDERS.items():
        held = _held(np.random.default_rng((config.seed, 1, len(arms))))
        robot = arms[name].robot.attach(holder, held)
        arms[f"{name}_holding"] = Arm(robot, holder=holder, held=tuple(held))
    for name in SHIPPED:
        text = functools.partial(distorted_arm, path=arms[name].robot.path)
        base = arms[name].robot.bodies[0].name
        arms |= often_free(f"{name}_distorted", text, config.distorted, base, 0.9)
    return arms | often_free("random", random_arm_of_any_size, config.random_arms, BASE, 0.7)


def random_arm_of_any_size(rng: np.random.Generator) -> str:
    return random_arm(rng, num_links=int(rng.integers(2, 6)))


def _held(rng: np.random.Generator) -> list[Shape]:
    """Things that a hand might hold, beyond its fingers."""
    turn = rng.normal(size=(3, 4))
    return [
        box([0, 0, 0.22], rng.uniform(0.02, 0.05, 3), turn[0]),
        capsule([0.05, 0, 0.24], 0.02, 0.04, turn[1]),
        cylinder([-0.04, 0.03, 0.26], 0.03, 0.05, turn[2]),
    ]


def _often_free(
    folder: Path,
    seed: int,
    name: str,
    text: Callable[[np.random.Generator], str],
    wanted: int,
    base: str,
    reach: float,
) -> dict[str, Arm]:
    found, number = {}, 0
    while len(found) < wanted:
        rng = np.random.default_rng((seed, number))
        path = folder / f"{name}_{seed}_{number}.xml"
        made = text(rng)
        atomic_write(path, lambda file, made=made: file.write_text(made) and None)
        robot = load_robot(path.resolve())
        q = rng.uniform(robot.joint_lower, robot.joint_upper, (50, robot.num_dof))
        number += 1
        if is_self_free(robot, q).mean() > 0.3:
            found[path.stem] = Arm(robot, base, reach)
    return found


def measure_block(arm: Arm, seed: tuple[int, ...], num: int, step: float) -> dict:
    """Certifies and scans `num` edges, of which every fourth grazes."""
    begin, rng = time.process_time(), np.random.default_rng(seed)
    points, radius = draw_points(rng, arm.reach), float(rng.uniform(0.01, 0.03))
    found = {"edges": 0, "grazing": 0, "gaps": [], "least": 1.0, "scanned": 0, "noise": 0}
    found["refuted"] = []
    among_points = num // 6
    for part, cloud in ((num - among_points, None), (among_points, (points, radius))):
        judge = Judge(arm, *(cloud or ()))
        for kind, edges in draw_kinds(rng, arm, part, cloud).items():
            for i in range(len(edges.starts)):
                _look(judge, edges, i, kind, step, found)
    found["seconds"] = round(time.process_time() - begin, 1)
    return found


def draw_kinds(
    rng: np.random.Generator, arm: Arm, num: int, cloud: tuple[np.ndarray, float] | None
) -> dict[str, Edges]:
    """`num` certified edges by kind: of twelve two are pushed and one is lengthened."""
    drawn = draw_edges(rng, arm, num, cloud)
    part = np.arange(num) % 12
    return {
        "plain": drawn.take(part >= 3),
        "pushed": push(rng, arm, drawn.take((part == 0) | (part == 1))),
        "lengthened": lengthen(rng, arm, drawn.take(part == 2)),
    }


def _look(judge: Judge, edges: Edges, i: int, kind: str, step: float, found: dict) -> None:
    """Scans edge i, and adds what comes out to what was found."""
    start, end = edges.starts[i], edges.ends[i]
    judge.place(edges.shapes[i], edges.clouds[i])
    seen = judge.scan(start, end, step)
    found["edges"] += 1
    found["grazing"] += kind != "plain"
    pose = edges.clouds[i]
    places = {"start": start.tolist(), "end": end.tolist(), "shapes": told(edges.shapes[i])}
    enter(found, seen, kind, places | {"cloud": pose and [x.tolist() for x in pose]})


def summarize(blocks: list[dict]) -> dict:
    """Counts of an arm's edges, and how close those come that graze."""
    total = {
        name: sum(block[name] for block in blocks)
        for name in ("edges", "grazing", "scanned", "noise", "seconds")
    }
    return {
        "edges": total["edges"],
        "grazing": total["grazing"],
        **how_near(blocks),
        "configurations": total["scanned"],
        "within_rounding": total["noise"],
        "cpu_ms_an_edge": 1e3 * total["seconds"] / max(1, total["edges"]),
        "refuted": sum(len(block["refuted"]) for block in blocks),
    }


def run(config: CampaignConfig) -> dict:
    """Does what is missing of the campaign and returns its summary."""
    if config.num_edges < 1 or min(config.random_arms, config.distorted) < 0 or not config.step > 0:
        raise InputError(
            f"num_edges is {config.num_edges}, random_arms {config.random_arms}, distorted "
            f"{config.distorted} and step {config.step}; give at least 1, 0 and 0, and more than 0"
        )
    check_seed(config.seed)
    check_target(config.json)
    folder = folder_of_campaign(config.runs, "certify_campaign", config.step, config.seed)
    settings = {k: v for k, v in dataclasses.asdict(config).items() if k not in ("json", "runs")}
    arms = make_arms(config, folder)
    each = -(-config.num_edges // len(arms))

    def block(name: str, first: int) -> Block:
        num, seed = min(_BLOCK, each - first), seed_of(config.seed, name, first)
        measure = functools.partial(measure_block, arms[name], seed, num, config.step)
        return Block(name, f"{name}_{first}_{num}.json", measure)

    blocks = [block(name, first) for first in range(0, each, _BLOCK) for name in arms]
    doing = "certifying and scanning"
    return run_blocks(folder, blocks, summarize, config.json, settings, doing)


if __name__ == "__main__":
    run_command(lambda: run(parse_arguments(CampaignConfig)) and None)
