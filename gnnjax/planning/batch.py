"""A batch of problems whose configurations and motions are tested together."""

import numpy as np

from gnnjax.arm.robot import Robot
from gnnjax.collision.sequences import Items, Outcome, SequenceTester
from gnnjax.planning.progress import Limits, Progress
from gnnjax.problems.problem import Problem


class Batch(Progress):
    """P problems, and what tests them."""

    def __init__(
        self,
        robot: Robot,
        problems: Problem,
        limits: Limits,
        tester: SequenceTester,
        shares: int = 1,
    ):
        """Args:
        robot: the arm.
        problems: `[P, ...]`.
        limits: of each.
        tester: of the arm.
        shares: of a larger batch that are worked on side by side.
        """
        super().__init__(robot, problems, limits, shares)
        self.tester = tester
        self.placed = tester.place(self.problems.scene)

    def test(self, ids: np.ndarray, items: Items) -> Outcome:
        """Tests sequences, one for each of some problems `[S]`, some more than once, and counts
        what that costs them."""
        outcome = self.tester(self.placed, items, len(ids), self.clock)
        np.add.at(self.edge_checks, ids, outcome.num_edges)
        np.add.at(self.search_checks, ids, outcome.num_checks)
        return outcome

    def warm_up(self) -> None:
        """Compiles all that tests need."""
        self.tester.warm_up(self.placed, self.robot.num_dof)
