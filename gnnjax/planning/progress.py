"""What was found of a batch of problems, and what it cost."""

from typing import NamedTuple

import jax
import numpy as np

from gnnjax.arm.robot import Robot
from gnnjax.clock import Clock
from gnnjax.collision.certify import certify_edges, known_obstacles
from gnnjax.collision.obstacles import Obstacles
from gnnjax.planning.query import Plan, make_plan, path_length
from gnnjax.problems.problem import Problem
from gnnjax.search.knowledge import INVALID
from gnnjax.search.rounds import Route


class Limits(NamedTuple):
    """When a problem is given up."""

    time: float = np.inf  # s, after which nothing further is begun
    # After a first look: one roadmap, or few rounds of trees.
    is_hasty: bool = False


class Progress:
    """P problems: the shortest certified paths so far, checks, and times."""

    def __init__(self, robot: Robot, problems: Problem, limits: Limits, shares: int = 1):
        """Args:
        robot: the arm.
        problems: `[P, ...]`.
        limits: of each.
        shares: of a larger batch that are worked on side by side.
        """
        num = len(problems.start)
        self.robot, self.clock, self._shares = robot, Clock(), shares
        self.limits = limits
        self.problems = jax.tree.map(np.asarray, problems)
        self.paths: list[np.ndarray | None] = [None] * num
        # Shorter paths that tests found free, which await their certificate; the shortest last.
        self.unproven: list[list[np.ndarray]] = [[] for _ in range(num)]
        self.defers = False  # whether paths await theirs, or are certified at once
        # Whether a path, which tests had found free, could not be certified.
        self.failed = np.zeros(num, bool)
        self.sampling_checks = np.full(num, 2)  # start and goal
        self.edge_checks, self.search_checks, self.roadmaps, self.rounds = np.zeros((4, num), int)
        self.planning_time, self.total_time = np.zeros((2, num))
        self._known: tuple[np.ndarray, Obstacles] | None = None

    def in_time(self) -> np.ndarray:
        """Which problems have time left, `[P]`."""
        return self.total_time <= self.limits.time

    def open(self) -> np.ndarray:
        """Which problems have no path, and time left, `[P]`."""
        unsolved = np.array([path is None for path in self.paths], bool)
        unsolved &= [not paths for paths in self.unproven]
        return unsolved & self.in_time()

    def given_up(self, i: int, tried: str) -> str:
        """Why a problem has no path, after what was tried."""
        if self.failed[i]:
            tried += (
                "; there are paths that tests find free, but they pass something too closely to be "
                "proven free"
            )
        if not self.in_time()[i]:
            tried += f"; {self.limits.time:g} s are over, give it more time"
        return tried

    def spend(self, ids: np.ndarray, begin: float, *, planning: bool = True) -> float:
        """Shares out the time since `begin` over those that were worked on, some more than once;
        returns the time."""
        now = self.clock.now()
        share = (now - begin) / max(1, len(ids)) / self._shares
        np.add.at(self.total_time, ids, share)
        if planning:
            np.add.at(self.planning_time, ids, share)
        return now

    def certify(self, ids: np.ndarray, paths: list[np.ndarray]) -> list[np.ndarray]:
        """Keeps paths that are certified and shorter than what there is.

        Returns:
            Of each path, which of its edges are certified.
        """
        if not len(ids):
            return []
        steps = np.array([len(path) - 1 for path in paths])
        certified = certify_edges(
            self.robot,
            self._obstacles_of(ids),
            np.concatenate([path[:-1] for path in paths]),
            np.concatenate([path[1:] for path in paths]),
            np.repeat(np.arange(len(ids)), steps),
        )
        found = np.split(certified, np.cumsum(steps)[:-1])
        for i, path, good in zip(ids, paths, found, strict=True):
            known = self.paths[i]
            self.failed[i] |= not good.all()
            if good.all() and (known is None or path_length(path) < path_length(known)):
                self.paths[i] = path
        return found

    def best(self, i: int) -> np.ndarray | None:
        """The shortest path of a problem, certified or not; None where there is none."""
        return self.unproven[i][-1] if self.unproven[i] else self.paths[i]

    def keep(self, i: int, path: np.ndarray) -> None:
        """Keeps a path that tests found free, if it is shorter than the best."""
        best = self.best(i)
        if best is None or path_length(path) < path_length(best):
            self.unproven[i].append(path)

    def prove(self) -> None:
        """Certifies the shortest path of each problem that awaits it; where that fails the one
        before it, and so on."""
        while ids := [i for i, paths in enumerate(self.unproven) if paths]:
            begin = self.clock.now()
            certified = self.certify(np.array(ids), [self.unproven[i].pop() for i in ids])
            for i, edges in zip(ids, certified, strict=True):
                if edges.all():
                    self.unproven[i] = []
            self.spend(np.array(ids), begin)

    def _obstacles_of(self, ids: np.ndarray) -> Obstacles:
        """What the scenes of some problems hold. A lone query asks for the same again and again."""
        if self._known is None or not np.array_equal(self._known[0], ids):
            scenes = jax.tree.map(lambda x: x[ids], self.problems.scene)
            self._known = ids, known_obstacles(self.robot, scenes)
        return self._known[1]

    def certify_or_keep(self, ids: np.ndarray, paths: list[np.ndarray]) -> list[np.ndarray] | None:
        """`certify`, or, where that is to wait, keeps paths for `prove` and returns None."""
        if not self.defers:
            return self.certify(ids, paths)
        for i, path in zip(ids.tolist(), paths, strict=True):
            self.keep(i, path)
        return None

    def certify_routes(
        self, ids: np.ndarray, rows: np.ndarray, routes: Route, edges: np.ndarray
    ) -> np.ndarray:
        """`certify_or_keep` for the routes of some slots of a pool.

        Args:
            ids: problems.
            rows: their slots.
            routes: of all slots.
            edges: `[S N]` what is known of their steps; those not certified become INVALID.

        Returns:
            Of each problem, whether its path is certified, or awaits that.
        """
        paths = [routes.points[row, : routes.num[row]] for row in rows]
        certified = self.certify_or_keep(ids, paths)
        if certified is None:
            return np.ones(len(ids), bool)
        for row, good in zip(rows, certified, strict=True):
            edges[row, np.flatnonzero(~good)] = INVALID
        return np.array([good.all() for good in certified], bool)

    def plans(self, reasons: list[str]) -> list[Plan]:
        """The answers.

        Args:
            reasons: why there is no path, of each problem.
        """
        return [
            make_plan(
                path,
                reason,
                self.robot.num_dof,
                edge_checks=int(self.edge_checks[i]),
                sampling_checks=int(self.sampling_checks[i]),
                search_checks=int(self.search_checks[i]),
                planning_time_s=float(self.planning_time[i]),
                total_time_s=float(self.total_time[i]),
                roadmaps=max(1, int(self.roadmaps[i])),
            )
            for i, (path, reason) in enumerate(zip(self.paths, reasons, strict=True))
        ]
