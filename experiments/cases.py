"""How the planners of the experiments are set up; one place, so that they share their runs."""

from pathlib import Path
from typing import Any

from gnnjax.evaluate import EvaluateConfig

CLASSICAL = ("ompl:rrt_connect", "ompl:bit_star", "ompl:rrt_star", "ompl:prm")


# What stands behind names that are no planner's own: the planner, and its options.
_VARIANTS: dict[str, tuple[str, dict[str, Any]]] = {
    "gnn_paper": ("gnn", {"weights": Path("kuka_iiwa14_paper"), "max_roadmaps": 1}),
    "guided_roadmap": ("guided", {"shorten": False}),
    "guided_sampled": ("guided", {"shorten": False, "sampled": True}),
}
GUIDED = ("guided", "guided_roadmap", "guided_sampled")


def own_case(
    problems: Path, robot: str, planner: Any, num_nodes: int, num_problems: int | None = None
) -> EvaluateConfig:
    """A planner on roadmaps of a size.

    "gnn_paper" is the paper's network in the paper's algorithm: one roadmap, no second try.
    "guided_roadmap" does not shorten its paths, and "guided_sampled" searches the very roadmaps
    that the other planners search, to compare searches.
    """
    planner, changes = _VARIANTS.get(planner, (planner, {}))
    return EvaluateConfig(
        problems=problems,
        json=Path(),
        robot=robot,
        planner=planner,
        num_nodes=num_nodes,
        num_problems=num_problems,
        **changes,
    )


def classical_case(
    problems: Path, robot: str, planner: Any, num_problems: int | None = None
) -> EvaluateConfig:
    """A planner of OMPL, which has no roadmap size."""
    return EvaluateConfig(
        problems=problems, json=Path(), robot=robot, planner=planner, num_problems=num_problems
    )
