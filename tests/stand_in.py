"""A planner that stands in for others, where what is made of plans is tested."""

import numpy as np

from gnnjax.planning.query import Plan, make_plan, plan_valid


class StandIn:
    """A planner that solves by a straight line what does not start at 0.5.

    Args:
        robot: to plan for.
        cost: of all paths; None: their lengths.
    """

    radius = None

    def __init__(self, robot, cost=None):
        self.robot, self.cost, self.batches = robot, cost, []

    def warm_up(self, scene, batch_size=1):
        pass

    def plan_batch(self, problems, *, seed=0):
        return plan_valid(self.robot, problems, 0.0, self._search)

    def _search(self, problems):
        self.batches.append(len(problems.start))
        return [self._plan(q, p) for q, p in zip(problems.start, problems.goal, strict=True)]

    def _plan(self, start, goal) -> Plan:
        costs = {"edge_checks": 1, "sampling_checks": 2, "search_checks": 7, "roadmaps": 1}
        times = {"planning_time_s": 0.5, "total_time_s": 0.5}
        path = None if start[0] == np.float32(0.5) else np.stack([start, goal])
        plan = make_plan(path, "no path", self.robot.num_dof, **costs, **times)
        return plan if path is None or self.cost is None else plan._replace(cost=self.cost)
