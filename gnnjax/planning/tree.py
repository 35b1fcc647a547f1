"""One tree of free motions: its nodes, which of them are nearest, and the ways to its root."""

import numpy as np

_ROOM = 64  # nodes, at first
# Multiplications of a product of matrices; of more, libraries wake other cores, which takes longer
# than the product.
_PRODUCT = 1 << 18


class Tree:
    """Configurations that are joined to a root by free motions."""

    def __init__(self, root: np.ndarray):
        self.count = 1
        self.nodes = np.zeros((_ROOM, len(root)), np.float32)
        self.nodes[0] = root
        self.halves = np.zeros(_ROOM, np.float32)  # of squared lengths of nodes
        self.halves[0] = _half_squared(root[None])[0]
        self.costs = np.zeros(_ROOM, np.float32)  # lengths of the ways from the root
        self.parents = np.zeros(_ROOM, int)

    def nearest(self, q: np.ndarray) -> np.ndarray:
        """Which nodes `[G]` are nearest to q `[G D]`."""
        block = max(1, _PRODUCT // q.size)
        # What half the squared distances are, but for that of q from the origin.
        far = np.empty((len(q), self.count), np.float32)
        for first in range(0, self.count, block):
            some = slice(first, min(first + block, self.count))
            far[:, some] = self.halves[some] - q @ self.nodes[some].T
        return far.argmin(axis=1)

    def add(self, parents: np.ndarray, sizes: np.ndarray, branches: np.ndarray) -> np.ndarray:
        """Adds branches, each from a node of `[B]`: of `sizes` `[B]`, one or more, configurations
        `[N D]` one after the other. Returns the last nodes `[B]`."""
        begin, end = self.count, self.count + len(branches)
        while end > len(self.nodes):
            for name in ("nodes", "halves", "costs", "parents"):
                had = getattr(self, name)
                setattr(self, name, np.concatenate([had, np.zeros_like(had)]))
        last = begin + np.cumsum(sizes) - 1
        first = last + 1 - sizes
        self.parents[begin:end] = np.arange(begin, end) - 1
        self.parents[first] = parents
        self.nodes[begin:end], self.halves[begin:end] = branches, _half_squared(branches)
        steps = branches - self.nodes[self.parents[begin:end]]
        along = np.cumsum(np.sqrt(2 * _half_squared(steps)), dtype=float)  # all branches
        before = self.costs[parents] - np.append(0, along)[first - begin]
        self.costs[begin:end] = along + np.repeat(before, sizes)
        self.count = end
        return last

    def way(self, node: int) -> list[int]:
        """Nodes from one to the root."""
        found = [node]
        while node:
            node = int(self.parents[node])
            found.append(node)
        return found

    def cut(self, node: int) -> None:
        """Has a node, and what was added beyond it, no longer be nearest to anything."""
        gone = np.zeros(self.count, bool)
        gone[node] = True
        for beyond in range(node + 1, self.count):
            gone[beyond] = gone[self.parents[beyond]]
        self.halves[: self.count][gone] = np.inf


def _half_squared(q: np.ndarray) -> np.ndarray:
    return np.einsum("nd,nd->n", q, q) / 2
