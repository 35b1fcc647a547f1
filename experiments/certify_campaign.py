"""Claim: what the certificate calls free is free, however close it comes.

    python -m experiments.certify_campaign

Edges of the shipped arms and of arms drawn at random (`random_arm.py`) are certified among rotated
boxes and scanned by MuJoCo's C engine every 0.001 rad. A third of them graze: a box is pushed
towards the arm, or the motion made longer, for as long as the certificate holds, by bisection.

The engine reads the MJCF itself, not what the package made of it: boxes are bodies of their own on
the arm's base. Results are written as they come; the same command goes on where it was cut off.
"""

import dataclasses
import json
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
import tyro
from rich.console import Console
from rich.progress import track
from rich.table import Table

from experiments.random_arm import BASE, random_arm
from gnnjax.arm.joints import joint_name
from gnnjax.arm.robot import Robot, load_robot
from gnnjax.collision.certify import certify_edges, configuration_clearance
from gnnjax.errors import InputError, check_seed, run_command
from gnnjax.files import atomic_write, check_target
from gnnjax.scene.scene import Scene, make_scene

SHIPPED = ("kuka_iiwa14", "kinova_gen3", "franka_panda")
_BLOCK = 50  # edges between two writes of the results
_MARGIN = 2e-3  # m; gaps up to this are measured
_BISECTIONS = 16
_LENGTHS = (0.2, 1.5)  # of edges, configuration units


@dataclasses.dataclass(frozen=True)
class CampaignConfig:
    """Certify edges, and scan what was certified with MuJoCo's C engine."""

    num_edges: int = 10_000
    """Certified edges, shared out over the arms."""
    random_arms: int = 9
    """Arms drawn at random, beside the shipped ones."""
    step: float = 0.001
    """Largest distance of neighbouring configurations of the scan, rad (or m)."""
    seed: int = 0
    """Of arms, scenes and edges."""
    runs: Path = Path("runs/certify_campaign")
    """Folder of the random arms' MJCF and of what was found edge by edge."""
    json: Path = Path("results/certify_campaign.json")
    """Where the summary goes."""


class Arm(NamedTuple):
    """An arm, and the body of its MJCF that boxes are placed on."""

    robot: Robot
    base: str  # empty: the worldbody


class Edge(NamedTuple):
    """A certified motion in a scene."""

    scene: Scene
    start: np.ndarray  # [D]
    end: np.ndarray  # [D]


class Scan(NamedTuple):
    """What the C engine found along an edge."""

    gap: float  # m, of the deepest or nearest contact; infinite beyond 2 mm
    num_configurations: int


def draw_scene(rng: np.random.Generator, reach: float) -> Scene:
    """A few rotated boxes within reach [m] of the base."""
    num = int(rng.integers(1, 6))
    centers = rng.uniform(-reach, reach, (num, 3))
    sizes = reach * rng.uniform(0.03, 0.2, (num, 3))
    return make_scene(centers, sizes, rng.normal(size=(num, 4)))


def draw_edge(rng: np.random.Generator, arm: Arm, reach: float) -> Edge:
    """A certified edge, as it comes."""
    robot = arm.robot
    while True:
        scene = draw_scene(rng, reach)
        for _ in range(8):
            start = rng.uniform(robot.joint_lower, robot.joint_upper)
            end = start + _direction(rng, robot) * rng.uniform(*_LENGTHS)
            end = np.clip(end, robot.joint_lower, robot.joint_upper)
            if configuration_clearance(robot, scene, start) > 0 and _holds(
                robot, scene, start, end
            ):
                return Edge(scene, start, end)


def push_box(rng: np.random.Generator, arm: Arm, edge: Edge) -> Edge:
    """The edge with a box pushed towards the arm for as long as the certificate holds."""
    robot, scene = arm.robot, edge.scene
    data = mujoco.MjData(robot.mj_model)  # whose world is the base
    data.qpos[:] = edge.start + rng.random() * (edge.end - edge.start)
    mujoco.mj_kinematics(robot.mj_model, data)
    moving = robot.geom_ids[robot.geom_bodies >= 0]
    target = data.geom_xpos[rng.choice(moving)]
    box = rng.integers(int(np.asarray(scene.mask).sum()))
    begin = np.array(scene.centers[box], float)

    def pushed(share: float) -> Scene:
        centers = scene.centers.copy()
        centers[box] = begin + share * (target - begin)
        return scene._replace(centers=centers)

    share = _bisect(lambda share: _holds(robot, pushed(share), edge.start, edge.end))
    return edge._replace(scene=pushed(share))


def lengthen(rng: np.random.Generator, arm: Arm, edge: Edge) -> Edge:
    """The edge, in a direction of its own, as long as the certificate holds."""
    robot = arm.robot
    way = _direction(rng, robot) * rng.uniform(1.0, 3.0)
    within = np.where(way > 0, robot.joint_upper - edge.start, robot.joint_lower - edge.start)
    way = way * min(1.0, float((within / np.where(way == 0, np.inf, way))[way != 0].min()))

    def holds(share: float) -> bool:
        return _holds(robot, edge.scene, edge.start, edge.start + share * way)

    return edge._replace(end=edge.start + _bisect(holds) * way)


def _bisect(holds) -> float:
    """About the largest share from 0 to 1 at which something holds that holds at 0."""
    if holds(1.0):
        return 1.0
    low, high = 0.0, 1.0
    for _ in range(_BISECTIONS):
        middle = (low + high) / 2
        low, high = (middle, high) if holds(middle) else (low, middle)
    return low


def _holds(robot: Robot, scene: Scene, start: np.ndarray, end: np.ndarray) -> bool:
    return bool(certify_edges(robot, scene, start[None], end[None])[0])


def _direction(rng: np.random.Generator, robot: Robot) -> np.ndarray:
    way = rng.normal(size=robot.num_dof)
    return way / np.linalg.norm(way)


def scan(arm: Arm, edge: Edge, step: float) -> Scan:
    """Tests an edge every `step` with MuJoCo's C engine, in the world of the MJCF."""
    spec = mujoco.MjSpec.from_file(str(arm.robot.path))
    base = spec.body(arm.base) if arm.base else spec.worldbody
    mask = np.asarray(edge.scene.mask)
    for center, size, quat in zip(
        *(np.asarray(x, float)[mask] for x in edge.scene[:3]), strict=True
    ):
        body = base.add_body(pos=center, quat=quat)
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=size, contype=-1, conaffinity=-1)
    model = spec.compile()
    model.geom_margin[:], model.body_margin[:], model.pair_margin[:] = _MARGIN, _MARGIN, _MARGIN
    data = mujoco.MjData(model)
    count = int(np.ceil(np.linalg.norm(edge.end - edge.start) / step)) + 1
    held = [arm.robot.held.get(joint_name(model, j)) for j in range(model.njnt)]
    planned = np.array([value is None for value in held])
    data.qpos[~planned] = [value for value in held if value is not None]
    gap = np.inf
    for data.qpos[planned] in np.linspace(edge.start, edge.end, count):
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        if data.ncon:
            gap = min(gap, float(data.contact.dist[: data.ncon].min()))
    return Scan(gap, count)


def make_arms(config: CampaignConfig) -> dict[str, Arm]:
    """The shipped arms and the random ones that are free of self-collision often enough."""
    arms = {name: Arm(load_robot(name), "") for name in SHIPPED}
    number = 0
    nothing = make_scene([], [])
    while len(arms) < len(SHIPPED) + config.random_arms:
        rng = np.random.default_rng((config.seed, number))
        path = config.runs / f"random_{config.seed}_{number}.xml"
        text = random_arm(rng, num_links=int(rng.integers(2, 6)))
        atomic_write(path, lambda file, text=text: file.write_text(text) and None)
        robot = load_robot(path.resolve())
        q = rng.uniform(robot.joint_lower, robot.joint_upper, (50, robot.num_dof))
        free = np.mean([configuration_clearance(robot, nothing, row) > 0 for row in q])
        number += 1
        if free > 0.3:
            arms[path.stem] = Arm(robot, BASE)
    return arms


def measure_block(arm: Arm, seed: tuple[int, ...], num: int, step: float) -> list[dict]:
    """Certifies and scans `num` edges, of which every third grazes."""
    rng = np.random.default_rng(seed)
    reach = 0.9 if arm.base == "" else 0.7
    rows = []
    for i in range(num):
        edge, kind = draw_edge(rng, arm, reach), "plain"
        if i % 3 == 2:
            kind = "box pushed" if rng.random() < 0.5 else "lengthened"
            edge = (push_box if kind == "box pushed" else lengthen)(rng, arm, edge)
        found = scan(arm, edge, step)
        rows.append({"kind": kind, "gap": min(found.gap, 1.0), "scanned": found.num_configurations})
        if found.gap < 0:
            places = {"start": edge.start.tolist(), "end": edge.end.tolist()}
            boxes = {k: np.asarray(v).tolist() for k, v in edge.scene._asdict().items()}
            rows[-1] |= {"refuted": {**places, "scene": boxes}}
    return rows


def summarize(rows: list[dict]) -> dict:
    """Counts of an arm's edges, and how close those come that graze."""
    gaps = np.array([row["gap"] for row in rows if row["kind"] != "plain"])
    near = gaps[gaps < _MARGIN]
    return {
        "edges": len(rows),
        "grazing": len(gaps),
        "within_2mm": len(near),
        "median_gap_of_those_um": float(1e6 * np.median(near)) if len(near) else None,
        "least_gap_um": float(1e6 * min(row["gap"] for row in rows)) if rows else None,
        "configurations": int(sum(row["scanned"] for row in rows)),
        "refuted": sum("refuted" in row for row in rows),
    }


def run(config: CampaignConfig) -> dict:
    """Does what is missing of the campaign and returns its summary."""
    if config.num_edges < 1 or config.random_arms < 0 or not config.step > 0:
        raise InputError(
            f"num_edges is {config.num_edges}, random_arms {config.random_arms} and step "
            f"{config.step}; give at least 1, at least 0, and more than 0"
        )
    check_seed(config.seed)
    check_target(config.json)
    settings = {k: v for k, v in dataclasses.asdict(config).items() if k not in ("json", "runs")}
    arms = make_arms(config)
    each = -(-config.num_edges // len(arms))
    found: dict[str, list[dict]] = {name: [] for name in arms}
    turns = [(name, first) for first in range(0, each, _BLOCK) for name in arms]
    for name, first in track(turns, description="certifying and scanning"):
        num = min(_BLOCK, each - first)
        path = config.runs / f"{name}_{config.seed}_{first}_{num}_{config.step}.json"
        if not path.exists():
            seed = (config.seed, list(arms).index(name), first)
            _write(path, measure_block(arms[name], seed, num, config.step))
        found[name] += json.loads(path.read_text())
    found["all"] = [row for rows in found.values() for row in rows]
    summary = {name: summarize(rows) for name, rows in found.items()}
    _write(config.json, {"settings": settings, "arms": summary})
    _show(summary)
    return summary


def _write(path: Path, results: object) -> None:
    atomic_write(path, lambda file: file.write_text(json.dumps(results, indent=1) + "\n") and None)


def _show(summary: dict[str, dict]) -> None:
    columns = ("edges", "grazing", "within 2 mm", "median gap", "least gap", "scanned", "refuted")
    table = Table("arm", *columns, caption="gaps in micrometres; configurations scanned")
    for name, part in summary.items():
        texts = [
            "-" if x is None else f"{x:.0f}" if isinstance(x, float) else str(x)
            for x in part.values()
        ]
        table.add_row(name, *texts)
    Console().print(table)


if __name__ == "__main__":
    run_command(lambda: run(tyro.cli(CampaignConfig)) and None)
