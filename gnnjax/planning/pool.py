"""A pool of slots, each with a roadmap under lazy search."""

import functools
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np

from gnnjax.clock import Clock
from gnnjax.devices import map_first, marked_first
from gnnjax.kept import keep
from gnnjax.search.knowledge import Knowledge
from gnnjax.search.rounds import Priced, Route, cheapest_route, learn, reprice

_SIZES = (1, 16, 64, 256)  # slots; one compilation each


def size_for(num: int) -> int:
    """The smallest pool for `num` problems, or the largest there is."""
    return next((size for size in _SIZES if num <= size), _SIZES[-1])


def sizes_up_to(num: int) -> tuple[int, ...]:
    """The sizes that pools for up to `num` problems may have."""
    return tuple(size for size in _SIZES if size <= size_for(num))


def in_chunks(rows: np.ndarray, size: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Rows, `size` at a time; and the same, repeated until there are `size`."""
    for first in range(0, len(rows), size):
        part = rows[first : first + size]
        yield part, np.resize(part, size)


@keep
def _cheapest_routes(priced: Priced, rows: jax.Array, num: jax.Array) -> Route:
    return map_first(cheapest_route, num, priced, rows)


@functools.partial(keep, donate_argnums=(0,))
def _learn(
    known: Knowledge,
    priced: Priced,
    route: Route,
    nodes: jax.Array,
    edges: jax.Array,
    rows: jax.Array,
    num: jax.Array,
) -> Knowledge:
    """`learn` for the first `num` of some slots; the others know what they knew.

    `priced` lacks what is known, which is written where it is.
    """

    def one(own: tuple[Knowledge, Priced, Route, jax.Array, jax.Array]) -> Knowledge:
        known, priced, *found = own
        return learn(priced._replace(known=known), *found)

    return map_first(one, num, (known, priced, route, nodes, edges), rows, into=known)


@keep
def _reprice(priced: Priced, route: Route, steps: jax.Array, price: jax.Array) -> Priced:
    return jax.vmap(reprice)(priced, route, steps, price)


def _place(pool: Any, new: Any, rows: jax.Array) -> Any:
    """Puts problems into slots; rows beyond the last are dropped."""
    return jax.tree.map(lambda x, y: x.at[rows].set(y, mode="drop"), pool, new)


_place_in = keep(_place, donate_argnums=(0,))


@keep
def take(pool: Any, rows: jax.Array) -> Any:
    """Some slots of a pool."""
    return jax.tree.map(lambda x: x[rows], pool)


class Pool:
    """Slots, each free or with a problem's roadmap."""

    def __init__(self, size: int, clock: Clock):
        """Args:
        size: slots.
        clock: of the run.
        """
        self.size, self.clock = size, clock
        self.ids = np.full(size, -1)
        self.priced: Priced | None = None
        self.reading: Any = None

    def enter(self, rows: np.ndarray, ids: np.ndarray, priced: Priced, reading: Any) -> None:
        """Puts problems into slots.

        Args:
            rows: slots.
            ids: of their problems.
            priced: their roadmaps; rows beyond the problems are dropped.
            reading: what the guide read of their scenes.
        """
        entered = priced, reading
        num = len(priced.price)
        at = np.full(num, self.size)
        at[: len(rows)] = rows
        if self.priced is None:
            blank = jax.tree.map(lambda x: np.zeros((self.size, *x.shape[1:]), x.dtype), entered)
            self.priced, self.reading = blank
        pool = self.priced, self.reading
        self.priced, self.reading = self.clock.call(_place_in, pool, entered, at)
        self.ids[rows] = ids

    def is_wide(self) -> bool:
        """Whether a smaller pool would do."""
        return size_for(int((self.ids >= 0).sum())) < self.size

    def shrink(self) -> np.ndarray:
        """Moves to a smaller pool.

        Returns:
            The slots that are left, in order.
        """
        live = np.flatnonzero(self.ids >= 0)
        size = size_for(len(live))
        kept = np.concatenate([live, np.flatnonzero(self.ids < 0)])[:size]
        self.priced, self.reading = self.clock.call(take, (self.priced, self.reading), kept)
        self.ids, self.size = self.ids[kept], size
        return kept

    def route(self) -> tuple[Route, Route]:
        """The cheapest path of every slot that is not free, on the device and on the host."""
        route = self.clock.call(_cheapest_routes, self.priced, *marked_first(self.ids >= 0))
        return route, jax.tree.map(np.asarray, route)

    def learn(self, route: Route, nodes: np.ndarray, edges: np.ndarray) -> None:
        """Notes what came out."""
        assert self.priced is not None
        known, rest = self.priced.known, self.priced._replace(known=None)
        known = self.clock.call(
            _learn, known, rest, route, nodes, edges, *marked_first(self.ids >= 0)
        )
        self.priced = self.priced._replace(known=known)

    def known(self, row: int) -> Knowledge:
        """What is known of a slot's roadmap, on the host."""
        assert self.priced is not None
        return jax.tree.map(lambda x: np.asarray(x[row]), self.priced.known)

    def reprice(self, route: Route, steps: np.ndarray, price: np.ndarray) -> None:
        """Notes prices of steps `[S B]` along the routes; of none where -1."""
        self.priced = self.clock.call(_reprice, self.priced, route, steps, price)
