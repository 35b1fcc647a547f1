"""gnnjax: guided, batched motion planning for robot arms in JAX and MuJoCo.

The blocks of the paper that it starts from are in `gnnjax.paper`.
"""

from typing import TYPE_CHECKING, Any

import gnnjax.interruption  # noqa: F401  first: from here on a command can be interrupted
from gnnjax.arm.kinematics import forward_kinematics
from gnnjax.arm.robot import Robot, load_robot
from gnnjax.arm.turns import in_all_turns
from gnnjax.collision.certify import certify_edges, certify_path
from gnnjax.collision.checker import Checker, make_checker
from gnnjax.collision.edges import EdgeChecks
from gnnjax.collision.fused import obstacles_clear
from gnnjax.errors import InputError
from gnnjax.guide.field import field_guide
from gnnjax.guide.guide import Guide, Prices
from gnnjax.planning.load import load_planner, make_planner
from gnnjax.planning.options import PlannerOptions
from gnnjax.planning.planner import Planner
from gnnjax.planning.processes import PlannerProcesses
from gnnjax.planning.query import Plan, QueryPlanner
from gnnjax.planning.strategy import Strategy
from gnnjax.pose.goal import PoseGoal
from gnnjax.pose.inverse import Solutions, inverse_kinematics
from gnnjax.problems.family_problem import FamilyProblem, sample_family_problem
from gnnjax.problems.file import save_problems
from gnnjax.problems.labelled import Labels, label_roadmap
from gnnjax.problems.moveit import MoveItQuery, problem_from_moveit, query_from_moveit
from gnnjax.problems.problem import Problem, ProblemSet, sample_problem, sample_scene
from gnnjax.problems.shards import load_problems
from gnnjax.roadmap.graph import Roadmap, connect, default_radius
from gnnjax.roadmap.paths import cost_to_go, edge_validity
from gnnjax.roadmap.sampled import Samples, sample_free, sample_roadmap
from gnnjax.roadmap.stored import stored_roadmap
from gnnjax.scene.allowed import allow_contacts
from gnnjax.scene.batches import stack_scenes
from gnnjax.scene.cloud import Balls, Cloud, point_cloud
from gnnjax.scene.from_mjcf import scene_from_mjcf
from gnnjax.scene.moveit import scene_from_moveit
from gnnjax.scene.octomap import octomap, scene_from_octomap
from gnnjax.scene.own_points import without_robot
from gnnjax.scene.point_files import points_from_file
from gnnjax.scene.scene import (
    Allowed,
    Scene,
    make_scene,
    pad_scene,
    scene_from_shapes,
)
from gnnjax.scene.scene_file import scene_from_json, scene_to_json
from gnnjax.scene.shapes import Shape, box, capsule, cylinder, half_space, sphere
from gnnjax.scene.surfaces import (
    height_field,
    mesh,
    scene_from_height_field,
    scene_from_mesh,
    scene_from_points,
)
from gnnjax.search.greedy import Scorer, greedy_search
from gnnjax.search.knowledge import SearchResult
from gnnjax.search.lazy import lazy_search
from gnnjax.trajectory.execution import (
    Execution,
    Trace,
    execute_trajectories,
    execute_trajectory,
)
from gnnjax.trajectory.files import load_trajectory, robot_of_trajectory, save_trajectory
from gnnjax.trajectory.options import MotionOptions
from gnnjax.trajectory.simulate import ModelErrors
from gnnjax.trajectory.states import Setpoints, sample_trajectory
from gnnjax.trajectory.trajectory import Trajectory, time_path, time_paths

# Flax takes half a second to import, which only those pay who use networks.
if TYPE_CHECKING:
    from gnnjax.guide.motion import MotionNetwork, motion_guide
    from gnnjax.training.weights import load_network, save_network

_OF_NETWORKS = {
    "MotionNetwork": "gnnjax.guide.motion",
    "motion_guide": "gnnjax.guide.motion",
    "load_network": "gnnjax.training.weights",
    "save_network": "gnnjax.training.weights",
}


def __getattr__(name: str) -> Any:
    """What is imported when it is first asked for."""
    if name not in _OF_NETWORKS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(_OF_NETWORKS[name]), name)


__all__ = [
    "Allowed",
    "Balls",
    "Checker",
    "Cloud",
    "EdgeChecks",
    "Execution",
    "FamilyProblem",
    "Guide",
    "InputError",
    "Labels",
    "ModelErrors",
    "MotionNetwork",
    "MotionOptions",
    "MoveItQuery",
    "Plan",
    "Planner",
    "PlannerOptions",
    "PlannerProcesses",
    "PoseGoal",
    "Prices",
    "Problem",
    "ProblemSet",
    "QueryPlanner",
    "Roadmap",
    "Robot",
    "Samples",
    "Scene",
    "Scorer",
    "SearchResult",
    "Setpoints",
    "Shape",
    "Solutions",
    "Strategy",
    "Trace",
    "Trajectory",
    "allow_contacts",
    "box",
    "capsule",
    "certify_edges",
    "certify_path",
    "connect",
    "cost_to_go",
    "cylinder",
    "default_radius",
    "edge_validity",
    "execute_trajectories",
    "execute_trajectory",
    "field_guide",
    "forward_kinematics",
    "greedy_search",
    "half_space",
    "height_field",
    "in_all_turns",
    "inverse_kinematics",
    "label_roadmap",
    "lazy_search",
    "load_network",
    "load_planner",
    "load_problems",
    "load_robot",
    "load_trajectory",
    "make_checker",
    "make_planner",
    "make_scene",
    "mesh",
    "motion_guide",
    "obstacles_clear",
    "octomap",
    "pad_scene",
    "point_cloud",
    "points_from_file",
    "problem_from_moveit",
    "query_from_moveit",
    "robot_of_trajectory",
    "sample_family_problem",
    "sample_free",
    "sample_problem",
    "sample_roadmap",
    "sample_scene",
    "sample_trajectory",
    "save_network",
    "save_problems",
    "save_trajectory",
    "scene_from_height_field",
    "scene_from_json",
    "scene_from_mesh",
    "scene_from_mjcf",
    "scene_from_moveit",
    "scene_from_octomap",
    "scene_from_points",
    "scene_from_shapes",
    "scene_to_json",
    "sphere",
    "stack_scenes",
    "stored_roadmap",
    "time_path",
    "time_paths",
    "without_robot",
]
