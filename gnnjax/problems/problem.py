"""Planning problems, and sets of them."""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from gnnjax.arm.robot import Robot
from gnnjax.errors import InputError, as_typed, brief
from gnnjax.roadmap.sampled import sample_free
from gnnjax.scene.scene import OBSTACLE_BUCKETS, Scene, box_scene
from gnnjax.scene.shapes import IDENTITY_QUAT


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

    def check(self) -> None:
        """Refuses what is no set of problems, of an arm that is told by its name.

        Raises:
            InputError: naming what is wrong and what it should be.
        """
        if not (isinstance(self.robot, str) and isinstance(self.problems, Problem)):
            kinds = type(self.robot).__name__, type(self.problems).__name__
            raise InputError(
                f"a problem set has a {kinds[0]} and a {kinds[1]}; give the arm's name and a "
                "Problem: ProblemSet(robot.name, Problem(start, goal, stack_scenes(scenes)))"
            )
        scene = self.problems.scene
        try:
            with np.errstate(over="ignore"):  # infinite in single precision, and refused as such
                start, goal = (np.asarray(x, np.float32) for x in self.problems[:2])
        except (TypeError, ValueError, OverflowError):
            raise InputError(
                "start and goal of a problem set are no numbers [P D]; give a row for each problem"
            ) from None
        mask = np.shape(scene.mask) if isinstance(scene, Scene) else ()
        shapes = start.shape, goal.shape, mask
        if len(shapes[0]) != 2 or shapes[1] != shapes[0] or shapes[2][:-1] != shapes[0][:1]:
            raise InputError(
                f"a problem set has start {shapes[0]}, goal {shapes[1]} and the mask of its scenes "
                f"{shapes[2]}; they are [P D], [P D] and [P M], of scenes that stack_scenes joined"
            )
        for name, q in (("start", start), ("goal", goal)):
            where = np.flatnonzero(~np.isfinite(q).all(axis=1))
            if len(where):
                raise InputError(
                    f"{name} of problem {where[0]} is {brief(as_typed(q[where[0]]))}; it must be "
                    "finite"
                )

    def take(self, rows: slice | np.ndarray) -> "ProblemSet":
        """Some of the problems; extras that have one row a problem are cut likewise."""
        cut = {
            name: value[rows] if value.shape[:1] == (len(self),) else value
            for name, value in self.extras.items()
        }
        return ProblemSet(self.robot, jax.tree.map(lambda x: x[rows], self.problems), cut)


def sample_scene(
    key: jax.Array,
    obstacles_clear: Callable[[Scene], Bool[Array, " M"]],
    *,
    max_obstacles: int = OBSTACLE_BUCKETS[0],
    min_num: int = 2,
    max_num: int = 9,
    candidates: int = 8,
) -> Scene:
    """Draws a scene of the paper: axis-aligned boxes that leave the arm at q = 0 free.

    Between `min_num` and `max_num` boxes, half extents uniform in [0.1, 0.3] m and centres uniform
    in [-1, 1] x [-1, 1] x [0.5, 1.3] m. A box that touches the arm is drawn again: of `candidates`
    draws a box, the first that is clear counts, and a box with none is left out (about 1 in 10^8
    for the iiwa, which touches 9 % of them).

    Args:
        key: randomness.
        obstacles_clear: tells for each obstacle of a scene whether the arm at q = 0 is clear of it.
    """
    num_key, size_key, center_key = jax.random.split(key, 3)
    shape = (max_obstacles * candidates, 3)
    half_extents = jax.random.uniform(size_key, shape, minval=0.1, maxval=0.3)
    centers = jax.random.uniform(
        center_key, shape, minval=jnp.array([-1.0, -1.0, 0.5]), maxval=jnp.array([1.0, 1.0, 1.3])
    )
    quats = jnp.tile(jnp.array(IDENTITY_QUAT), (shape[0], 1))
    everything = box_scene(centers, half_extents, quats, jnp.ones(shape[0], bool))
    clear = obstacles_clear(everything).reshape(max_obstacles, candidates)
    chosen = jnp.arange(max_obstacles) * candidates + jnp.argmax(clear, axis=1)
    num = jax.random.randint(num_key, (), min_num, max_num + 1)
    mask = (jnp.arange(max_obstacles) < num) & jnp.any(clear, axis=1)
    return box_scene(centers[chosen], half_extents[chosen], quats[chosen], mask)


def sample_problem(
    key: jax.Array,
    robot: Robot,
    check_configurations: Callable[[Scene, jax.Array], jax.Array],
    obstacles_clear: Callable[[Scene], Bool[Array, " M"]],
) -> Problem:
    """Draws a problem of the paper: a random scene, start and goal uniform in its free space.

    Where 800 draws find no free configuration, an end is q = 0, or the nearest to it within the
    limits, which the scene leaves clear.

    Args:
        key: randomness.
        robot: the arm.
        check_configurations: of a `Checker`.
        obstacles_clear: tells for each obstacle whether the arm at q = 0 is clear of it.
    """
    return draw_problem(key, robot, check_configurations, obstacles_clear)[0]


def draw_problem(
    key: jax.Array,
    robot: Robot,
    check_configurations: Callable[[Scene, jax.Array], jax.Array],
    obstacles_clear: Callable[[Scene], Bool[Array, " M"]],
) -> tuple[Problem, Bool[Array, " 2"]]:
    """`sample_problem`, and whether start and goal were found."""
    scene_key, ends_key = jax.random.split(key)
    scene = sample_scene(scene_key, obstacles_clear)

    def check(q: jax.Array) -> jax.Array:
        return check_configurations(scene, q)

    # Sixteen draws a block, of which the first two that are free count.
    ends = sample_free(ends_key, check, robot.drawn_lower, robot.drawn_upper, 16, wanted=2)
    upright = jnp.asarray(near_zero(robot))
    start, goal = jnp.where(ends.mask[:2, None], ends.nodes[:2], upright)
    return Problem(start, goal, scene), ends.mask[:2]


def near_zero(robot: Robot) -> np.ndarray:
    """The configuration within an arm's limits that is nearest to zero, `[D]`."""
    zero = np.zeros(robot.num_dof, np.float32)
    return np.clip(zero, robot.joint_lower, robot.joint_upper)
