"""Problems of the families: a family's scene made to an arm's measure, and start and goal in it."""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Bool, Float

from gnnjax.arm.kinematics import forward_kinematics
from gnnjax.arm.parts import quat_to_matrix
from gnnjax.arm.robot import Robot
from gnnjax.errors import InputError
from gnnjax.problems.families import FAMILIES
from gnnjax.problems.problem import Problem
from gnnjax.problems.structures import FamilyScene, Region
from gnnjax.scene.cloud import cloud_of
from gnnjax.scene.scene import Scene, rotation_matrices

# Configurations drawn at once, of which the first so many with the tip in place are tested.
_BLOCK, _TESTED = 4096, 256
_MAX_BLOCKS = 12  # for either end, before the scene is drawn again
_UPRIGHT = 8  # times as many are drawn, and as fewer tested, where things are held upright
_MAX_SCENES = 100
# Of the balls around what a camera sees, in units of the reach: half of what its pixels are apart.
_SEEN_RADIUS = 0.02


class FamilyProblem(NamedTuple):
    """A problem of a family."""

    problem: Problem
    start_region: Region
    goal_region: Region
    found: Bool[Array, "*batch"]  # false where no scene had a start and a goal: no problem then


class Reach(NamedTuple):
    """What the tip of an arm reaches: a ball."""

    center: np.ndarray  # [3] m
    radius: float  # m


def sample_family_problem(
    key: jax.Array,
    family: str,
    robot: Robot,
    check_configurations: Callable[[Scene, jax.Array], jax.Array],
    obstacles_clear: Callable[[Scene], Bool[Array, " M"]],
) -> FamilyProblem:
    """Draws a problem of a family: start and goal uniform among valid configurations whose tip is
    in its region.

    A scene that touches the arm's base, or where draws find no start or no goal, is drawn again;
    after 100 of them `found` is false.

    Args:
        key: randomness.
        family: a key of `FAMILIES`.
        robot: the arm; for "upright", one that holds something.
        check_configurations: of a `Checker` for rotated boxes.
        obstacles_clear: tells for each obstacle whether what no joint moves is clear of it.
    """

    def attempt(number: jax.Array) -> FamilyProblem:
        keys = jax.random.split(jax.random.fold_in(key, number), 3)
        drawn = draw_family_scene(keys[0], family, robot)
        check = functools.partial(check_configurations, drawn.scene)
        clear = jnp.all(obstacles_clear(drawn.scene))

        def find_end(wanted, end):
            end_key, region = end
            q, found = _find_tip_in(end_key, region, drawn.tilt, robot, check, wanted)
            return found, q

        # A loop over both ends, so that the collision check is compiled once.
        regions = jax.tree.map(lambda *x: jnp.stack(x), drawn.start, drawn.goal)
        found, (start, goal) = jax.lax.scan(find_end, clear, (keys[1:], regions))
        return FamilyProblem(Problem(start, goal, drawn.scene), drawn.start, drawn.goal, found)

    def unfinished(state: tuple[jax.Array, FamilyProblem]) -> jax.Array:
        return ~state[1].found & (state[0] < _MAX_SCENES)

    def draw(state: tuple[jax.Array, FamilyProblem]) -> tuple[jax.Array, FamilyProblem]:
        return state[0] + 1, attempt(state[0])

    number = jnp.int32(0)
    blank = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(attempt, number))
    return jax.lax.while_loop(unfinished, draw, (number, blank))[1]


def tip_positions(robot: Robot, q: Float[Array, "*batch D"]) -> Float[Array, "*batch 3"]:
    """The arm's tip [m]: the middle of the last body's spheres, or of all fingers'; of an arm that
    holds something, that of what it took last."""
    body, point = _tip(robot)
    positions, rotations = forward_kinematics(robot, q)
    turned = jnp.sum(rotations[..., body, :, :] * jnp.asarray(point, q.dtype), axis=-1)
    return positions[..., body, :] + turned


def held_upright(robot: Robot, q: Float[Array, "*batch D"]) -> Float[Array, "*batch"]:
    """The cosine of the angle between the vertical and the z axis of what the arm holds.

    Raises:
        InputError: it holds nothing.
    """
    held = robot.held_bodies
    if not held:
        raise InputError(
            f"{robot.name} holds nothing to be upright; robot.attach(...), or --attach"
        )
    first = next(p for p, part in enumerate(robot.parts) if part.body == held[-1])
    axis = quat_to_matrix(robot.mj_model.geom_quat[robot.part_geoms[first]])[:, 2]
    _, rotations = forward_kinematics(robot, q)
    return jnp.sum(rotations[..., held[-1], 2, :] * jnp.asarray(axis, q.dtype), axis=-1)


def in_region(region: Region, points: Float[Array, "*batch 3"]) -> Bool[Array, "*batch"]:
    """Whether points [m] are inside a region."""
    axes = rotation_matrices(region.quat).T
    seen = jnp.sum((points - region.center)[..., None, :] * axes, axis=-1)
    return jnp.all(jnp.abs(seen) < region.half_extents, axis=-1)


@functools.cache
def arm_reach(robot: Robot) -> Reach:
    """Measures a ball that holds the tip, at 4,096 random configurations.

    Its centre is the mean position of the tip.
    """
    body, point = _tip(robot)
    data = mujoco.MjData(robot.mj_model)
    draws = np.random.default_rng(0).uniform(size=(4096, robot.num_dof))
    tips = []
    for data.qpos[:] in robot.joint_lower + draws * robot.joint_range:
        mujoco.mj_kinematics(robot.mj_model, data)
        # MuJoCo's body 0 is the world.
        tips.append(data.xpos[body + 1] + data.xmat[body + 1].reshape(3, 3) @ point)
    center = np.mean(tips, axis=0)
    return Reach(center, float(np.linalg.norm(tips - center, axis=1).max()))


def _tip(robot: Robot) -> tuple[int, np.ndarray]:
    """The body that has the tip, and where this is in its frame `[3]`, m."""
    if held := robot.held_bodies:
        return held[-1], robot.sphere_centers[robot.sphere_bodies == held[-1]].mean(axis=0)
    last = int(robot.sphere_bodies.max())
    end, points = robot.bodies[last], []
    for center, b in zip(robot.sphere_centers, robot.sphere_bodies.tolist(), strict=True):
        body = robot.bodies[b]
        beside = b >= 0 and body.parent == end.parent and not (body.joints or end.joints)
        if b == last:
            points.append(center)
        elif beside:  # the fingers of a hand
            placed = body.position + body.rotation @ center
            points.append(end.rotation.T @ (placed - end.position))
    return last, np.mean(points, axis=0)


def draw_family_scene(key: jax.Array, family: str, robot: Robot) -> FamilyScene:
    """A scene of a family made to an arm's measure; its boxes may touch the arm's base."""
    return _scaled(FAMILIES[family](key), arm_reach(robot))


def _scaled(drawn: FamilyScene, reach: Reach) -> FamilyScene:
    center = jnp.asarray(reach.center, jnp.float32)

    def region(part: Region) -> Region:
        return Region(
            center + reach.radius * part.center, reach.radius * part.half_extents, part.quat
        )

    scene = drawn.scene._replace(
        centers=center + reach.radius * drawn.scene.centers,
        half_extents=reach.radius * drawn.scene.half_extents,
        radii=reach.radius * drawn.scene.radii,
    )
    if drawn.seen is not None:
        points = center + reach.radius * drawn.seen
        scene = scene._replace(cloud=cloud_of(points, _SEEN_RADIUS * reach.radius))
    return FamilyScene(scene, region(drawn.start), region(drawn.goal), tilt=drawn.tilt)


def _find_tip_in(
    key: jax.Array,
    region: Region,
    tilt: jax.Array | None,
    robot: Robot,
    check: Callable[[jax.Array], jax.Array],
    wanted: jax.Array,
) -> tuple[jax.Array, jax.Array]:
    """The first valid configuration with the tip in a region, and whether there is one."""
    lower, upper = robot.drawn_lower, robot.drawn_upper
    block, most_tested = _BLOCK, _TESTED
    if tilt is not None:
        block, most_tested = block * _UPRIGHT, most_tested // _UPRIGHT

    def unfinished(state):
        blocks, _, found = state
        return wanted & ~found & (blocks < _MAX_BLOCKS)

    def draw_block(state):
        blocks, *_ = state
        block_key = jax.random.fold_in(key, blocks)
        q = jax.random.uniform(block_key, (block, len(lower)), minval=lower, maxval=upper)
        # Kinematics are cheap and regions small: few of the draws go on to the collision check.
        inside = in_region(region, tip_positions(robot, q))
        if tilt is not None:
            inside &= held_upright(robot, q) > jnp.cos(tilt)
        rows = jnp.nonzero(inside, size=most_tested, fill_value=block)[0]
        tested = q[jnp.minimum(rows, block - 1)]
        valid = check(tested) & (rows < block)
        return blocks + 1, tested[jnp.argmax(valid)], jnp.any(valid)

    nothing = jnp.zeros(len(lower), jnp.float32)
    state = jnp.int32(0), nothing, jnp.zeros((), bool)
    _, q, found = jax.lax.while_loop(unfinished, draw_block, state)
    return q, found
