"""Certified motions for the campaign against the certificate."""

import itertools
from collections.abc import Callable
from typing import NamedTuple

import jax
import mujoco
import numpy as np

from experiments.judge import ROOM, Arm
from gnnjax.collision.certify import certify_edges
from gnnjax.collision.clearances import clearances
from gnnjax.scene.batches import stack_scenes
from gnnjax.scene.cloud import Cloud
from gnnjax.scene.numbers import unit_quats
from gnnjax.scene.scene import Scene, scene_from_shapes
from gnnjax.scene.shapes import (
    KINDS,
    Shape,
    box,
    capsule,
    cylinder,
    for_every_kind,
    half_space,
    sphere,
)

_SCENES = 256  # at once, at most
_STARTS = 6  # a scene, of which those that are certified are kept
_OF_A_SCENE = 4  # which are so many, about
_LENGTHS = (0.2, 1.5)  # of edges, configuration units


class Edges(NamedTuple):
    """E motions, each in a scene of its own; shapes are in the order of the scene's obstacles."""

    shapes: list[list[Shape]]
    scenes: Scene  # [E M ...]
    clouds: list[tuple[np.ndarray, np.ndarray] | None]  # pose of the world's cloud
    starts: np.ndarray  # [E D]
    ends: np.ndarray  # [E D]

    def take(self, chosen: np.ndarray) -> "Edges":
        """Those of a mask `[E]`, or of some rows."""
        rows = np.arange(len(self.starts))[chosen]
        return Edges(
            [self.shapes[i] for i in rows],
            jax.tree.map(lambda x: x[rows], self.scenes),
            [self.clouds[i] for i in rows],
            self.starts[rows],
            self.ends[rows],
        )


def _draw_round(rng: np.random.Generator, make: Callable, reach: float) -> Shape:
    sizes = reach * rng.uniform([0.02, 0.03], [0.12, 0.35])
    return make(_place(rng, reach), *sizes.tolist(), rng.normal(size=4))


def _place(rng: np.random.Generator, reach: float) -> np.ndarray:
    return rng.uniform(-reach, reach, 3)


def _draw_half_space(rng: np.random.Generator, reach: float) -> Shape:
    normal = rng.normal(size=3)
    normal /= np.linalg.norm(normal)
    return half_space(-reach * rng.uniform(0.15, 0.9) * normal, normal)


# Obstacles within reach [m] of the base.
_DRAWS = for_every_kind(
    "campaign",
    box=lambda rng, reach: box(
        _place(rng, reach), reach * rng.uniform(0.03, 0.2, 3), rng.normal(size=4)
    ),
    sphere=lambda rng, reach: sphere(_place(rng, reach), reach * rng.uniform(0.03, 0.2)),
    capsule=lambda rng, reach: _draw_round(rng, capsule, reach),
    cylinder=lambda rng, reach: _draw_round(rng, cylinder, reach),
    half_space=_draw_half_space,
)


def draw_points(rng: np.random.Generator, reach: float) -> np.ndarray:
    """A patch of a surface `[K, 3]` m, about its middle, as sparse as a cloud may be."""
    u, v = rng.uniform(-1, 1, (2, int(rng.integers(20, 60))))
    bend = rng.uniform(-1, 1, 3)
    return (0.2 * reach * np.stack([u, v, bend @ [u * u, u * v, v * v]], axis=1)).astype("f4")


def draw_shapes(rng: np.random.Generator, reach: float) -> list[Shape]:
    """A few obstacles of any kinds; few of them are half-spaces, which bar half of the room."""
    num = int(rng.integers(1, 6))
    kinds = rng.choice(KINDS, num, p=[0.24, 0.23, 0.23, 0.23, 0.07])
    counts = {kind: min(int((kinds == kind).sum()), ROOM[kind]) for kind in KINDS}
    return [_DRAWS[kind](rng, reach) for kind, many in counts.items() for _ in range(many)]


def draw_edges(
    rng: np.random.Generator, arm: Arm, num: int, cloud: tuple[np.ndarray, float] | None
) -> Edges:
    """Certified edges, as they come.

    Args:
        rng: randomness.
        arm: whose motions they are.
        num: how many.
        cloud: points about their own origin, and radius of the balls, that are put somewhere.
    """
    drawn, found = [], 0
    while found < num:
        scenes = min(_SCENES, -(-(num - found) // _OF_A_SCENE))
        drawn.append(_draw_edges(rng, arm, scenes, cloud))
        found += len(drawn[-1].starts)
    shapes, scenes, poses, starts, ends = zip(*drawn, strict=True)
    every = Edges(
        list(itertools.chain(*shapes)),
        jax.tree.map(lambda *parts: np.concatenate(parts), *scenes),
        list(itertools.chain(*poses)),
        np.concatenate(starts),
        np.concatenate(ends),
    )
    return every.take(np.arange(num))


def _draw_edges(
    rng: np.random.Generator, arm: Arm, num: int, cloud: tuple[np.ndarray, float] | None
) -> Edges:
    """Those of `num` scenes."""
    robot, reach, scenes, shapes, poses = arm.robot, arm.reach, [], [], []
    for _ in range(num):
        shapes.append(draw_shapes(rng, reach))
        poses.append(
            None if cloud is None else (_place(rng, reach), unit_quats(rng.normal(size=4)))
        )
        scenes.append(_scene(shapes[-1], cloud, poses[-1]))
    stacked = stack_scenes(scenes)
    owner = np.repeat(np.arange(num), _STARTS)
    starts = rng.uniform(robot.joint_lower, robot.joint_upper, (len(owner), robot.num_dof))
    ways = directions(rng, *starts.shape) * rng.uniform(*_LENGTHS, (len(owner), 1))
    ends = np.clip(starts + ways, robot.joint_lower, robot.joint_upper)
    # What begins blocked costs most, and tells no more than what ends so.
    free = clearances(robot, stacked, starts, owner, 0.0) > 0
    starts, ends, owner = starts[free], ends[free], owner[free]
    held = np.flatnonzero(certify_edges(robot, stacked, starts, ends, owner))
    nothing = np.zeros((num, 0))
    every = Edges(shapes, stacked, poses, nothing, nothing).take(owner[held])
    return every._replace(starts=starts[held], ends=ends[held])


def _scene(shapes: list[Shape], cloud, pose) -> Scene:
    scene = scene_from_shapes(shapes)
    if cloud is None:
        return scene
    points, radius = cloud
    placed = (pose[0] + _turned(points.astype(float), pose[1])).astype(np.float32)
    # Without the grid, which certificates do not look at.
    nothing = np.zeros(3, np.float32)
    count = np.int32(len(points))
    return scene._replace(
        cloud=Cloud(placed, count, np.float32(radius), nothing, nothing + 1, nothing[:0])
    )


def _turned(points: np.ndarray, quat: np.ndarray) -> np.ndarray:
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, quat)
    return points @ matrix.reshape(3, 3).T


def directions(rng: np.random.Generator, *shape: int) -> np.ndarray:
    """Of length 1, `[N D]`."""
    ways = rng.normal(size=shape)
    return ways / np.linalg.norm(ways, axis=1, keepdims=True)
