"""Edges of a stored roadmap in many scenes: how well guides tell them apart, and in what time."""

import functools
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from experiments.results import Row
from gnnjax.arm.robot import Robot
from gnnjax.collision.checker import make_checker
from gnnjax.guide.guide import Guide
from gnnjax.planning.guided import EDGE_PIECES
from gnnjax.roadmap.graph import Roadmap, each_edge
from gnnjax.roadmap.stored import stored_roadmap
from gnnjax.scene.scene import Scene
from gnnjax.train_motion import area_under_curve

_TIMED = 10  # scenes whose edges are priced for the clock


class StoredEdges(NamedTuple):
    """The edges of a stored roadmap, each once, labelled in R scenes."""

    roadmap: Roadmap
    scenes: Scene  # [R ...]
    starts: np.ndarray  # [E D]
    ends: np.ndarray  # [E D]
    valid: np.ndarray  # [R E]
    mask: np.ndarray  # [R E] true where both nodes are free


def stored_edges(robot: Robot, scenes: Scene, num_nodes: int, seed: int = 0) -> StoredEdges:
    """Checks each edge of the roadmap that the default planner begins with in each scene."""
    roadmap = stored_roadmap(robot, num_nodes - 2, seed)
    nodes, (first, second, _) = np.asarray(roadmap.nodes), each_edge(roadmap)
    starts, ends = nodes[first], nodes[second]
    check = _checks(robot)
    found = [check(scene, nodes, starts, ends) for scene in each_scene(scenes)]
    free, valid = (np.stack(part) for part in zip(*found, strict=True))
    return StoredEdges(roadmap, scenes, starts, ends, valid, free[:, first] & free[:, second])


@functools.cache
def _checks(robot: Robot) -> Callable[..., tuple[jax.Array, jax.Array]]:
    checker = make_checker(robot)

    @jax.jit
    def check(scene: Scene, nodes: jax.Array, starts: jax.Array, ends: jax.Array):
        free = checker.check_configurations(scene, nodes)
        return free, checker.check_edges(scene, starts, ends).valid

    return check


def each_scene(scenes: Scene) -> list[Scene]:
    """Scenes `[R]` one by one."""
    return [jax.tree.map(lambda x, i=i: x[i], scenes) for i in range(len(scenes.mask))]


def log_loss(prices: np.ndarray, valid: np.ndarray) -> float:
    """Mean loss, nats, of exp(-price) as the probability that a motion is free."""
    # Single precision cannot tell what is nearer to 0 or 1 from certainty, whose loss is infinite
    # where it is wrong.
    prices = np.clip(np.asarray(prices, float), 1e-7, 30.0)
    return float(np.where(valid, prices, -np.log(-np.expm1(-prices))).mean())


def ask(guide: Guide, sets: dict[str, StoredEdges]) -> dict[str, Row]:
    """What a guide makes of the edges of several sets.

    Returns:
        for each set, of its edges between free nodes: area under the ROC curve and log loss; and of
        all of a lone scene's, seconds an edge, priced one by one and from the guide's table.
    """

    @jax.jit
    def price(weights: Any, scene: Scene, starts: jax.Array, ends: jax.Array) -> jax.Array:
        reading = guide.read(weights, scene)
        return guide.prices(weights, reading).motions(starts, ends, EDGE_PIECES)

    found = {}
    for name, edges in sets.items():
        ends = edges.starts, edges.ends
        own = functools.partial(price, guide.weights)
        prices = np.stack([own(scene, *ends) for scene in each_scene(edges.scenes)])
        chosen, valid = prices[edges.mask], edges.valid[edges.mask]
        found[name] = {
            "area": area_under_curve(-chosen, valid),
            "log_loss": log_loss(chosen, valid),
            "num_edges": len(valid),
            "share_valid": float(valid.mean()),
            "edge_s": clock(lambda scene, own=own, ends=ends: own(scene, *ends), _timed(edges))
            / len(edges.starts),
            "table_edge_s": _clock_table(guide, edges),
        }
    return found


def _clock_table(guide: Guide, edges: StoredEdges) -> float | None:
    if guide.tabulate is None or guide.stored is None:
        return None
    table, stored = guide.tabulate(edges.roadmap), guide.stored

    @jax.jit
    def price(weights: Any, scene: Scene) -> jax.Array:
        reading = guide.read(weights, scene)
        return stored(weights, jax.tree.map(lambda x: x[None], reading), table)

    return clock(lambda scene: price(guide.weights, scene), _timed(edges)) / len(edges.starts)


def _timed(edges: StoredEdges) -> list[Scene]:
    return each_scene(edges.scenes)[:_TIMED]


def clock(call: Callable[[Any], jax.Array], turns: list[Any]) -> float:
    """Seconds that a compiled function takes in the fastest of some turns; whatever else the
    machine does only adds to that."""
    jax.block_until_ready(call(turns[0]))
    spent = []
    for turn in turns:
        begin = time.perf_counter()
        jax.block_until_ready(call(turn))
        spent.append(time.perf_counter() - begin)
    return min(spent)
