"""A pool of slots, each with a roadmap under lazy search."""

import functools
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import numpy as np

from gnnjax.clock import Clock
from gnnjax.collision.sequences import Items, Outcome, PlacedScenes, SequenceTester
from gnnjax.devices import map_first, marked_first
from gnnjax.kept import keep
from gnnjax.search.knowledge import INVALID, UNKNOWN, VALID, Knowledge
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


class Tested(NamedTuple):
    """What a round's tests found out, by slot."""

    nodes: np.ndarray  # [S N] int8, by step of the route
    edges: np.ndarray  # [S N] int8
    outcome: Outcome  # of the slots that were tested, in order


def items_of(
    route: Route, rows: np.ndarray, owner: np.ndarray, most_edges: np.ndarray | None = None
):
    """What has to be tested of the routes of some slots: nodes first, then edges, least likely
    first.

    Returns:
        The items, and of each its row in `rows` and its step along the route.
    """
    row, step = np.nonzero(route.node_unknown[rows])
    edge_row, edge_step = np.nonzero(route.edge_unknown[rows])
    price = route.edge_price[rows][edge_row, edge_step]
    order = np.lexsort((edge_step, -price, edge_row))
    edge_row, edge_step = edge_row[order], edge_step[order]
    if most_edges is not None:
        first = np.searchsorted(edge_row, np.arange(len(rows)))
        kept = np.arange(len(edge_row)) - first[edge_row] < most_edges[edge_row]
        edge_row, edge_step = edge_row[kept], edge_step[kept]
    motion = np.repeat([False, True], [len(row), len(edge_row)])
    row, step = np.concatenate([row, edge_row]), np.concatenate([step, edge_step])
    order = np.lexsort((motion, row))  # stable
    row, step, motion = row[order], step[order], motion[order]
    points = route.points[rows]
    last = points.shape[1] - 1
    ends = points[row, np.minimum(step + 1, last)]
    return Items(row, owner[row], points[row, step], ends, motion), row, step


def verdicts(items: Items, outcome: Outcome) -> np.ndarray:
    """Of each item: VALID, INVALID, or UNKNOWN where it was not come to."""
    first = np.searchsorted(items.sequence, np.arange(len(outcome.num_valid)))
    at = np.arange(len(items.sequence)) - first[items.sequence]
    limit = outcome.num_valid[items.sequence]
    found = np.where(at < limit, VALID, UNKNOWN)
    return np.where((at == limit) & outcome.refuted[items.sequence], INVALID, found).astype(np.int8)


class Pool:
    """Slots, each free or with a problem's roadmap."""

    def __init__(self, size: int, clock: Clock, tester: SequenceTester, placed: PlacedScenes):
        """Args:
        size: slots.
        clock: of the run.
        tester: tests what is wanted.
        placed: scenes of all problems of the run.
        """
        self.size, self.clock, self.tester, self.placed = size, clock, tester, placed
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

    def test(self, host: Route, rows: np.ndarray, most_edges: np.ndarray | None = None) -> Tested:
        """Tests what is unknown on the paths of some slots."""
        items, row, step = items_of(host, rows, self.ids[rows], most_edges)
        outcome = self.tester(self.placed, items, len(rows), self.clock)
        found = verdicts(items, outcome)
        nodes, edges = np.zeros((2, *host.path.shape), np.int8)
        nodes[rows[row[~items.motion]], step[~items.motion]] = found[~items.motion]
        edges[rows[row[items.motion]], step[items.motion]] = found[items.motion]
        return Tested(nodes, edges, outcome)

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
