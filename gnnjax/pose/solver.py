"""Damped least squares from many configurations towards poses.

Levenberg and Marquardt's steps with the damping of Sugihara, "Solvability-Unconcerned Inverse
Kinematics by the Levenberg-Marquardt Method" (2011): as large as the error, so that steps are short
far from the pose and Newton's close to it, and poses that cannot be reached are approached, too.
Joints at a limit that a step would push beyond it are left out of it, and what still leaves the
limits is put back onto them. All is seen from the pose that is wanted.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from gnnjax.arm.robot import Robot
from gnnjax.pose.chain import Chain, kinematics, materialized

LEVER = 0.3  # m a rad: what an angle is worth beside a distance while the error is made small
_STEPS = 20
_LEAST_DAMPING = 1e-6  # m^2
_TINY = 1e-12  # no division by zero


class Target(NamedTuple):
    """A pose that is wanted, and of which axes, in single precision."""

    position: Float[Array, "*batch 3"]  # m
    rotation: Float[Array, "*batch 3 3"]
    places: Float[Array, "*batch 3"]  # 1 where the place along an axis of the pose counts, else 0
    turns: Float[Array, "*batch 3"]  # likewise for turns about it; all count, or none, or two


class Reached(NamedTuple):
    """Where descents have ended."""

    q: Float[Array, "*batch D"]  # rad or m
    position_error: Float[Array, "*batch"]  # m, along the axes that count
    rotation_error: Float[Array, "*batch"]  # rad, likewise


def descend(robot: Robot, chain: Chain, target: Target, starts: Float[Array, "S D"]) -> Reached:
    """Brings a frame of the arm as close to a pose as steps from each of some configurations do.

    Args:
        robot: the arm.
        chain: of the frame.
        target: one pose.
        starts: where descents begin.
    """
    # From here on, descents come last.
    lower, upper = robot.joint_lower[:, None], robot.joint_upper[:, None]
    places, turns = target.places[:, None], target.turns[:, None]
    counts = jnp.concatenate([places, LEVER * turns])
    base = _from_pose(target)

    def step(_: jax.Array, q: jax.Array) -> jax.Array:
        frame, jacobian = kinematics(chain, base, q)
        sines, cosine = _turn(turns, frame)
        sine = jnp.sqrt(jnp.sum(sines * sines, axis=0))
        turning = sines * (jnp.arctan2(sine, cosine) / (sine + _TINY))
        wanted = materialized(-counts * jnp.concatenate([frame[:, 3], turning]))
        jacobian = counts * jacobian
        # A joint at its limit that would go beyond it.
        pull = jnp.sum(jacobian * wanted, axis=1)
        stopped = (pull > 0) & (q >= upper) | (pull < 0) & (q <= lower)
        jacobian = materialized(jnp.where(stopped[:, None], 0.0, jacobian))
        damping = 0.5 * jnp.sum(wanted * wanted, axis=0) + _LEAST_DAMPING
        system = jnp.sum(jacobian[:, :, None] * jacobian[:, None], axis=0)
        system += jnp.eye(6)[..., None] * damping
        moved = q + jnp.sum(jacobian * _solve(materialized(system), wanted), axis=1)
        return jnp.clip(moved, lower, upper)

    found = jax.lax.fori_loop(0, _STEPS, step, starts.T)
    frame, _ = kinematics(chain, base, found)
    away = places * frame[:, 3]
    sines, cosine = _turn(turns, frame)
    angle = jnp.arctan2(jnp.sqrt(jnp.sum(sines * sines, axis=0)), cosine)
    return Reached(
        found.T,
        jnp.sqrt(jnp.sum(away * away, axis=0)),
        angle * turns.max(),
    )


def _from_pose(target: Target) -> jax.Array:
    """The base of the arm, as the pose sees it, `[3 4 1]`."""
    turned = target.rotation.T
    place = -jnp.sum(turned * target.position, axis=1)
    return jnp.concatenate([turned, place[:, None]], axis=1)[..., None]


def _turn(turns: jax.Array, frame: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The turns of frames `[3 4 S]` against the pose: axis times sine, `[3 S]`, and cosine.

    Where turns about one axis of the pose do not count, they are the shortest of that axis.
    """
    r = frame[:, :3]
    whole = jnp.stack([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]]) / 2
    free = 1 - turns
    axis = jnp.sum(r * free, axis=1)
    is_free = turns.min() == 0
    return (
        jnp.where(is_free, jnp.cross(free, axis, axis=0), whole),
        jnp.where(is_free, jnp.sum(free * axis, axis=0), (r[0, 0] + r[1, 1] + r[2, 2] - 1) / 2),
    )


def _solve(system: jax.Array, right: jax.Array) -> jax.Array:
    """Solves symmetric, positive definite systems `[n n S]` by elimination; `[n S]`."""
    tops, left = [], jnp.concatenate([system, right[:, None]], axis=1)
    for _ in range(len(right)):
        top = left[0, 1:] / left[0, 0]
        tops.append(top)
        left = materialized(left[1:, 1:] - left[1:, :1] * top)
    found = right[:0]
    for top in reversed(tops):
        known = jnp.sum(top[:-1] * found, axis=0)
        found = materialized(jnp.concatenate([(top[-1] - known)[None], found]))
    return found
