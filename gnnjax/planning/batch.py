"""A batch of problems whose configurations and motions are tested together."""

import jax
import numpy as np

from gnnjax.arm.robot import Robot
from gnnjax.collision.sequences import Items, Outcome, SequenceTester
from gnnjax.planning.progress import Limits, Progress
from gnnjax.problems.problem import Problem
from gnnjax.scene.mujoco_world import nearest_things


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

    def narrow_ends(self, ids: list[int]) -> dict[int, str]:
        """Which problems have an end that tests refuse, free as it is, and what is too near there.

        The parts that tests know are a little larger than those by which queries are accepted.

        Args:
            ids: problems.
        """
        ends = {name: getattr(self.problems, name) for name in ("start", "goal")}
        asked = [(i, name) for i in ids for name in ends if np.isfinite(ends[name][i]).all()]
        if not asked:
            return {}
        q, owner = np.stack([ends[name][i] for i, name in asked]), np.array([i for i, _ in asked])
        items = Items(np.arange(len(q)), owner, q, q, np.zeros(len(q), bool))
        refuted = self.tester(self.placed, items, len(q)).refuted
        found = {}
        for i, name in (one for one, no in zip(asked, refuted, strict=True) if no):
            scene = jax.tree.map(lambda x, i=i: x[i], self.problems.scene)
            near = nearest_things(self.robot, scene, ends[name][i])
            if near and i not in found:
                found[i] = f"at {name} {near}; choose a {name} that leaves them more room"
        return found

    def warm_up(self) -> None:
        """Compiles all that tests need."""
        self.tester.warm_up(self.placed, self.robot.num_dof)
