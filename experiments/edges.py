"""Labelled edges of roadmaps, how well a motion network tells them apart, and what that takes."""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from experiments.operations import operations
from gnnjax.arm.robot import Robot, load_robot
from gnnjax.collision.checker import EDGE_RESOLUTION, make_checker
from gnnjax.guide.motion import MotionNetwork, make_prices
from gnnjax.guide.view import arm_view
from gnnjax.problems.labelled import LabelledRoadmap, generate_labelled, problem_keys
from gnnjax.roadmap.graph import each_edge
from gnnjax.scene.scene import Scene
from gnnjax.train_motion import area_under_curve

EDGE_LENGTH = 3.0  # rad, of the edge that operations are counted for
_BATCH = 1024  # configurations of the programs in which operations are counted


@dataclasses.dataclass(frozen=True)
class Edges:
    """Labelled edges of R roadmaps of an arm, padded to E each."""

    robot: Robot
    scenes: Scene  # [R ...]
    starts: np.ndarray  # [R E D]
    ends: np.ndarray  # [R E D]
    valid: np.ndarray  # [R E]
    mask: np.ndarray  # [R E] false on padding

    @property
    def lengths(self) -> np.ndarray:
        """`[R E]`, configuration units."""
        return np.linalg.norm(self.ends - self.starts, axis=-1)

    @property
    def num_boxes(self) -> int:
        """Boxes of a scene in the mean, rounded."""
        return max(1, round(float(self.scenes.mask.sum(axis=-1).mean())))


def labelled_edges(robot_name: str, num_roadmaps: int, num_nodes: int) -> Edges:
    """The edges of validation roadmaps, each once."""
    robot = load_robot(robot_name)
    draw = generate_labelled(robot, num_nodes)
    drawn = draw(problem_keys(0, "validation", 0, num_roadmaps))
    assert isinstance(drawn, LabelledRoadmap)
    roadmaps, labels = jax.tree.map(np.asarray, (drawn.roadmap, drawn.labels))
    found = [each_edge(jax.tree.map(lambda x, i=i: x[i], roadmaps)) for i in range(num_roadmaps)]
    most = max(len(edges.first) for edges in found)
    shape = (num_roadmaps, most)
    starts, ends = np.zeros((2, *shape, robot.num_dof), np.float32)
    valid, mask = np.zeros((2, *shape), bool)
    for i, (first, second, slot) in enumerate(found):
        num = len(first)
        starts[i, :num] = roadmaps.nodes[i, first]
        ends[i, :num] = roadmaps.nodes[i, second]
        valid[i, :num] = labels.edge_valid[i, first, slot]
        mask[i, :num] = True
    scenes = jax.tree.map(np.asarray, drawn.problem.scene)
    return Edges(robot, scenes, starts, ends, valid, mask)


def areas_under_curve(
    network: MotionNetwork, edges: Edges, spacings: tuple[float, ...]
) -> list[float]:
    """How well a network tells valid edges from blocked ones, for each spacing."""
    view = arm_view(edges.robot, network.num_points)
    graphdef, weights = nnx.split(network)
    most = math.ceil(float(edges.lengths.max()) / min(spacings))

    @jax.jit
    def scores(weights: Any, scene: Scene, starts: jax.Array, ends: jax.Array, spacing: jax.Array):
        seen = functools.partial(view, scene)
        prices = make_prices(nnx.merge(graphdef, weights), seen, spacing)
        return -prices.motions(starts, ends, most)

    areas = []
    for spacing in spacings:
        found = [
            scores(weights, jax.tree.map(lambda x, i=i: x[i], edges.scenes), *ends, spacing)
            for i, ends in enumerate(zip(edges.starts, edges.ends, strict=True))
        ]
        areas.append(area_under_curve(np.stack(found)[edges.mask], edges.valid[edges.mask]))
    return areas


def _counted(edges: Edges, function: Callable) -> int:
    """Operations of a compiled function `(scene, q [B D])`, for a configuration."""
    scene = jax.tree.map(lambda x: jnp.asarray(x[0]), edges.scenes)
    q = jnp.zeros((_BATCH, edges.robot.num_dof))
    program = jax.jit(function).lower(scene, q).compile().as_text()
    assert program is not None
    return operations(program, _BATCH, edges.num_boxes).total()


def view_operations(edges: Edges, num_points: int) -> int:
    """Operations of what a network sees of the arm at a configuration."""
    return _counted(edges, arm_view(edges.robot, num_points))


def check_operations(edges: Edges) -> int:
    """Operations of checking a free edge between its ends with the fused kernel."""
    checker = make_checker(edges.robot, axis_aligned=True)
    between = math.ceil(EDGE_LENGTH / EDGE_RESOLUTION) - 1
    return between * _counted(edges, checker.check_configurations)


def network_operations(network: MotionNetwork) -> int:
    """Operations of the network itself for a piece of a motion, by formula."""
    weights = sum(x.size for x in jax.tree.leaves(nnx.state(network, nnx.Param)))
    return 2 * weights + 10 * (network.num_points + 1)
