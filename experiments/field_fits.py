"""What distance fields say of labelled edges, what that takes, and the calibration that fits it."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from experiments.guide_edges import StoredEdges, clock, each_scene
from gnnjax.arm.robot import Robot
from gnnjax.collision.spheres import moved_by_joint
from gnnjax.guide.field import margin_function, reach_grid
from gnnjax.planning.guided import EDGE_PIECES
from gnnjax.scene.field import distance_field
from gnnjax.scene.scene import Scene

_PLACES = 1024  # of the batch in which look-ups are clocked


class Margins(NamedTuple):
    """What a field says of labelled edges, each once."""

    margin: np.ndarray  # [E] m
    valid: np.ndarray  # [E]


def num_pieces(lengths: np.ndarray, spacing: float) -> np.ndarray:
    """Pieces that motions `[E]` are looked at in."""
    return np.clip(np.ceil(lengths / spacing), 1, EDGE_PIECES)


def edge_margins(
    robot: Robot, cells: int, edges: StoredEdges, spacings: tuple[float, ...]
) -> list[Margins]:
    """The least margin along each edge between free nodes, for each spacing."""
    grid = reach_grid(robot, cells)
    field, margin = distance_field(grid), margin_function(robot, grid)
    lengths = np.linalg.norm(edges.ends - edges.starts, axis=1)

    @jax.jit
    def least(scene: Scene, pieces: jax.Array) -> jax.Array:
        fraction = jnp.minimum(jnp.arange(EDGE_PIECES + 1) / pieces[:, None], 1.0)
        along = edges.starts[:, None] + fraction[..., None] * (edges.ends - edges.starts)[:, None]
        found = margin(field(scene), along.reshape(-1, along.shape[-1]))
        return found.reshape(fraction.shape).min(axis=1)

    valid, found = edges.valid[edges.mask], []
    for spacing in spacings:
        pieces = num_pieces(lengths, spacing).astype(np.float32)
        margins = np.stack([least(scene, pieces) for scene in each_scene(edges.scenes)])
        found.append(Margins(margins[edges.mask].astype(float), valid))
    return found


def clocks(robot: Robot, cells: int, scenes: Scene) -> tuple[float, float, int]:
    """Seconds of a scene's field and of a place that is looked at; spheres of the arm."""
    grid = reach_grid(robot, cells)
    read, margin = jax.jit(distance_field(grid)), jax.jit(margin_function(robot, grid))
    rng = np.random.default_rng(0)
    q = rng.uniform(robot.joint_lower, robot.joint_upper, (_PLACES, robot.num_dof))
    q = jnp.asarray(q, jnp.float32)
    readings = [read(scene) for scene in each_scene(scenes)]
    field_s = clock(read, each_scene(scenes))
    place_s = clock(lambda reading: margin(reading, q), readings) / _PLACES
    return field_s, place_s, sum(moved_by_joint(robot))


def fit(margins: Margins) -> tuple[float, float]:
    """Offset and scale [m] of the likeliest logistic probability, by Newton's method."""
    # In centimetres, and as slope and intercept, in which the loss is convex.
    x = np.stack([100 * margins.margin, np.ones(len(margins.margin))], axis=1)
    prior = weights = np.array([1.0, 0.0])
    for _ in range(50):
        free = 1 / (1 + np.exp(-np.clip(x @ weights, -40, 40)))
        # A whisper of a prior, for edges that margins tell apart without fail.
        curvature = (x * (free * (1 - free))[:, None]).T @ x + 1e-3 * np.eye(2)
        step = np.linalg.solve(curvature, x.T @ (margins.valid - free) - 1e-3 * (weights - prior))
        weights = weights + step * min(1.0, 1.0 / max(np.abs(step).max(), 1e-12))
    slope, intercept = weights.tolist()
    return -0.01 * intercept / slope, 0.01 / slope


def log_loss_of(margins: Margins, pair: tuple[float, float]) -> float:
    """Mean negative log likelihood, nats, of labels by a pair's probabilities."""
    nats = (pair[0] - margins.margin) / pair[1]
    return float(np.logaddexp(0, np.where(margins.valid, nats, -nats)).mean())
