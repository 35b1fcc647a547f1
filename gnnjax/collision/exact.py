"""Configurations that spheres leave open, decided by the arm's parts themselves.

Spheres around a part that touch something prove nothing, and spheres inside of it that touch
nothing neither. For what lies between, this module finds the pairs of a part and an obstacle, or of
two parts, whose spheres touch, and has each tested as convex bodies (`convex.py`), some at a time,
until one is found in contact or all are apart.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, UInt

from gnnjax.arm.hulls import simplify
from gnnjax.arm.kinematics import WORLD, body_frames, joint_terms
from gnnjax.arm.robot import Robot
from gnnjax.collision import convex

SIMPLER = 2e-3  # m; by which the hulls that are tested may stand out of the true ones
WORD = 32  # bits


class Touching(NamedTuple):
    """Which spheres touch at C configurations, as bits of words."""

    # Bit p % 32 of word p // 32: spheres of part p touch the obstacle.
    parts: UInt[Array, "M W C"]
    # Bit u % 32 of word u // 32: spheres of the two of `Robot.part_pairs[u]` touch.
    pairs: UInt[Array, "V C"]


class Placed(NamedTuple):
    """M obstacles, for each of C configurations its own."""

    origins: Float[Array, "M 3 C"]  # m, of the base, seen from the obstacle
    rotations: Float[Array, "M 3 3 C"]  # base to obstacle
    half_extents: Float[Array, "M 3 C"]  # m
    radii: Float[Array, "M 2 C"]  # m, of disc and ball


def hulls_of(robot: Robot) -> convex.Parts:
    """The arm's parts, with few vertices each, standing out by `SIMPLER` at most."""
    vertices, radii = _simpler(robot)
    return convex.Parts(jnp.asarray(vertices), jnp.asarray(radii))


@functools.cache
def _simpler(robot: Robot) -> tuple[np.ndarray, np.ndarray]:
    """Vertices `[T V 3]` and radii `[T]`; a second of work that kernels and certificates share."""
    simple = [
        (p.vertices, 0.0) if len(p.vertices) <= 8 else simplify(p.vertices, SIMPLER)
        for p in robot.parts
    ]
    most = max(len(vertices) for vertices, _ in simple)
    vertices = [np.pad(v, ((0, most - len(v)), (0, 0)), "edge") for v, _ in simple]
    radii = [p.radius + more for p, (_, more) in zip(robot.parts, simple, strict=True)]
    return np.array(vertices, np.float32), np.array(radii, np.float32)


def exact_test(robot: Robot) -> Callable[[Placed, Touching, Float[Array, "C D"]], jax.Array]:
    """Makes the function `(obstacles, touching, q [C D]) -> [C]`, true where the arm is free."""
    hulls = hulls_of(robot)
    # The world's frame comes last.
    bodies = jnp.array([part.body for part in robot.parts])
    couples = jnp.asarray(robot.part_pairs.T)

    def free(obstacles: Placed, touching: Touching, q: Float[Array, "C D"]) -> Bool[Array, " C"]:
        frames = _frames(robot, q)

        def from_obstacles(pair: jax.Array, at: jax.Array) -> jax.Array:
            number, part = jnp.divmod(pair, len(bodies))
            own = Placed(*(x[number, ..., at] for x in obstacles))  # [N ...]
            turned = jnp.moveaxis(own.rotations, 0, -1)
            position, rotation = _seen(turned, *frames[bodies[part], at])
            position = position + own.origins.T
            disc, ball = own.radii.T
            shapes = convex.Obstacles(own.half_extents.T, disc, ball)
            return convex.separate_obstacles(hulls, part, position, rotation, shapes, position).gaps

        def from_parts(pair: jax.Array, at: jax.Array) -> jax.Array:
            first, second = couples[:, pair]
            origin, axes = frames[bodies[first], at]
            base, seen_from = frames[bodies[second], at]
            turned = jnp.swapaxes(seen_from, 0, 1)
            position, rotation = _seen(turned, origin - base, axes)
            nothing = jnp.zeros(len(pair))
            return convex.separate_parts(
                hulls, first, position, rotation, second, position, nothing
            ).gaps

        valid = jnp.ones(len(q), bool)
        valid = _test_pairs(_bits(touching.parts, len(bodies)), from_obstacles, valid)
        if couples.size:
            valid = _test_pairs(_bits(touching.pairs, couples.shape[1]), from_parts, valid)
        return valid

    return free


class _Frames:
    """Where bodies are at C configurations; `frames[body, at]` are `[3 N]` and `[3 3 N]`."""

    def __init__(self, origins: jax.Array, axes: jax.Array):
        self.origins, self.axes = origins, axes  # [L 3 C], [L 3 3 C]

    def __getitem__(self, where: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        body, at = where
        return self.origins[body, :, at].T, jnp.moveaxis(self.axes[body, :, :, at], 0, -1)


def _frames(robot: Robot, q: jax.Array) -> _Frames:
    def full(component: Any) -> jax.Array:
        return jnp.broadcast_to(jnp.asarray(component, q.dtype), len(q))

    frames = [*body_frames(robot, joint_terms(robot, q)), WORLD]
    origins = jnp.stack([jnp.stack([full(x) for x in origin]) for origin, _ in frames])
    axes = [jnp.stack([jnp.stack([full(x) for x in row]) for row in rows]) for _, rows in frames]
    return _Frames(origins, jnp.stack(axes))


def _seen(turned: jax.Array, origin: jax.Array, axes: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Frames `[3 N]`, `[3 3 N]`, turned by rotations `[3 3 N]`."""
    position = jnp.sum(turned * origin, axis=1)
    return position, jnp.sum(turned[:, :, None] * axes[None], axis=1)


def _bits(words: jax.Array, num: int) -> jax.Array:
    """Words `[..., W, C]` as booleans `[..., num, C]`."""
    place = jnp.arange(num)
    return (words[..., place // WORD, :] >> (place % WORD)[:, None]) & 1 > 0


def _test_pairs(
    wanted: Bool[Array, "... C"],
    gaps: Callable[[jax.Array, jax.Array], jax.Array],
    valid: Bool[Array, " C"],
) -> Bool[Array, " C"]:
    """Configurations of those that are valid, of which no wanted pair is in contact.

    Args:
        wanted: pairs to be tested, by configuration.
        gaps: of pairs at configurations, both `[N]`; not above 0 in contact.
        valid: others need no test.
    """
    num = len(valid)

    def some_left(state: tuple[jax.Array, jax.Array]) -> jax.Array:
        return jnp.any(state[0])

    def test_some(state: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        left, valid = state
        # Twice as many as there are configurations; the others wait until these are decided.
        (found,) = jnp.nonzero(left, size=2 * num, fill_value=len(left))
        pair, at = jnp.divmod(jnp.minimum(found, len(left) - 1), num)
        # Rows without a pair test the last again.
        touches = (found < len(left)) & ~(gaps(pair, at) > 0)
        valid = valid.at[jnp.where(touches, at, num)].set(False, mode="drop")
        left = left.at[found].set(False, mode="drop")
        return left & jnp.tile(valid, len(left) // num), valid

    left = (wanted & valid).reshape(-1)
    return jax.lax.while_loop(some_left, test_some, (left, valid))[1]
