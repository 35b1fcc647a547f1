"""Motions that an arm cannot hold, in the eyes of any guide.

What takes more torque at rest than it may is blocked, whatever the scene. That costs little to look
at, and is as good as known from a few places of a motion: in between torques hardly differ.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from gnnjax.arm.robot import Robot
from gnnjax.arm.torques import rest_use
from gnnjax.guide.guide import Guide, Prices
from gnnjax.kept import keep
from gnnjax.roadmap.graph import Roadmap
from gnnjax.roadmap.paths import for_each_edge

_SPACING = 0.2  # rad (or m) between the places of a motion that are looked at
# Shares of what may be used: at which a motion is as likely held as not, and how fast that changes.
_LIKELY, _WIDTH = 0.995, 0.01
_STORED_PIECES = 32  # that the longest edges of a stored roadmap are looked at in


def with_rest(robot: Robot, guide: Guide) -> Guide:
    """A guide that also tells what an arm with a `rest_limit` cannot hold; for others the guide as
    it is.

    Args:
        robot: the arm.
        guide: of that arm.
    """
    if robot.rest_limit is None:
        return guide

    def price(use: jax.Array) -> jax.Array:
        return jax.nn.softplus((use - _LIKELY) / _WIDTH)

    def along(
        starts: Float[Array, "E D"], ends: Float[Array, "E D"], most: int
    ) -> Float[Array, " E"]:
        length = jnp.linalg.norm(ends - starts, axis=-1)
        pieces = jnp.clip(jnp.ceil(length / _SPACING), 1, most)

        def look(i: jax.Array, largest: jax.Array) -> jax.Array:
            fraction = jnp.minimum(i / pieces, 1.0)[:, None]
            use = rest_use(robot, starts + fraction * (ends - starts))
            return jnp.maximum(largest, use)

        last = jnp.max(pieces, initial=0).astype(jnp.int32)
        return price(jax.lax.fori_loop(0, last + 1, look, jnp.zeros(len(starts))))

    def prices(weights: Any, reading: Any) -> Prices:
        of_scene = guide.prices(weights, reading)
        return Prices(
            lambda q: of_scene.nodes(q) + price(rest_use(robot, q)),
            lambda starts, ends, most: (
                of_scene.motions(starts, ends, most) + along(starts, ends, most)
            ),
        )

    own_edges = keep(
        lambda roadmap: for_each_edge(roadmap, lambda a, b: along(a, b, _STORED_PIECES))
    )

    def tabulate(roadmap: Roadmap) -> tuple[Any, jax.Array]:
        assert guide.tabulate is not None
        return guide.tabulate(roadmap), own_edges(roadmap)

    def stored(weights: Any, readings: Any, table: tuple[Any, jax.Array]) -> jax.Array:
        assert guide.stored is not None
        return guide.stored(weights, readings, table[0]) + table[1]

    known = guide.stored is not None
    return Guide(
        guide.weights, guide.read, prices, tabulate if known else None, stored if known else None
    )
