"""What a guide tells of the roadmap that is searched first: how likely its edges are to be free."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np

from gnnjax.errors import InputError
from gnnjax.planning.guided import Guided
from gnnjax.planning.looks import EDGE_PIECES
from gnnjax.planning.planner import Planner
from gnnjax.roadmap.graph import Roadmap
from gnnjax.roadmap.paths import for_each_edge
from gnnjax.roadmap.stored import insert_ends
from gnnjax.scene.scene import without_meant
from gnnjax.viewer.answers import Query
from gnnjax.viewer.frames import Frames

_PIECES = 4  # of what the hand does along an edge, which is no straight line


class PricedRoadmap(NamedTuple):
    """A roadmap as the hand sees it: E edges, whose lines are in pieces, and N nodes."""

    lines: np.ndarray  # [E pieces+1 3] m, where the hand is along each edge
    prices: np.ndarray  # [E] nats: 0 for surely free, large for surely not
    nodes: np.ndarray  # [N 3] m


def make_pricer(planner: Planner, frames: Frames, seed: int) -> Callable[[Query], PricedRoadmap]:
    """Makes what prices the edges of the first roadmap, its start and goal among the nodes.

    Args:
        planner: one with a guide.
        frames: of the arm.
        seed: of the roadmaps.

    Raises:
        InputError: a planner that has no guide, or that draws roadmaps for each query.
    """
    strategy = planner.strategy
    if not isinstance(strategy, Guided) or planner.options.sampled:
        guided = isinstance(strategy, Guided)
        by = "sampled=True" if guided else f"planner {planner.options.planner!r}"
        remedy = "leave it out" if guided else "use 'guided'"
        raise InputError(
            f"the roadmap is drawn anew for each query with {by}; {remedy} to see its prices"
        )
    guide = strategy.guide

    @jax.jit
    def priced(weights, stored, scene, start, goal) -> tuple[Roadmap, jax.Array]:
        roadmap = insert_ends(stored, start, goal, strategy.radius)
        reading = guide.read(weights, without_meant(scene))
        motions = guide.prices(weights, reading).motions
        return roadmap, for_each_edge(roadmap, lambda a, b: motions(a, b, EDGE_PIECES))

    def price(query: Query) -> PricedRoadmap:
        stored, _, _ = strategy.stored(seed, 0)
        found = priced(strategy.weights, stored, *query)
        roadmap, prices = jax.tree.map(np.asarray, found)
        node, slot = np.nonzero(
            roadmap.neighbor_mask & (np.arange(len(roadmap.nodes))[:, None] < roadmap.neighbors)
        )
        ends = roadmap.nodes[node], roadmap.nodes[roadmap.neighbors[node, slot]]
        along = np.linspace(0, 1, _PIECES + 1)[:, None]
        places = ends[0][:, None] + along * (ends[1] - ends[0])[:, None]
        lines = frames.tips(places.reshape(-1, places.shape[-1])).reshape(len(node), -1, 3)
        return PricedRoadmap(
            lines, prices[node, slot], frames.tips(roadmap.nodes[roadmap.node_mask])
        )

    return price
