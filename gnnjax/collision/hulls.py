"""The arm's parts as they are, for what its spheres leave open: planes between hulls.

A plane that has a part on one side and an obstacle, or another part, on the other shows that they
are apart, and by how much, whoever found it. So planes are looked for by the planner's own code in
single precision (`convex.py`), and what they show is computed here in double precision: the least
height of a part's vertices above the plane, less the greatest of the other's points. Arrays have
their components first and what they are computed for last, see `obstacles.py`.
"""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from gnnjax.arm.robot import Robot
from gnnjax.collision import convex
from gnnjax.collision.exact import hulls_of
from gnnjax.collision.obstacles import Obstacles, dot, sum_of_squares
from gnnjax.kept import keep

_BEYOND = 1e-6  # m; how much more than the margin is asked for, before points
_PAIRS_A_CALL = 128  # that planes are looked for at once; fixed, so that it is compiled once


class Hulls:
    """The parts of an arm, and planes between them and what they may touch."""

    def __init__(self, robot: Robot):
        self.radii = np.array([part.radius for part in robot.parts])
        self.vertices = [part.vertices for part in robot.parts]
        low, high = (
            np.stack([f(x, axis=0) for x in self.vertices], axis=1) for f in (np.min, np.max)
        )
        # A box around each part, in its body's frame, `[3, T]` m.
        self._middles, self._halves = (low + high) / 2, (high - low) / 2 + self.radii
        self._parts = hulls_of(robot)
        self._to_obstacles = keep(convex.separate_obstacles)
        self._to_parts = keep(convex.separate_parts)

    def compile(self) -> None:
        """Compiles what looks for planes."""
        part, three, one = np.zeros(1, int), np.zeros((3, 1)), np.zeros(1)
        nothing = part, three, np.zeros((3, 3, 1))
        self._look(self._to_obstacles, *nothing, convex.Sums(three, one, one))
        self._look(self._to_parts, *nothing, part, three, one)

    def from_obstacles(
        self,
        part: np.ndarray,
        frames: np.ndarray,
        obstacles: Obstacles,
        number: np.ndarray,
        scene: np.ndarray,
        margin: np.ndarray,
    ) -> np.ndarray:
        """How far parts are from obstacles at least, `[N]` m, as far as `margin` is concerned.

        Args:
            part: `[N]` of the arm.
            frames: `[4, 3, N]` axes and origin of each part's body.
            obstacles: of P scenes.
            number: `[N]` of the obstacle in its scene.
            scene: `[N]`.
            margin: `[N]` m; whether they are farther apart is all that is asked.
        """
        centers, axes, extents, disc, ball = obstacles.sums(number, scene)
        offset = frames[3] - centers
        position, rotation = _seen(axes, offset, frames[:3])
        shapes = convex.Sums(extents, disc, ball + margin)
        directions = self._look(self._to_obstacles, part, position, rotation, shapes)
        # In the world: a column of `axes` is what the obstacle's axes are there.
        normal = _unit(dot(axes, directions))
        along = dot(axes.swapaxes(0, 1), normal)
        beside = np.sqrt(along[0] * along[0] + along[1] * along[1])
        thick = sum(np.abs(x) * h for x, h in zip(along, extents, strict=True))
        top = dot(normal, centers) + thick + disc * beside + ball
        return self._lowest(part, frames, normal) - top

    def from_parts(
        self,
        part: np.ndarray,
        frames: np.ndarray,
        other: np.ndarray,
        other_frames: np.ndarray,
        margin: np.ndarray,
    ) -> np.ndarray:
        """How far parts are from other parts; see `from_obstacles`."""
        offset = frames[3] - other_frames[3]
        axes = other_frames[:3]
        position, rotation = _seen(axes, offset, frames[:3])
        directions = self._look(self._to_parts, part, position, rotation, other, position, margin)
        normal = _unit(dot(axes, directions))
        return self._lowest(part, frames, normal) + self._lowest(other, other_frames, -normal)

    def from_clouds(
        self,
        part: np.ndarray,
        frames: np.ndarray,
        obstacles: Obstacles,
        scene: np.ndarray,
        margin: np.ndarray,
    ) -> np.ndarray:
        """How far parts are from clouds; see `from_obstacles`.

        Of the points that may be too near, the one that seems nearest is asked about, and every
        plane that is found counts for all of a part's points.
        """
        offset = self._middles[:, part]
        middle = frames[3] + sum(axis * x for axis, x in zip(frames[:3], offset, strict=True))
        around = np.sqrt(sum_of_squares(self._halves[:, part]))
        ball, enough = obstacles.cloud_radii[scene], margin + _BEYOND
        row, points = obstacles.cloud_points(middle, around + ball + enough, scene)
        away = points - middle[:, row]
        beside = [
            np.abs(dot(axis[:, row], away)) - self._halves[a, part[row]]
            for a, axis in enumerate(frames[:3])
        ]
        gap = np.max(beside, axis=0) - ball[row]
        left = np.flatnonzero(~(gap > enough[row]))
        row, points, gap = row[left], points[:, left], gap[left]
        # The nearest point that was asked about; what is farther away does not matter.
        nearest, asked = enough.copy(), np.zeros(len(row), bool)
        while True:
            open_points = np.flatnonzero(~asked & (gap < nearest[row]) & (nearest[row] > 0))
            if not len(open_points):
                return nearest
            # Of each part, the first in order of their gaps.
            order = open_points[np.lexsort((gap[open_points], row[open_points]))]
            chosen = order[np.flatnonzero(np.diff(row[order], prepend=-1))]
            asked[chosen] = True
            of = row[chosen]
            seen = frames[..., of]
            shapes = convex.Sums(np.zeros(points[:, chosen].shape), 0 * of, ball[of] + margin[of])
            normal = _unit(
                self._look(
                    self._to_obstacles,
                    part[of],
                    seen[3] - points[:, chosen],
                    seen[:3].swapaxes(0, 1),
                    shapes,
                )
            )
            height = np.full(len(part), -np.inf)
            height[of] = self._lowest(part[of], seen, normal) - ball[of]
            normals = np.zeros((3, len(part)))
            normals[:, of] = normal
            gap = np.maximum(gap, height[row] - dot(normals[:, row], points))
            nearest[of] = np.minimum(nearest[of], gap[chosen])

    def _look(self, separate: Callable[..., convex.Separation], *pairs: Any) -> np.ndarray:
        """Directions `[3, N]` of planes, looked for in calls of one size."""
        # Arrays go to the compiled function as they are, which takes a tenth of the time of
        # putting them on the device one by one.
        num, found = len(pairs[0]), []
        leaves, tree = jax.tree.flatten(pairs)
        leaves = [x.astype(np.int32 if x.dtype.kind == "i" else np.float32) for x in leaves]
        for first in range(0, num, _PAIRS_A_CALL):
            # The first of them again until the call is full.
            rows = first + np.arange(_PAIRS_A_CALL) % min(num - first, _PAIRS_A_CALL)
            own = jax.tree.unflatten(tree, [x.take(rows, axis=-1) for x in leaves])
            found.append(separate(self._parts, *own).directions)
        return np.concatenate([np.asarray(x) for x in found], axis=1)[:, :num].astype(float)

    def _lowest(self, part: np.ndarray, frames: np.ndarray, normal: np.ndarray) -> np.ndarray:
        """The least height of parts `[N]` along normals `[3, N]`."""
        seen = dot(frames[:3].swapaxes(0, 1), normal)
        found = np.empty(len(part))
        for number in np.unique(part):
            rows = np.flatnonzero(part == number)
            heights = self.vertices[number] @ seen[:, rows]
            found[rows] = heights.min(axis=0) - self.radii[number]
        return found + dot(normal, frames[3])


def _seen(
    axes: np.ndarray, offset: np.ndarray, columns: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """A position `[3, N]` and a rotation `[3, 3, N]`, given by its columns, along axes."""
    rows = axes.swapaxes(0, 1)
    return dot(rows, offset), dot(rows[:, :, None], columns.swapaxes(0, 1)[:, None])


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Of length 1; those of length 0 stay, and show nothing."""
    lengths = np.sqrt(sum_of_squares(vectors))
    return vectors / np.where(lengths > 0, lengths, 1)
