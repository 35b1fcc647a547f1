"""The steps of routes that are tested: which, in what order, and what came out."""

from typing import NamedTuple

import numpy as np

from gnnjax.collision.sequences import Items, Outcome
from gnnjax.planning.batch import Batch
from gnnjax.search.knowledge import INVALID, UNKNOWN, VALID
from gnnjax.search.rounds import Route


class Tested(NamedTuple):
    """What a round's tests found out, by slot."""

    nodes: np.ndarray  # [S N] int8, by step of the route
    edges: np.ndarray  # [S N] int8
    outcome: Outcome  # of the slots that were tested, in order


def items_of(
    route: Route, rows: np.ndarray, owner: np.ndarray, most_edges: np.ndarray | None = None
) -> tuple[Items, np.ndarray, np.ndarray]:
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


def check_routes(
    batch: Batch,
    ids: np.ndarray,
    route: Route,
    rows: np.ndarray,
    most_edges: np.ndarray | None = None,
) -> Tested:
    """Tests what is unknown on the paths of some slots.

    Args:
        batch: of the problems.
        ids: `[R]` problems.
        route: of all slots.
        rows: `[R]` the problems' slots.
        most_edges: `[R]` of each; None: all.
    """
    items, row, step = items_of(route, rows, ids, most_edges)
    outcome = batch.test(ids, items)
    found = verdicts(items, outcome)
    nodes, edges = np.zeros((2, *route.path.shape), np.int8)
    nodes[rows[row[~items.motion]], step[~items.motion]] = found[~items.motion]
    edges[rows[row[items.motion]], step[items.motion]] = found[items.motion]
    return Tested(nodes, edges, outcome)
