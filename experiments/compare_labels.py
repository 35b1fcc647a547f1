"""Which edges of roadmaps are valid, by the fused kernel, by MJX and by MuJoCo's C engine.

    python -m experiments.compare_labels --edges 20000 --json labels.json

Scenes are the paper's, in every second one of which the boxes are rotated at random; edges are
those of a random roadmap in each. Two of the three judges are `Checker.check_edges`; the engine
tests every configuration along an edge.

An edge that a judge calls valid and the engine blocked is an error, and the engine's least distance
where they differ is told: what is left of a millimetre's thousandth is float32. Edges that are
blocked needlessly are counted. The fused kernel tests hulls that stand out of the true ones by up
to 2 mm, MJX the spheres around them, so that all that is valid by MJX is by the kernel.
"""

import dataclasses
import functools
import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.engine import Engine
from gnnjax.arguments import parse_arguments
from gnnjax.arm.robot import Robot, load_robot
from gnnjax.collision.checker import EDGE_RESOLUTION, Checker, make_checker
from gnnjax.collision.fused import obstacles_clear
from gnnjax.errors import InputError, run_command
from gnnjax.files import atomic_write
from gnnjax.problems.problem import sample_scene
from gnnjax.roadmap.graph import Roadmap, default_radius, each_edge
from gnnjax.roadmap.sampled import sample_free, sample_roadmap
from gnnjax.scene.scene import Scene

_BLOCK = 1024  # edges labelled at once
_MARGIN = 0.02  # m; distances up to this are told
JUDGES = ("fused", "mjx")  # compared with the engine, and with one another


@dataclasses.dataclass(frozen=True)
class CompareConfig:
    """Labels of edges by all collision backends."""

    robot: str = "kuka_iiwa14"
    """Shipped robot, or path of an MJCF."""

    edges: int = 20_000
    """Edges, at least: roadmaps are drawn until there are as many."""

    num_nodes: int = 200
    """Nodes of a roadmap."""

    seed: int = 0
    """Seed of scenes and roadmaps."""

    json: Path | None = None
    """Where the results go."""


def compare(config: CompareConfig) -> dict[str, Any]:
    """Labels edges of scene after scene, and counts."""
    robot = load_robot(config.robot)
    checkers = {judge: make_checker(robot, judge) for judge in JUDGES}
    # Compiled once each: every scene has the same shapes.
    draw = jax.jit(functools.partial(_draw, robot, checkers["fused"], config.num_nodes))
    label = {judge: jax.jit(checker.check_edges) for judge, checker in checkers.items()}
    check = {judge: jax.jit(checker.check_configurations) for judge, checker in checkers.items()}
    result: dict[str, Any] = {
        "scenes": 0,
        "edges": 0,
        "configurations": 0,
        "valid": 0,
        "wrongly_valid": dict.fromkeys(JUDGES, 0),
        "needlessly_blocked": dict.fromkeys(JUDGES, 0),
        "valid_by_mjx_alone": 0,
        "errors": [],
    }
    while result["edges"] < config.edges:
        number = result["scenes"]
        key = jax.random.fold_in(jax.random.key(config.seed), number)
        scene, roadmap = jax.tree.map(np.asarray, draw(key, number % 2 == 1))
        starts, ends = _edges(roadmap)
        labels = {judge: _in_blocks(label[judge], scene, starts, ends) for judge in JUDGES}
        points, edge = _points(starts, ends)
        valid = np.ones(len(starts), bool)
        np.logical_and.at(valid, edge, Engine(robot, scene).valid(points.astype(float)))
        result["scenes"] += 1
        result["edges"] += len(starts)
        result["configurations"] += len(points)
        result["valid"] += int(valid.sum())
        result["valid_by_mjx_alone"] += int((labels["mjx"] & ~labels["fused"]).sum())
        for judge in JUDGES:
            wrong = np.flatnonzero(labels[judge] & ~valid)
            result["wrongly_valid"][judge] += len(wrong)
            result["needlessly_blocked"][judge] += int((valid & ~labels[judge]).sum())
            for row in wrong:
                there = points[edge == row]
                gaps = Engine(robot, scene, _MARGIN).gaps(there.astype(float))
                free = np.asarray(check[judge](scene, jnp.asarray(there)))
                deciding = gaps[free & (gaps <= 0)]
                result["errors"].append(
                    {
                        "scene": number,
                        "edge": int(row),
                        "judge": judge,
                        # The deepest; none where only the edge as a whole differs.
                        "engine_mm": 1e3 * float(deciding.min()) if len(deciding) else None,
                    }
                )
    return result


def _draw(
    robot: Robot, checker: Checker, num_nodes: int, key: jax.Array, rotated: jax.Array
) -> tuple[Scene, Roadmap]:
    scene_key, turn_key, ends_key, roadmap_key = jax.random.split(key, 4)
    scene = sample_scene(
        scene_key, lambda scene: obstacles_clear(robot, scene, jnp.zeros(robot.num_dof))
    )
    quats = jax.random.normal(turn_key, scene.quats.shape)
    quats = quats / jnp.linalg.norm(quats, axis=-1, keepdims=True)
    scene = scene._replace(quats=jnp.where(rotated, quats, scene.quats))
    check = functools.partial(checker.check_configurations, scene)
    ends = sample_free(ends_key, check, robot.joint_lower, robot.joint_upper, 16, wanted=2)
    radius = default_radius(robot, num_nodes)
    sampled = sample_roadmap(
        roadmap_key, check, robot, *ends.nodes[:2], num_nodes=num_nodes, radius=radius
    )
    return scene, sampled.roadmap


def _edges(roadmap: Roadmap) -> tuple[np.ndarray, np.ndarray]:
    """Both ends [E D] of every undirected edge, in the order in which `check_edges` tests them."""
    edges = each_edge(roadmap)
    near, far = roadmap.nodes[edges.first], roadmap.nodes[edges.second]
    first = np.argmax(near != far, axis=1)[:, None]
    swap = np.take_along_axis(near > far, first, axis=1)
    return np.where(swap, far, near), np.where(swap, near, far)


def _points(starts: np.ndarray, ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The configurations [P D] between the ends of all edges, and the edge [P] each lies on."""
    lengths = np.linalg.norm(ends - starts, axis=1)
    intervals = np.maximum(1, np.ceil(lengths / np.float32(EDGE_RESOLUTION))).astype(int)
    edge = np.repeat(np.arange(len(starts)), intervals - 1)
    first = np.cumsum(intervals - 1) - (intervals - 1)
    step = np.arange(len(edge)) - first[edge] + 1
    fraction = step.astype(np.float32) / intervals[edge].astype(np.float32)
    return starts[edge] + fraction[:, None] * (ends - starts)[edge], edge


def _in_blocks(label: Any, scene: Scene, starts: np.ndarray, ends: np.ndarray) -> np.ndarray:
    pad = -len(starts) % _BLOCK
    # Edges of no length cost nothing.
    blocks = [np.pad(x, ((0, pad), (0, 0))).reshape(-1, _BLOCK, x.shape[1]) for x in (starts, ends)]
    found = [np.asarray(label(scene, *block).valid) for block in zip(*blocks, strict=True)]
    return np.concatenate(found)[: len(starts)]


def main(config: CompareConfig) -> dict[str, Any]:
    """Compares, prints and writes; returns the results too."""
    if config.edges < 1 or config.num_nodes < 3:
        raise InputError(
            f"edges is {config.edges} and num_nodes {config.num_nodes}; give at least 1 and 3"
        )
    result = compare(config)
    print(
        f"{result['edges']} edges of {result['scenes']} scenes, {result['configurations']} "
        f"configurations along them; {100 * result['valid'] / result['edges']:.1f} % are valid"
    )
    for judge in JUDGES:
        print(
            f"{judge}: {result['wrongly_valid'][judge]} wrongly valid, "
            f"{result['needlessly_blocked'][judge]} needlessly blocked"
        )
    print(f"valid by mjx alone: {result['valid_by_mjx_alone']}")
    for row in result["errors"]:
        print(
            f"  edge {row['edge']} of scene {row['scene']}: {row['judge']} says valid, "
            f"the engine's distance there is {row['engine_mm']} mm"
        )
    if config.json is not None:
        settings = {k: v for k, v in dataclasses.asdict(config).items() if k != "json"}
        text = json.dumps({"settings": settings, **result}, indent=1) + "\n"
        atomic_write(config.json, lambda file: file.write_text(text) and None)
    return result


if __name__ == "__main__":
    run_command(lambda: main(parse_arguments(CompareConfig)) and None)
