"""Planning problems, and sets of them."""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Bool, Float

from gnnjax.arm.robot import Robot
from gnnjax.roadmap.sampled import sample_free
from gnnjax.scene.scene import Scene, sample_scene


class Problem(NamedTuple):
    """A query: get from start to goal through a scene."""

    start: Float[Array, "*batch D"]  # rad or m
    goal: Float[Array, "*batch D"]
    scene: Scene


@dataclasses.dataclass(frozen=True)
class ProblemSet:
    """P problems for one robot; the arrays are NumPy with a leading axis P."""

    robot: str
    problems: Problem
    extras: dict[str, np.ndarray] = dataclasses.field(default_factory=dict)  # kept as they are

    def __len__(self) -> int:
        return len(self.problems.start)

    def take(self, rows: slice | np.ndarray) -> "ProblemSet":
        """Some of the problems; extras that have one row a problem are cut likewise."""
        cut = {
            name: value[rows] if value.shape[:1] == (len(self),) else value
            for name, value in self.extras.items()
        }
        return ProblemSet(self.robot, jax.tree.map(lambda x: x[rows], self.problems), cut)


def sample_problem(
    key: jax.Array,
    robot: Robot,
    check_configurations: Callable[[Scene, jax.Array], jax.Array],
    boxes_clear: Callable[[Scene], Bool[Array, " M"]],
) -> Problem:
    """Draws a problem of the paper: a random scene, start and goal uniform in its free space.

    Where 800 draws find no free configuration, an end is q = 0, which the scene leaves clear.

    Args:
        key: randomness.
        robot: the arm.
        check_configurations: of a `Checker`.
        boxes_clear: tells for each box whether the arm at q = 0 is clear of it.
    """
    scene_key, ends_key = jax.random.split(key)
    scene = sample_scene(scene_key, boxes_clear)

    def check(q: jax.Array) -> jax.Array:
        return check_configurations(scene, q)

    # Sixteen draws a block, of which the first two that are free count.
    ends = sample_free(ends_key, check, robot.drawn_lower, robot.drawn_upper, 16, wanted=2)
    return Problem(ends.nodes[0], ends.nodes[1], scene)
