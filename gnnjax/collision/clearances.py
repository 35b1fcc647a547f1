"""How far the arm is from obstacles and from itself, by the gaps that certificates use."""

import numpy as np

from gnnjax.arm.robot import Robot
from gnnjax.collision.bounds import spheres_of
from gnnjax.collision.certify import PIECES_A_BATCH, configurations_of, cut, known_obstacles
from gnnjax.collision.gaps import clear_of_base, gaps_of
from gnnjax.collision.obstacles import Obstacles, owners_of
from gnnjax.collision.travel import Moments, Motions
from gnnjax.scene.scene import Scene, make_scene


def clearances(
    robot: Robot,
    scene: Scene | Obstacles,
    q: np.ndarray,
    owner: np.ndarray | None = None,
    most: float = np.inf,
) -> np.ndarray:
    """Distances [m] of the arm at q `[B, D]` to obstacles and itself, `[B]`, at least.

    Infinite where there is nothing, NaN where q is not finite. They are those of the spheres around
    the arm's parts; but where these do not tell whether the distance is more than `most`, the parts
    are looked at. With `most=0` the distance is positive just where the arm is free, but for what
    is free by less than a millimetre, of which a little counts as touching.

    Args:
        robot: the arm.
        scene: one scene, or P scenes `[P, M, ...]`; or their `known_obstacles`.
        q: configurations.
        owner: `[B]`, in which of P scenes each is; None for one scene.
        most: what is farther away than this [m] may count as if it were nothing.
    """
    q = configurations_of(robot, "q", q)
    obstacles = known_obstacles(robot, scene)
    owner = owners_of(obstacles, owner, len(q))
    body = spheres_of(robot)
    motions = Motions(None, body.same_rates(most))
    found = np.where(np.isfinite(q).all(axis=1), np.inf, np.nan)
    finite = np.flatnonzero(found == np.inf)
    for first in range(0, len(finite), PIECES_A_BATCH):
        rows = finite[first : first + PIECES_A_BATCH]
        at = Moments(q[rows].T.copy(), owner[rows], np.zeros(len(rows), int), np.ones(len(rows)))
        gaps = gaps_of(body, obstacles, at, motions)
        np.minimum.at(found, rows[gaps.moment], gaps.gap)
    return found


def configuration_clearance(robot: Robot, scene: Scene, q: np.ndarray) -> float:
    """`clearances` of one configuration `[D]` in one scene."""
    return float(clearances(robot, scene, np.asarray(q)[None])[0])


def is_self_free(robot: Robot, q: np.ndarray) -> np.ndarray:
    """Whether the arm at configurations `[B, D]` is clear of itself, `[B]`."""
    return clearances(robot, make_scene([], []), q, most=0.0) > 0


def base_clear(robot: Robot, scene: Scene | Obstacles) -> np.ndarray:
    """Whether the arm's base is clear of each obstacle, `[M]`, or `[P, M]` in P scenes.

    The base is what no joint moves, which certificates and clearances leave out. True where no
    obstacle is. One more tells of the cloud, where scenes have one.
    """
    obstacles = known_obstacles(robot, scene)
    clear = clear_of_base(spheres_of(robot), obstacles).T
    return clear if obstacles.is_batch else clear[0]


def path_clearance(robot: Robot, scene: Scene, path: np.ndarray, resolution: float) -> float:
    """Least distance [m] of the arm to obstacles and itself along a path, seen at samples.

    Args:
        robot: the arm.
        scene: one scene.
        path: `[L, D]` configurations, two or more, joined by straight lines.
        resolution: largest distance of neighbouring samples, configuration units.
    """
    path = configurations_of(robot, "path", path)
    starts, ends = path[:-1], path[1:]
    whole = np.arange(len(starts)), np.zeros(len(starts)), np.ones(len(starts))
    edge, low, _ = cut(*whole, np.linalg.norm(ends - starts, axis=1) / resolution)
    samples = starts[edge] + low[:, None] * (ends - starts)[edge]
    return float(clearances(robot, scene, np.concatenate([samples, path[-1:]])).min())
