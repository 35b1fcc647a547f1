"""gnnjax: learned, batched motion planning for robot arms in JAX and MuJoCo."""

import gnnjax.interruption  # noqa: F401  first: from here on a command can be interrupted
from gnnjax.certify import certify_edges, certify_path
from gnnjax.checkpoint import load_network, save_network
from gnnjax.collision import Checker, EdgeChecks, boxes_clear, make_checker
from gnnjax.errors import InputError
from gnnjax.family_problem import FamilyProblem, sample_family_problem
from gnnjax.guided_planner import GuidedPlanner
from gnnjax.kinematics import forward_kinematics
from gnnjax.labels import Labels, cost_to_go, edge_validity, label_roadmap
from gnnjax.model import GuidanceNetwork
from gnnjax.motion import MotionNetwork
from gnnjax.planner import Planner, load_planner
from gnnjax.problem import Problem, ProblemSet, load_problems, sample_problem, save_problems
from gnnjax.query import Plan
from gnnjax.roadmap import Roadmap, connect, default_radius, graphs_tuple, sample_roadmap
from gnnjax.robot import Robot, load_robot
from gnnjax.sampling import Samples, sample_free
from gnnjax.scene import Scene, make_scene, pad_scene, sample_scene, scene_from_json, scene_to_json
from gnnjax.search import Scorer, SearchResult, greedy_search, lazy_search

__all__ = [
    "Checker",
    "EdgeChecks",
    "FamilyProblem",
    "GuidanceNetwork",
    "GuidedPlanner",
    "InputError",
    "Labels",
    "MotionNetwork",
    "Plan",
    "Planner",
    "Problem",
    "ProblemSet",
    "Roadmap",
    "Robot",
    "Samples",
    "Scene",
    "Scorer",
    "SearchResult",
    "boxes_clear",
    "certify_edges",
    "certify_path",
    "connect",
    "cost_to_go",
    "default_radius",
    "edge_validity",
    "forward_kinematics",
    "graphs_tuple",
    "greedy_search",
    "label_roadmap",
    "lazy_search",
    "load_network",
    "load_planner",
    "load_problems",
    "load_robot",
    "make_checker",
    "make_scene",
    "pad_scene",
    "sample_family_problem",
    "sample_free",
    "sample_problem",
    "sample_roadmap",
    "sample_scene",
    "save_network",
    "save_problems",
    "scene_from_json",
    "scene_to_json",
]
