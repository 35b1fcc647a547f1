"""The engine: many problems on their way, in rounds.

A pool of slots holds one problem each. In a round, the cheapest path of every slot by what is known
is found, what it meets is priced, what is unknown on it is tested, all slots together in flat calls
of one collision kernel, and what came out is learned. Problems that are through leave, and waiting
ones take their slots. The host loop decides on a handful of numbers a slot; a lone query is a pool
of one. What a problem's path is and what it cost does not depend on who shares its pool.
"""

import dataclasses
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gnnjax.arm.robot import Robot
from gnnjax.collision.certify import certify_edges
from gnnjax.collision.checker import Checker
from gnnjax.collision.sequences import Items, Outcome, SequenceTester
from gnnjax.guide.guide import RISK_WEIGHT
from gnnjax.planning.query import path_length
from gnnjax.problems.problem import Problem
from gnnjax.roadmap.graph import GOAL, START
from gnnjax.search.knowledge import INVALID, UNKNOWN, VALID, Knowledge
from gnnjax.search.rounds import Priced, Route, cheapest_routes, learn

SIZES = (1, 16, 64, 256)  # slots of a pool; one compilation each
# Problems whose roadmaps are made or shortened at once; the first for lone queries. No array has
# room for one alone: a compiler that knows there is one merges other operations, and rounds otherwise.
_CHUNKS = (2, 16)


def size_for(num: int) -> int:
    """The smallest pool for `num` problems, or the largest there is."""
    return next((size for size in SIZES if num <= size), SIZES[-1])


class Clock:
    """Seconds, on a clock that stands still while something is compiled."""

    def __init__(self):
        self._waited = 0.0

    def now(self) -> float:
        """The time."""
        return time.perf_counter() - self._waited

    def call(self, function: Any, *args: Any) -> Any:
        """Calls a jitted function; a call that compiles it takes no time."""
        before, known = time.perf_counter(), function._cache_size()
        result = function(*args)
        if function._cache_size() > known:
            jax.block_until_ready(result)
            self._waited += time.perf_counter() - before
        return result


_cheapest_routes = jax.jit(cheapest_routes)


@jax.jit
def _learn(priced: Priced, route: Route, nodes: jax.Array, edges: jax.Array) -> Knowledge:
    return jax.vmap(learn)(priced, route, nodes, edges)


def _place(pool: Any, new: Any, rows: jax.Array) -> Any:
    """Puts problems into slots; rows beyond the last are dropped."""
    return jax.tree.map(lambda x, y: x.at[rows].set(y, mode="drop"), pool, new)


_place_in = jax.jit(_place, donate_argnums=0)


@jax.jit
def _take(pool: Any, rows: jax.Array) -> Any:
    return jax.tree.map(lambda x: x[rows], pool)


class Tested(NamedTuple):
    """What a round's tests found out, by slot."""

    nodes: np.ndarray  # [S N] int8, by step of the route
    edges: np.ndarray  # [S N] int8
    outcome: Outcome  # of the slots that were tested, in order


def items_of(route: Route, rows: np.ndarray, owner: np.ndarray, most_edges: np.ndarray | None = None):
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


class Search:
    """A pool of roadmaps under lazy search."""

    def __init__(self, size: int, clock: Clock, tester: SequenceTester, scenes: Any):
        self.size, self.clock, self.tester, self.scenes = size, clock, tester, scenes
        self.ids = np.full(size, -1)
        self.priced: Priced | None = None
        self.reading: Any = None

    def enter(self, rows: np.ndarray, ids: np.ndarray, entered: tuple[Priced, Any]) -> None:
        """Puts problems into slots.

        Args:
            rows: `[B]` slots, as many as problems came in; padded up to a size.
            ids: `[B]`.
            entered: their roadmaps and readings, `[size_for(B), ...]`.
        """
        num = len(entered[0].price)
        at = np.full(num, self.size)
        at[: len(rows)] = rows
        if self.priced is None:
            blank = jax.tree.map(lambda x: jnp.zeros((self.size, *x.shape[1:]), x.dtype), entered)
            self.priced, self.reading = blank
        pool = self.priced, self.reading
        self.priced, self.reading = self.clock.call(_place_in, pool, entered, at)
        self.ids[rows] = ids

    def shrink(self) -> np.ndarray:
        """Leaves slots that are free to the others, where a smaller pool would do.

        Returns:
            The slots that are left, in order.
        """
        live = np.flatnonzero(self.ids >= 0)
        size = size_for(len(live))
        if size == self.size:
            return np.arange(size)
        kept = np.concatenate([live, np.flatnonzero(self.ids < 0)])[:size]
        self.priced, self.reading = self.clock.call(_take, (self.priced, self.reading), kept)
        self.ids, self.size = self.ids[kept], size
        return kept

    def route(self) -> tuple[Route, Route]:
        """The cheapest path of every slot, on the device and on the host."""
        route = self.clock.call(_cheapest_routes, self.priced)
        return route, jax.tree.map(np.asarray, route)

    def test(self, host: Route, rows: np.ndarray, most_edges: np.ndarray | None = None) -> Tested:
        """Tests what is unknown on the paths of some slots."""
        items, row, step = items_of(host, rows, self.ids[rows], most_edges)
        outcome = self.tester(self.scenes, items, len(rows))
        found = verdicts(items, outcome)
        nodes, edges = np.zeros((2, *host.path.shape), np.int8)
        nodes[rows[row[~items.motion]], step[~items.motion]] = found[~items.motion]
        edges[rows[row[items.motion]], step[items.motion]] = found[items.motion]
        return Tested(nodes, edges, outcome)

    def learn(self, route: Route, nodes: np.ndarray, edges: np.ndarray) -> None:
        """Notes what came out."""
        assert self.priced is not None
        known = self.clock.call(_learn, self.priced, route, nodes, edges)
        self.priced = self.priced._replace(known=known)


@dataclasses.dataclass
class Kept:
    """What is known of a roadmap whose best path is too unlikely, for later."""

    price: float  # nats, of that path
    number: int
    known: Knowledge


class Run:
    """A batch of problems on its way."""

    def __init__(self, planner: Any, problems: Problem, seed: int, pool: int, clock: Clock):
        self.strategy, self.options = planner.strategy, planner.options
        self.robot, self.tester, self.clock, self.seed = planner.robot, planner.tester, clock, seed
        self.pool = pool
        self.chunk = _CHUNKS[pool > 1]
        num = len(problems.start)
        # Few shapes: the kernel is compiled for a number of scenes.
        padded = np.minimum(np.arange(16 ** int(np.ceil(np.log(num) / np.log(16)))), num - 1)
        self.problems = jax.tree.map(np.asarray, problems)
        self.scenes = jax.tree.map(lambda x: jnp.asarray(np.asarray(x)[padded]), problems.scene)
        self.paths: list[np.ndarray | None] = [None] * num
        self.direct = np.zeros(num, np.int8)
        self.edge_checks, self.search_checks, self.roadmaps, self.rounds = np.zeros((4, num), int)
        self.planning_time, self.total_time = np.zeros((2, num))
        self.kept: list[list[Kept]] = [[] for _ in range(num)]
        self.spent: dict[str, float] = {}

    def run(self) -> None:
        """Plans all problems."""
        every = np.arange(len(self.paths))
        for first in range(0, len(every), 4 * self.pool):
            self._straight(every[first : first + 4 * self.pool])
        last = self.options.max_roadmaps
        for level in range(0, last, ROADMAPS_A_LEVEL):
            for number in range(level, min(level + ROADMAPS_A_LEVEL, last)):
                ids = self._open(every)
                self.roadmaps[ids] += 1
                self._attempt(ids, np.full(len(ids), number), self.strategy.give_up)
            # No roadmap had a likely path: now the unlikely ones, the least unlikely first.
            for kept in self.kept:
                kept.sort(key=lambda one: one.price)
            for turn in range(ROADMAPS_A_LEVEL):
                ids = self._open(np.array([i for i in every if len(self.kept[i]) > turn], int))
                again = [self.kept[i][turn] for i in ids]
                numbers = np.array([one.number for one in again], int)
                # The first roadmap is of another shape.
                for group in (np.flatnonzero(numbers == 0), np.flatnonzero(numbers > 0)):
                    known = [again[i].known for i in group]
                    self._attempt(ids[group], numbers[group], np.inf, known)
            self.kept = [[] for _ in every]

    def _open(self, ids: np.ndarray) -> np.ndarray:
        late = self.total_time > self.options.time_limit
        return np.array([i for i in ids if self.paths[i] is None and not late[i]], int)

    def _spend(self, what: str, ids: np.ndarray, begin: float, *, planning: bool = True) -> float:
        """Shares out the time since `begin`."""
        now = self.clock.now()
        share = (now - begin) / max(1, len(ids))
        self.total_time[ids] += share
        if planning:
            self.planning_time[ids] += share
        self.spent[what] = self.spent.get(what, 0.0) + now - begin
        return now

    def _straight(self, ids: np.ndarray) -> None:
        """Tests the straight lines from starts to goals."""
        begin = self.clock.now()
        starts, goals = self.problems.start[ids], self.problems.goal[ids]
        items = Items(np.arange(len(ids)), ids, starts, goals, np.ones(len(ids), bool))
        outcome = self.tester(self.scenes, items, len(ids))
        self._count(ids, outcome)
        self.direct[ids] = INVALID
        free = ~outcome.refuted
        lines = [np.stack([self.problems.start[i], self.problems.goal[i]]) for i in ids[free]]
        begin = self._spend("straight", ids, begin)
        self._certify(ids[free], lines)
        self._spend("certify", ids, begin)

    def _count(self, ids: np.ndarray, outcome: Outcome) -> None:
        self.edge_checks[ids] += outcome.num_edges
        self.search_checks[ids] += outcome.num_checks

    def _certify(self, ids: np.ndarray, paths: list[np.ndarray]) -> list[np.ndarray]:
        """Keeps paths that are certified and shorter than what there is.

        Returns:
            Of each path, which of its edges are certified.
        """
        if not len(ids):
            return []
        steps = np.array([len(path) - 1 for path in paths])
        scenes = jax.tree.map(lambda x: x[ids], self.problems.scene)
        certified = certify_edges(
            self.robot,
            scenes,
            np.concatenate([path[:-1] for path in paths]),
            np.concatenate([path[1:] for path in paths]),
            np.repeat(np.arange(len(ids)), steps),
        )
        found = np.split(certified, np.cumsum(steps)[:-1])
        for i, path, good in zip(ids, paths, found, strict=True):
            known = self.paths[i]
            if good.all() and (known is None or path_length(path) < path_length(known)):
                self.paths[i] = path
        return found

    def _attempt(
        self,
        ids: np.ndarray,
        numbers: np.ndarray,
        max_price: float,
        known: list[Knowledge] | None = None,
    ) -> None:
        """One roadmap for each of some problems, searched in a pool with refills."""
        if not len(ids):
            return
        size = size_for(min(len(ids), self.pool, self.strategy.most_slots(numbers[0])))
        search = Search(size, self.clock, self.tester, self.scenes)
        likely = np.zeros(size, bool)  # not checked as it is, but shortened first
        turns, number = np.zeros((2, size), int)
        waiting = 0
        while waiting < len(ids) or (search.ids >= 0).any():
            free = np.flatnonzero(search.ids < 0)
            if waiting < len(ids) and (len(free) >= max(1, size // 8)):
                begin = self.clock.now()
                entering = np.arange(waiting, min(waiting + len(free), len(ids)))
                rows = free[: len(entering)]
                for one in np.unique(numbers[entering]):
                    chosen = numbers[entering] == one
                    self._enter(search, rows[chosen], ids, entering[chosen], int(one), known)
                number[rows] = numbers[entering]
                likely[rows], turns[rows] = known is None and self.strategy.shorten, 0
                waiting += len(entering)
                self._spend("enter", ids[entering], begin, planning=False)
            elif waiting == len(ids):
                kept = search.shrink()
                likely, turns, number, size = likely[kept], turns[kept], number[kept], search.size
            self._round(search, number, likely, turns, max_price)

    def _enter(self, search, rows, ids, entering, number, known) -> None:
        for first in range(0, len(entering), self.chunk):
            part = slice(first, first + self.chunk)
            padded = np.resize(entering[part], self.chunk)
            problems = jax.tree.map(lambda x, at=ids[padded]: x[at], self.problems)
            priced, reading = self.strategy.enter(
                self.clock.call, problems, self.direct[ids[padded]], len(entering[part]), self.seed, number
            )
            if known is not None:
                earlier = [known[i] for i in padded]
                priced = priced._replace(known=jax.tree.map(lambda *x: np.stack(x), *earlier))
            search.enter(rows[part], ids[entering[part]], (priced, reading))
        jax.block_until_ready(search.priced)

    def _round(self, search, number, likely, turns, max_price) -> None:
        begin = self.clock.now()
        live = np.flatnonzero(search.ids >= 0)
        ids = search.ids[live]
        route, host = search.route()
        begin = self._spend("route", ids, begin)
        turns[live] += 1
        self.rounds[ids] += 1
        prices = host.edge_price[live].sum(axis=1) / RISK_WEIGHT
        none = host.num[live] == 0
        dear = ~none & (prices > max_price)
        spent = turns[live] > MOST_ROUNDS
        for row, price in zip(live[dear], prices[dear], strict=True):
            assert search.priced is not None
            status = jax.tree.map(lambda x, row=row: np.asarray(x[row]), search.priced.known)
            self.kept[search.ids[row]].append(Kept(float(price), int(number[row]), status))
        search.ids[live[none | dear | spent]] = -1
        live = live[~(none | dear | spent)]
        long = host.num[live] > 2
        first = live[likely[live] & long]
        nodes, edges = np.zeros((2, *host.path.shape), np.int8)
        if len(first):
            found = self._shorten(search, first, host)
            search.ids[first[found]] = -1
            likely[first] = False
        testing = live[~(likely[live] & long) & (search.ids[live] >= 0)]
        testing = np.setdiff1d(testing, first)
        if len(testing):
            begin = self.clock.now()
            tested = search.test(host, testing)
            self._count(search.ids[testing], tested.outcome)
            begin = self._spend("test", search.ids[testing], begin)
            nodes, edges = tested.nodes, tested.edges
            through = testing[~tested.outcome.refuted]
            paths = [host.points[row, : host.num[row]] for row in through]
            certified = self._certify(search.ids[through], paths)
            begin = self._spend("certify", search.ids[through], begin)
            good = np.array([c.all() for c in certified], bool)
            for row, found in zip(through[~good], np.array(certified, object)[~good], strict=True):
                edges[row, np.flatnonzero(~found)] = INVALID
            through = through[good]
            longer = through[host.num[through] > 2]
            if len(longer) and self.strategy.shorten:
                self._shorten(search, longer, host)
            search.ids[through] = -1
            begin = self.clock.now()
            search.learn(route, nodes, edges)
            self._spend("learn", search.ids[testing][search.ids[testing] >= 0], begin)

    def _shorten(self, search: Search, rows: np.ndarray, host: Route) -> np.ndarray:
        """Shortens paths in the guide's eyes, checks them, and keeps what is certified and shorter.

        Returns:
            Of each row, whether a path was kept.
        """
        begin = self.clock.now()
        ids = search.ids[rows]
        num = size_for(len(rows))
        inner = Search(num, self.clock, self.tester, self.scenes)
        for first in range(0, len(rows), self.chunk):
            part = np.arange(first, min(first + self.chunk, len(rows)))
            padded = rows[np.resize(part, self.chunk)]
            readings = self.clock.call(_take, search.reading, padded)
            priced = self.clock.call(
                self.strategy.shortcuts,
                self.strategy.weights,
                readings,
                host.points[padded],
                np.int32(len(part)),
            )
            inner.enter(part, ids[part], (priced, ()))
        asked, own, kept = np.zeros(num, int), np.arange(num), np.zeros(len(rows), bool)
        jax.block_until_ready(inner.priced)
        begin = self._spend("shortcuts", ids, begin)
        while (inner.ids >= 0).any():
            live = np.flatnonzero(inner.ids >= 0)
            route, found = inner.route()
            begin = self._spend("short route", inner.ids[live], begin)
            gone = (found.num[live] == 0) | (
                (asked[live] >= MOST_SHORTCUTS) & found.edge_unknown[live].any(axis=1)
            )
            inner.ids[live[gone]] = -1
            live = live[~gone]
            if not len(live):
                break
            tested = inner.test(found, live, MOST_SHORTCUTS - asked[live])
            self._count(inner.ids[live], tested.outcome)
            asked[live] += tested.outcome.num_edges
            begin = self._spend("short test", inner.ids[live], begin)
            left = found.edge_unknown[live] & (tested.edges[live] == UNKNOWN)
            through = live[~tested.outcome.refuted & ~left.any(axis=1)]
            paths = [found.points[row, : found.num[row]] for row in through]
            certified = self._certify(inner.ids[through], paths)
            begin = self._spend("short certify", inner.ids[through], begin)
            for row, good in zip(through, certified, strict=True):
                tested.edges[row, np.flatnonzero(~good)] = INVALID
                if good.all():
                    kept[own[row]], inner.ids[row] = True, -1
            if (inner.ids >= 0).any():
                inner.learn(route, tested.nodes, tested.edges)
                slots = inner.shrink()
                asked, own = asked[slots], own[slots]
        return kept


ROADMAPS_A_LEVEL = 4
MOST_ROUNDS = 25  # of a roadmap
MOST_SHORTCUTS = 8  # edges; what needs more is hardly ever free
