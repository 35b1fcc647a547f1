"""Certified motions for the campaign against the certificate, and those that graze."""

import dataclasses
import functools
import itertools
from collections.abc import Callable
from typing import NamedTuple

import jax
import mujoco
import numpy as np

from experiments.judge import ROOM, Arm
from gnnjax.arm.robot import Robot
from gnnjax.collision import certify
from gnnjax.collision.certify import clearances
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
_BISECTIONS = 14
_LENGTHS = (0.2, 1.5)  # of edges, configuration units
_PLACES = {"half_space": "point"}  # of others it is their center


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
    ways = _directions(rng, *starts.shape) * rng.uniform(*_LENGTHS, (len(owner), 1))
    ends = np.clip(starts + ways, robot.joint_lower, robot.joint_upper)
    # What begins blocked costs most, and tells no more than what ends so.
    free = clearances(robot, stacked, starts, owner, 0.0) > 0
    starts, ends, owner = starts[free], ends[free], owner[free]
    held = np.flatnonzero(Pieces(starts, ends, owner).certified(robot, stacked))
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


def _directions(rng: np.random.Generator, *shape: int) -> np.ndarray:
    ways = rng.normal(size=shape)
    return ways / np.linalg.norm(ways, axis=1, keepdims=True)


class Pieces(NamedTuple):
    """C straight lines, each a part of a motion; and curves along them."""

    starts: np.ndarray  # [C D]
    ends: np.ndarray  # [C D]
    owner: np.ndarray  # [C] of which motion each is a part
    slack: np.ndarray | None = None  # [C D] how far the curve may be from the line, rad or m

    def take(self, rows: np.ndarray) -> "Pieces":
        return Pieces(*(x if x is None else x[rows] for x in self))

    def cut(self) -> "Pieces":
        """In as many as the certificate makes of them, which looks at each by itself."""
        parts = np.linalg.norm(self.ends - self.starts, axis=1) / certify.FIRST_CUT
        parts = np.maximum(1, np.ceil(parts)).astype(int)
        row = np.repeat(np.arange(len(parts)), parts)
        number = np.arange(len(row)) - np.repeat(np.cumsum(parts) - parts, parts)
        low, high = number / parts[row], (number + 1) / parts[row]
        way = (self.ends - self.starts)[row]
        begin, end = (self.starts[row] + x[:, None] * way for x in (low, high))
        return self.take(row)._replace(starts=begin, ends=end)

    def certified(self, robot: Robot, scenes: Scene) -> np.ndarray:
        """Which of them are certified, each in the scene of its motion, `[C]`."""
        return certify.certify_edges(robot, scenes, self.starts, self.ends, self.owner, self.slack)


def push(rng: np.random.Generator, arm: Arm, edges: Edges, pieces: Pieces | None = None) -> Edges:
    """Edges with an obstacle each, or its cloud, pushed towards the arm while certificates hold.

    Args:
        rng: randomness.
        arm: whose motions they are.
        edges: certified ones.
        pieces: what of them is certified; by default the whole edges.
    """
    robot, scenes, num = arm.robot, edges.scenes, len(edges.starts)
    pieces = pieces or Pieces(edges.starts, edges.ends, np.arange(num))
    data = mujoco.MjData(robot.mj_model)  # whose world is the base
    moving = robot.geom_ids[robot.geom_bodies >= 0]
    chosen, ways = np.zeros(num, int), np.zeros((num, 3))
    for i, (own, pose) in enumerate(zip(edges.shapes, edges.clouds, strict=True)):
        data.qpos[:] = edges.starts[i] + rng.random() * (edges.ends[i] - edges.starts[i])
        mujoco.mj_kinematics(robot.mj_model, data)
        target = data.geom_xpos[rng.choice(moving)]
        chosen[i] = rng.integers(len(own))
        if pose is not None:
            ways[i] = target - pose[0]
            continue
        values = own[chosen[i]].values
        ways[i] = target - values[_PLACES.get(own[chosen[i]].kind, "center")]
        if "normal" in values:
            ways[i] = ways[i] @ values["normal"] * values["normal"]

    def pushed(share: np.ndarray) -> Scene:
        shift = (share[:, None] * ways).astype(np.float32)
        if scenes.cloud is not None:
            points = scenes.cloud.points + shift[:, None]
            return scenes._replace(cloud=scenes.cloud._replace(points=points))
        centers = scenes.centers.copy()
        centers[np.arange(num), chosen] += shift
        return scenes._replace(centers=centers)

    def alone(scenes: Scene) -> Scene:
        """Scenes with nothing in them but what is pushed."""
        one = jax.tree.map(
            lambda x: x[np.arange(num), chosen][:, None], scenes._replace(cloud=None)
        )
        return one._replace(cloud=scenes.cloud, mask=one.mask & (scenes.cloud is None))

    # Nothing else changes, so it is left out of the search, and so are pieces that hold at larger
    # shares where others do not. What comes out is certified as it is.
    without_itself, open_pieces = _without_itself(robot), pieces.cut()

    def seem_free(share: np.ndarray) -> np.ndarray:
        nonlocal open_pieces
        good = open_pieces.certified(without_itself, alone(pushed(share)))
        blocked = np.isin(np.arange(num), open_pieces.owner[~good])
        open_pieces = open_pieces.take(~(good & blocked[open_pieces.owner]))
        return ~blocked

    def are_free(share: np.ndarray, rows: np.ndarray) -> np.ndarray:
        own = pieces.take(np.isin(pieces.owner, rows))
        return ~np.isin(rows, own.owner[~own.certified(robot, pushed(share))])

    share = _bisect(num, seem_free, are_free)
    shapes, clouds = [list(own) for own in edges.shapes], list(edges.clouds)
    for i, shift in enumerate((share[:, None] * ways).astype(np.float32).astype(float)):
        pose, own = clouds[i], shapes[i][chosen[i]]
        if pose is not None:
            clouds[i] = pose[0] + shift, pose[1]
            continue
        place = _PLACES.get(own.kind, "center")
        values = {**own.values, place: own.values[place] + shift}
        shapes[i][chosen[i]] = own._replace(values=values)
    return edges._replace(scenes=pushed(share), shapes=shapes, clouds=clouds)


def lengthen(rng: np.random.Generator, arm: Arm, edges: Edges) -> Edges:
    """Edges in directions of their own, as long as certificates hold."""
    robot, starts, num = arm.robot, edges.starts, len(edges.starts)
    ways = _directions(rng, *starts.shape) * rng.uniform(2.0, 6.0, (len(starts), 1))
    ways = np.clip(starts + ways, robot.joint_lower, robot.joint_upper) - starts

    def are_free(share: np.ndarray, rows: np.ndarray) -> np.ndarray:
        ends = starts[rows] + share[rows, None] * ways[rows]
        return Pieces(starts[rows], ends, rows).certified(robot, edges.scenes)

    every = np.arange(num)
    share = _bisect(num, lambda share: are_free(share, every), are_free)
    ends = starts + share[:, None] * ways
    return edges._replace(ends=np.where(share[:, None] > 0, ends, edges.ends))


@functools.cache
def _without_itself(robot: Robot) -> Robot:
    """An arm that may touch itself."""
    none = np.zeros((0, 2), np.int64)
    return dataclasses.replace(robot, part_pairs=none, self_pairs=none)


def _bisect(
    num: int,
    seem: Callable[[np.ndarray], np.ndarray],
    hold: Callable[[np.ndarray, np.ndarray], np.ndarray],
) -> np.ndarray:
    """About the largest shares from 0 to 1 at which something holds, `[num]`; or 0.

    Args:
        num: of shares.
        seem: whether it likely holds at shares.
        hold: whether it does, of some rows. Where it does not after all, shares are made smaller.
    """
    low, high = np.zeros(num), np.ones(num)
    whole = seem(high)
    for _ in range(_BISECTIONS):
        middle = (low + high) / 2
        good = seem(middle)
        low, high = np.where(good, middle, low), np.where(good, high, middle)
    share, less, rows = np.where(whole, 1.0, low), 0.5**_BISECTIONS, np.arange(num)
    while len(rows := rows[(share[rows] > 0) & ~hold(share, rows)]):
        share[rows], less = np.maximum(share[rows] - less, 0), 2 * less
    return share
