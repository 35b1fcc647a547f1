"""The paper's planner, and a lazy one with the same network, as strategies."""

from typing import Any

import jax
from flax import nnx

from gnnjax.arm.robot import Robot
from gnnjax.errors import InputError
from gnnjax.guide.view import point_distances
from gnnjax.paper.encoding import Encoding
from gnnjax.paper.graphs import edge_bucket
from gnnjax.paper.network import GuidanceNetwork
from gnnjax.paper.validity import edge_price
from gnnjax.planning.options import PlannerOptions
from gnnjax.planning.strategy import Checks, Strategy, on_sampled_roadmaps
from gnnjax.roadmap.graph import Roadmap
from gnnjax.scene.scene import Scene
from gnnjax.search.greedy import Scorer, greedy_search
from gnnjax.search.knowledge import SearchResult
from gnnjax.search.lazy import lazy_search
from gnnjax.training.weights import default_weights, load_network_as


def network_scorer(network: GuidanceNetwork, encoding: Encoding, roadmap: Roadmap) -> Scorer:
    """Prefers what the guidance network does, which remembers the path walked so far."""
    return Scorer(
        init=network.init_path,
        advance=lambda carry, node: network.extend_path(encoding, carry, node),
        values=lambda carry, node: network.guidance_values(encoding, carry, roadmap, node),
    )


def from_weights(robot: Robot, options: PlannerOptions) -> Strategy:
    """The strategy "gnn" or "gnn_lazy" with the weights that the options name.

    By default those of the robot, or of the Kuka, which serve other arms.
    """
    weights = options.weights or default_weights(robot.name)
    network = load_network_as(GuidanceNetwork, weights, options.planner)
    return (gnn_lazy if options.planner == "gnn_lazy" else gnn)(robot, network, options)


def gnn(robot: Robot, network: GuidanceNetwork, options: PlannerOptions) -> Strategy:
    """Algorithm 1: walk to the neighbor that the network values most."""
    return _with_network(robot, network, options, lazy=False)


def gnn_lazy(robot: Robot, network: GuidanceNetwork, options: PlannerOptions) -> Strategy:
    """Lazy search for the path that is cheapest by length and the network's doubts.

    Raises:
        InputError: the network was trained without them.
    """
    if not network.validity_head:
        raise InputError(
            "planner 'gnn_lazy' needs a network that was trained with validity_weight > 0"
        )
    return _with_network(robot, network, options, lazy=True)


def _with_network(
    robot: Robot, network: GuidanceNetwork, options: PlannerOptions, *, lazy: bool
) -> Strategy:
    if robot.num_dof > network.num_dof:
        raise InputError(
            f"the network is made for up to {network.num_dof} joints, {robot.name} has "
            f"{robot.num_dof}; train one with --num-dof {robot.num_dof}"
        )
    # Apart, so that weights are arguments of the compiled functions and not constants in them.
    graphdef, weights = nnx.split(network)
    points = network.workspace_points
    distances = point_distances(robot, points) if points else None

    def search(
        weights: Any, roadmap: Roadmap, scene: Scene, checks: Checks, status: jax.Array
    ) -> SearchResult:
        network = nnx.merge(graphdef, weights)
        encoding = network.encode(roadmap, scene, edge_bucket(len(roadmap.nodes)), distances)
        if lazy:
            return lazy_search(roadmap, checks.edge, status, edge_price(encoding.validity))
        scorer = network_scorer(network, encoding, roadmap)
        return greedy_search(roadmap, scorer, checks.edge, status)

    return on_sampled_roadmaps(robot, options, search, weights)
