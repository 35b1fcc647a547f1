"""Shortens the paths of a pool in the guide's eyes, and checks what comes out."""

from typing import NamedTuple

import numpy as np

from gnnjax.planning.batch import Batch
from gnnjax.planning.guided import Guided
from gnnjax.planning.pool import Pool, in_chunks, take
from gnnjax.planning.steps import check_routes
from gnnjax.roadmap.graph import GOAL, START
from gnnjax.search.knowledge import INVALID, UNKNOWN, VALID
from gnnjax.search.rounds import Route

_MOST_SHORTCUTS = 8  # edges; what needs more is hardly ever free


class Shortener:
    """Shortens paths, and keeps books on it."""

    def __init__(self, batch: Batch, strategy: Guided, chunk: int):
        """Args:
        batch: of the problems; knows their best paths.
        strategy: finds shortcuts.
        chunk: paths that are shortened at once.
        """
        self.batch, self.strategy, self.chunk = batch, strategy, chunk

    def shorten(self, pool: Pool, rows: np.ndarray, host: Route) -> np.ndarray:
        """Shortens paths in the guide's eyes, checks them, and keeps what is certified and shorter.

        Returns:
            Of each row, whether a path was kept.
        """
        batch = self.batch
        begin = batch.clock.now()
        inner = self.shortcuts(pool, rows, host)
        asked, kept = np.zeros(len(rows), int), np.zeros(len(rows), bool)
        begin = batch.spend(pool.ids[rows], begin)
        while (inner.ids >= 0).any():
            live = np.flatnonzero(inner.ids >= 0)
            found = inner.route()
            begin = batch.spend(inner.ids[live], begin)
            gone = (found.num[live] == 0) | (
                (asked[live] >= _MOST_SHORTCUTS) & found.edge_unknown[live].any(axis=1)
            )
            inner.ids[live[gone]] = -1
            live = live[~gone]
            if not len(live):
                break
            left_over = _MOST_SHORTCUTS - asked[live]
            tested = check_routes(batch, inner.ids[live], found, live, left_over)
            asked[live] += tested.outcome.num_edges
            begin = batch.spend(inner.ids[live], begin)
            left = found.edge_unknown[live] & (tested.edges[live] == UNKNOWN)
            through = live[~tested.outcome.refuted & ~left.any(axis=1)]
            ids = inner.ids[through]
            through = through[batch.certify_routes(ids, through, found, tested.edges)]
            begin = batch.spend(ids, begin)
            kept[through], inner.ids[through] = True, -1
            if (inner.ids >= 0).any():
                inner.learn(found, tested.nodes, tested.edges)
        return kept

    def shortcuts(self, pool: Pool, rows: np.ndarray, host: Route) -> "PathRoadmaps":
        """The path roadmaps of the paths of some slots, in a pool of their own."""
        clock, parts = self.batch.clock, []
        for part, padded in in_chunks(rows, self.chunk):
            readings = clock.call(take, pool.reading, padded)
            found = clock.call(
                self.strategy.looks.shortcuts,
                self.strategy.weights,
                readings,
                host.points[padded],
                np.int32(len(part)),
            )
            parts.append([np.asarray(x)[: len(part)] for x in found])
        points, price = (np.concatenate(x) for x in zip(*parts, strict=True))
        return PathRoadmaps(pool.ids[rows].copy(), points, price)


class _Known(NamedTuple):
    """What is known of the path roadmaps of S paths."""

    status: np.ndarray  # [S V V] int8
    node_status: np.ndarray  # [S V] int8


class PathRoadmaps:
    """Roadmaps of paths, whose few points are joined all to all. They are searched on the host,
    where that takes less than calling a compiled function.
    """

    def __init__(self, ids: np.ndarray, points: np.ndarray, price: np.ndarray):
        """Args:
        ids: `[S]` of the paths' problems; -1 once a path is through.
        points: `[S V D]`, from `shortened`.
        price: `[S V V]` rad.
        """
        num, num_points = points.shape[:2]
        self.ids, self._points, self._price = ids, points, price
        self._lengths = np.linalg.norm(points[:, :, None] - points[:, None], axis=-1)
        nodes = np.full((num, num_points), UNKNOWN, np.int8)
        nodes[:, [START, GOAL]] = VALID
        self._known = _Known(np.full(price.shape, UNKNOWN, np.int8), nodes)

    def route(self) -> Route:
        """The cheapest way of every path that is not through."""
        rows = np.flatnonzero(self.ids >= 0)
        every = np.arange(len(rows))[:, None]
        status, node_status = (x[rows] for x in self._known)
        num_points = node_status.shape[1]
        price = np.where(status == UNKNOWN, self._price[rows], np.float32(0))
        blocked = (status == INVALID) | (node_status == INVALID)[:, :, None]
        blocked |= np.eye(num_points, dtype=bool)
        edge_cost = np.where(blocked, np.float32(np.inf), self._lengths[rows] + price)
        cost = np.full(node_status.shape, np.inf, np.float32)
        cost[:, GOAL] = 0
        for _ in range(num_points):
            beyond = edge_cost + cost[:, None]
            better = np.minimum(cost, beyond.min(axis=2))
            if (better == cost).all():
                break
            cost = better
        following = (edge_cost + cost[:, None]).argmin(axis=2)
        path = np.full(cost.shape, -1)
        path[:, 0] = node = np.full(len(rows), START)
        for step in range(1, num_points):
            going = np.isfinite(cost[:, START]) & (node != GOAL)
            if not going.any():
                break
            node = np.where(going, following[every[:, 0], node], node)
            path[going, step] = node[going]
        on_path = (path >= 0) & (path == GOAL).any(axis=1)[:, None]
        near = np.maximum(path, 0)
        slots = following[every, near]
        edge_unknown = on_path & (path != GOAL) & (status[every, near, slots] == UNKNOWN)
        found = Route(
            path=path,
            slots=slots,
            points=self._points[rows[:, None], np.where(path >= 0, path, GOAL)],
            num=on_path.sum(axis=1),
            node_unknown=on_path & (node_status[every, near] == UNKNOWN),
            edge_unknown=edge_unknown,
            edge_price=np.where(edge_unknown, price[every, near, slots], np.float32(0)),
            unjudged=np.zeros_like(edge_unknown),
        )
        route = Route(*(np.zeros((len(self.ids), *x.shape[1:]), x.dtype) for x in found))
        for whole, part in zip(route, found, strict=True):
            whole[rows] = part
        return route

    def learn(self, route: Route, nodes: np.ndarray, edges: np.ndarray) -> None:
        """Notes what came out of steps `[S N]` of a route."""
        path, (status, node_status) = route.path, self._known
        row, step = np.nonzero(nodes != UNKNOWN)
        node_status[row, path[row, step]] = nodes[row, step]
        row, step = np.nonzero(edges != UNKNOWN)
        ends = path[row, step], path[row, step + 1]
        for near, far in (ends, ends[::-1]):
            status[row, near, far] = edges[row, step]
