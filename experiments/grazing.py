"""Certified motions that graze: as near to contact as the certificate lets them come."""

import dataclasses
import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import mujoco
import numpy as np

from experiments.campaign_edges import Edges, directions
from experiments.judge import Arm
from gnnjax.arm.robot import Robot
from gnnjax.collision import certify
from gnnjax.collision.gaps import members
from gnnjax.scene.scene import Scene

_BISECTIONS = 14
_PLACES = {"half_space": "point"}  # of others it is their center


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
        row, number = members(np.zeros(len(parts), int), parts)
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
    moving = robot.sphere_geoms[robot.sphere_bodies >= 0]
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
    ways = directions(rng, *starts.shape) * rng.uniform(2.0, 6.0, (len(starts), 1))
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
    return dataclasses.replace(robot, part_pairs=none, sphere_pairs=none)


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
