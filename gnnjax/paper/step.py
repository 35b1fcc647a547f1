"""Steps of the guidance network's training, and its validation."""

from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import nnx
from jax.sharding import Mesh

from gnnjax.arm.robot import Robot
from gnnjax.guide.view import point_distances
from gnnjax.paper.losses import graph_losses
from gnnjax.planning.planner import Planner
from gnnjax.problems.labelled import LabelledRoadmap
from gnnjax.problems.problem import Problem
from gnnjax.training.parallel import mean_over_devices
from gnnjax.training.run import TrainState

LOSS_OPTIONS = ("max_walk", "every_step", "all_nodes", "temperature", "validity_weight")


def make_step(
    graphdef: Any,
    optimizer: optax.GradientTransformation,
    robot: Robot,
    points: int,
    options: Mapping[str, Any],
    mesh: Mesh | None = None,
) -> Callable[[TrainState, LabelledRoadmap, jax.Array], tuple[TrainState, dict[str, jax.Array]]]:
    """The jitted step: one batch of roadmaps, gradients added graph by graph.

    Args:
        graphdef: of the network.
        optimizer: of its weights.
        robot: the arm.
        points: the network's `workspace_points`.
        options: of `graph_losses`, by the names of `LOSS_OPTIONS`.
        mesh: of the devices.
    """
    distances = point_distances(robot, points) if points else None

    def loss(weights: Any, data: LabelledRoadmap, key: jax.Array):
        losses = graph_losses(nnx.merge(graphdef, weights), data, key, distances, **options)
        return losses["loss"], losses

    gradient_of = jax.value_and_grad(loss, has_aux=True)

    def mean(weights: Any, graphs: tuple[LabelledRoadmap, jax.Array]):
        def add(total, graph):
            (_, losses), gradient = gradient_of(weights, *graph)
            return jax.tree.map(jnp.add, total, (losses, gradient)), None

        # On a CPU one graph after the other is twice as fast as side by side.
        first = jax.tree.map(lambda x: x[0], graphs)
        (_, losses), gradient = jax.eval_shape(gradient_of, weights, *first)
        zeros = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), (losses, gradient))
        total, _ = jax.lax.scan(add, zeros, graphs)
        return jax.tree.map(lambda x: x / len(graphs[1]), total)

    mean_of_all = mean_over_devices(mean, mesh)

    @jax.jit
    def step(state: TrainState, data: LabelledRoadmap, keys: jax.Array):
        losses, gradient = mean_of_all(state.weights, (data, keys))
        updates, optimizer_state = optimizer.update(gradient, state.optimizer, state.weights)
        return TrainState(optax.apply_updates(state.weights, updates), optimizer_state), losses

    return step


def validate(planner: Planner, problems: Problem) -> dict[str, float]:
    """Plans problems once each, as in the paper: one roadmap, no second try. Where no problem is
    solved, there is no cost."""
    plans = planner.plan_batch(problems)
    costs = [plan.cost for plan in plans if plan.success]
    return {
        "success": len(costs) / len(plans),
        "edge_checks": float(np.mean([plan.edge_checks or 0 for plan in plans])),
    } | ({"cost": float(np.mean(costs))} if costs else {})
