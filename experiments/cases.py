"""How the planners of the experiments are set up; one place, so that they share their runs."""

import dataclasses
from pathlib import Path
from typing import Any

from gnnjax.evaluate import EvaluateConfig
from gnnjax.planning.options import CHEAP

OURS = ("guided", "gnn", "gnn_lazy", "distance", "oracle", "prm", "lazysp")
DEAR = 1000.0  # us; a check that costs so much is not asked for where a guide can tell
CLASSICAL = ("ompl:rrt_connect", "ompl:bit_star", "ompl:rrt_star", "ompl:prm")

# Names that are no planner's own: the planner behind them, and its options.
# - gnn_paper: the paper's network in the paper's algorithm: one roadmap, no second try.
# - guided_roadmap: paths as the roadmap has them, not shortened.
# - guided_dear: told that a check takes a millisecond, so that it asks for as few as it can.
# - guided_sampled: the same search on the very roadmaps that the other planners search.
_VARIANTS: dict[str, tuple[str, dict[str, Any]]] = {
    "gnn_paper": ("gnn", {"weights": Path("kuka_iiwa14_paper"), "max_roadmaps": 1}),
    "guided_roadmap": ("guided", {"shorten": False}),
    "guided_dear": ("guided", {"check_cost": DEAR}),
    "guided_sampled": ("guided", {"shorten": False, "sampled": True}),
    "guided@0.02": ("guided", {"resolution": 0.02}),
    "ompl:rrt_connect@0.02": ("ompl:rrt_connect", {"resolution": 0.02}),
    "ompl:rrt_connect@simplified": ("ompl:rrt_connect", {"simplify": True}),
}
GUIDED = ("guided", "guided_dear", "guided_roadmap", "guided_sampled")


def own_case(
    problems: Path, robot: str, planner: Any, num_nodes: int, num_problems: int | None = None
) -> EvaluateConfig:
    """A planner on roadmaps of a size, or a variant of one. One that searches no roadmaps has the
    same case for all sizes, so that it is measured once."""
    case = classical_case(problems, robot, planner, num_problems)
    sized = dataclasses.replace(case, num_nodes=num_nodes)
    return case if nodes_of(sized) is None else sized


def first_roadmap_case(
    problems: Path, robot: str, planner: Any, num_nodes: int, num_problems: int, **changes: Any
) -> EvaluateConfig:
    """The same with one roadmap, no second try, and other changes."""
    case = own_case(problems, robot, planner, num_nodes, num_problems)
    return dataclasses.replace(case, max_roadmaps=1, **changes)


def nodes_of(case: EvaluateConfig) -> int | None:
    """How many nodes the roadmaps have that a planner searches; None for one that searches none, as
    OMPL's do, and the default one where checks are cheap."""
    grows_trees = case.planner == "guided" and case.shorten and not case.sampled
    if case.is_classical or (grows_trees and case.check_cost <= CHEAP):
        return None
    return case.num_nodes


def classical_case(
    problems: Path, robot: str, planner: Any, num_problems: int | None = None
) -> EvaluateConfig:
    """A planner that searches no roadmaps, which has no size, or a variant of one."""
    planner, options = _VARIANTS.get(planner, (planner, {}))
    return EvaluateConfig(
        problems=problems,
        json=Path(),
        robot=robot,
        planner=planner,
        num_problems=num_problems,
        **options,
    )
