"""How the planners of the experiments are set up; one place, so that they share their runs."""

from pathlib import Path
from typing import Any

from gnnjax.evaluate import EvaluateConfig

CLASSICAL = ("ompl:rrt_connect", "ompl:bit_star", "ompl:rrt_star", "ompl:prm")


def own_case(
    problems: Path, robot: str, planner: Any, num_nodes: int, num_problems: int | None = None
) -> EvaluateConfig:
    """A planner on roadmaps of a size.

    "gnn_paper" is the paper's network in the paper's algorithm: one roadmap, no second try.
    """
    paper: dict[str, Any] = {}
    if planner == "gnn_paper":
        planner = "gnn"
        paper = {"weights": Path("kuka_iiwa14_paper"), "max_roadmaps": 1}
    return EvaluateConfig(
        problems=problems,
        json=Path(),
        robot=robot,
        planner=planner,
        num_nodes=num_nodes,
        num_problems=num_problems,
        **paper,
    )


def classical_case(
    problems: Path, robot: str, planner: Any, num_problems: int | None = None
) -> EvaluateConfig:
    """A planner of OMPL, which has no roadmap size."""
    return EvaluateConfig(
        problems=problems, json=Path(), robot=robot, planner=planner, num_problems=num_problems
    )
