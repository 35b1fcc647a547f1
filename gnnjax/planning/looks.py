"""What a guide reads of scenes and says of motions, of many problems at once."""

from typing import Any

import jax

from gnnjax.devices import map_first
from gnnjax.guide.guide import RISK_WEIGHT, Guide
from gnnjax.kept import keep
from gnnjax.per_object import per_object
from gnnjax.scene.scene import Scene, without_meant
from gnnjax.search.path_roadmap import PATH_POINTS, shortened, spread_along

# Most pieces that a motion is looked at in; the longest edge is that from start to goal.
EDGE_PIECES, SHORTCUT_PIECES, LOCAL_PIECES = 16, 12, 6


class Looks:
    """A guide's compiled functions.

    They take the guide's weights, and B problems, of which the first `num` count.
    """

    def __init__(self, guide: Guide):
        self.guide = guide

    def read_one(self, weights, scene: Scene) -> Any:
        """What the guide reads of one scene, without contacts that are meant."""
        return self.guide.read(weights, without_meant(scene))

    @per_object(keep)
    def read(self, weights, scenes: Scene, num) -> Any:
        """What the guide reads of scenes `[B]`."""
        return map_first(lambda scene: self.read_one(weights, scene), num, scenes)

    @per_object(keep)
    def edges(self, weights, readings, starts: jax.Array, ends: jax.Array, num) -> jax.Array:
        """Prices of edges `[B E]` between configurations `[B E D]`, rad."""
        return RISK_WEIGHT * self._prices(weights, readings, starts, ends, num, EDGE_PIECES)

    @per_object(keep)
    def branches(self, weights, readings, starts: jax.Array, ends: jax.Array, num) -> jax.Array:
        """Prices of short motions `[B E]`, nats."""
        return self._prices(weights, readings, starts, ends, num, LOCAL_PIECES)

    def _prices(self, weights, readings, starts, ends, num, pieces: int) -> jax.Array:
        def one(turn: tuple[Any, jax.Array, jax.Array]) -> jax.Array:
            reading, starts, ends = turn
            return self.guide.prices(weights, reading).motions(starts, ends, pieces)

        return map_first(one, num, (readings, starts, ends))

    @per_object(keep)
    def shortcuts(self, weights, readings, lines: jax.Array, num) -> tuple[jax.Array, jax.Array]:
        """Points `[B V D]` of paths `[B N D]` that are shortened in the guide's eyes, and prices
        `[B V V]` of the motions between them, rad."""

        def one(turn: tuple[Any, jax.Array]) -> tuple[jax.Array, jax.Array]:
            reading, line = turn
            motions = self.guide.prices(weights, reading).motions
            roadmap, price = shortened(
                spread_along(line, PATH_POINTS),
                lambda a, b: RISK_WEIGHT * motions(a, b, SHORTCUT_PIECES),
            )
            return roadmap.nodes, price

        return map_first(one, num, (readings, lines))
