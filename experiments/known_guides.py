"""Guides of the default planner to compare: each fulfils the contract of `gnnjax.guide.guide`."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from gnnjax.arm.robot import Robot
from gnnjax.collision.checker import make_checker
from gnnjax.guide.field import field_guide
from gnnjax.guide.guide import Guide, Prices
from gnnjax.guide.motion import MotionNetwork, motion_guide
from gnnjax.roadmap.graph import Roadmap, each_edge, edge_numbers
from gnnjax.scene.scene import Scene
from gnnjax.training.weights import load_network_as

BLOCKED = 100.0  # nats, of what the oracle has found blocked


class Kind(NamedTuple):
    """A guide that is compared."""

    title: str
    make: Callable[[Robot], Guide]
    color: str
    is_bound: bool = False  # it checks, which no guide may


def length_alone(robot: Robot) -> Guide:
    """Every motion has the price 0, so that the length alone counts: LazySP."""

    def prices(weights: jax.Array, scene: Scene) -> Prices:
        return Prices(
            lambda q: jnp.zeros(len(q)), lambda starts, ends, most: jnp.zeros(len(starts))
        )

    def stored(weights: jax.Array, scenes: Scene, blank: Float[Array, "N K"]) -> jax.Array:
        return jnp.broadcast_to(blank, (len(scenes.mask), *blank.shape))

    return Guide(
        jnp.zeros(()),
        lambda weights, scene: scene,
        prices,
        lambda roadmap: jnp.zeros(roadmap.neighbors.shape),
        stored,
    )


def lazy_field(robot: Robot) -> Guide:
    """The field without its table of stored edges: looked at where a path comes by, like a
    network."""
    return field_guide(robot)._replace(tabulate=None, stored=None)


def motion_network(robot: Robot) -> Guide:
    """The shipped motion network."""
    return motion_guide(robot, load_network_as(MotionNetwork, "motion", "guided"))


class _Edges(NamedTuple):
    """The edges of a stored roadmap, each once."""

    starts: Float[Array, "E D"]
    ends: Float[Array, "E D"]
    edge: Int[Array, "N K"]  # of each slot; E on padding


def oracle(robot: Robot) -> Guide:
    """Prices by checking, which count as no checks: a bound, not a guide."""
    checker = make_checker(robot)

    def prices(weights: jax.Array, scene: Scene) -> Prices:
        def nodes(q: Float[Array, "B D"]) -> Float[Array, " B"]:
            return jnp.where(checker.check_configurations(scene, q), 0.0, weights)

        def motions(
            starts: Float[Array, "E D"], ends: Float[Array, "E D"], most: int
        ) -> Float[Array, " E"]:
            valid = checker.check_edges(scene, starts, ends).valid
            at_ends = jnp.maximum(nodes(starts), nodes(ends))
            return jnp.where(valid, at_ends, weights)

        return Prices(nodes, motions)

    def stored(weights: jax.Array, scenes: Scene, edges: _Edges) -> Float[Array, "P N K"]:
        def one(scene: Scene) -> jax.Array:
            price = prices(weights, scene).motions(edges.starts, edges.ends, 1)
            return jnp.pad(price, (0, 1))[edges.edge]

        return jax.lax.map(one, scenes)

    return Guide(jnp.asarray(BLOCKED), lambda weights, scene: scene, prices, _tabulated, stored)


def _tabulated(roadmap: Roadmap) -> Any:
    nodes, edges = np.asarray(roadmap.nodes), each_edge(roadmap)
    starts, ends = nodes[edges.first], nodes[edges.second]
    return jax.tree.map(jnp.asarray, _Edges(starts, ends, edge_numbers(roadmap, edges)))


KINDS = {
    "length": Kind("length alone", length_alone, "tab:orange"),
    "field": Kind("distance field", field_guide, "darkblue"),
    "field_lazy": Kind("distance field, without its table", lazy_field, "cornflowerblue"),
    "network": Kind("motion network", motion_network, "tab:red"),
    "oracle": Kind("oracle", oracle, "black", is_bound=True),
}
