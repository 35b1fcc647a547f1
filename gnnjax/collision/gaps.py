"""The gaps between the arm and what it may touch, at many configurations at once.

Distances of the certificate, in NumPy and double precision, apart from the planning kernels. Arrays
have their components first and what they are computed for last, see `obstacles.py`.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from gnnjax.collision.bounds import Spheres
from gnnjax.collision.link_frames import joint_frames, of_links, pick, place
from gnnjax.collision.obstacles import Obstacles, sum_of_squares
from gnnjax.collision.travel import Moments, Motions, Travel


class Gaps(NamedTuple):
    """Whatever may touch: N pairs of a sphere or part and an obstacle, or of two of these."""

    moment: np.ndarray  # [N] at which of the moments
    gap: np.ndarray  # [N] m between their surfaces, at least
    motion: np.ndarray  # [N] m, that the gap may shrink by, at most
    touching: np.ndarray  # [N] that there is a contact, for sure


def gaps_of(body: Spheres, obstacles: Obstacles, at: Moments, motions: Motions) -> Gaps:
    """The gaps that a motion might use up, to obstacles and of the arm to itself.

    What is left out is farther apart than it can move: the gap of a sphere to an obstacle is at
    least that of the ball around all spheres of its link to the obstacle, and this at least that
    to a ball around the obstacle; none of the link's spheres moves more than the one that moves
    most. Likewise for two links. Comparisons are written so that what is not a number stays.

    Where spheres leave it open whether a gap is used up, and the part that they enclose may be
    farther away than they are, the part itself is looked at (`hulls.py`).

    Links that no joint moves are not compared with obstacles: no configuration changes the
    outcome, see `clear_of_base`.
    """
    travel = Travel(body, at, motions)
    found = [_gaps_to(obstacles, travel), _gaps_within(travel)]
    if obstacles.has_clouds:
        found.append(_gaps_to_clouds(obstacles, travel))
    return Gaps(*(np.concatenate(parts) for parts in zip(*found, strict=True)))


def _gaps_to(obstacles: Obstacles, travel: Travel) -> Gaps:
    body, at = travel.body, travel.at
    # Balls of links and balls of obstacles.
    centers, radii, exists = (
        x.take(at.scene, axis=-1) for x in (obstacles.centers, obstacles.radii, obstacles.exists)
    )
    apart = sum_of_squares(travel.middles[:, body.moving, None] - centers[:, None])  # [L M B]
    near = exists & ~(apart > (travel.reach[body.moving, None] + radii) ** 2)
    if obstacles.allowed is not None:
        near &= ~obstacles.allowed[body.links[body.moving]].take(at.scene, axis=-1)
    link, thing, moment = np.unravel_index(np.flatnonzero(near), near.shape)
    link = body.moving[link]
    found = _Links(link, moment, thing)
    sphere, moment, thing, gap, motion = _spheres_of(found, obstacles.distances, travel)
    if (gap > motion).all():
        return _clear(moment, gap, motion)
    part = body.part[sphere]

    def ask(rows: np.ndarray, margin: np.ndarray) -> np.ndarray:
        placed = travel.placed(part[rows], moment[rows])
        scene = at.scene[moment[rows]]
        return body.hulls.from_obstacles(part[rows], placed, obstacles, thing[rows], scene, margin)

    most = gap + body.slack[sphere]
    key = (moment * len(body.part_reach) + part) * len(obstacles.exists) + thing
    return _looked_at_closely(moment, gap, motion, most, travel.parts(part, moment), key, ask)


def _gaps_to_clouds(obstacles: Obstacles, travel: Travel) -> Gaps:
    body, at = travel.body, travel.at
    link, moment = np.indices((len(body.moving), len(at.scene))).reshape(2, -1)
    found = _Links(body.moving[link], moment, np.zeros_like(moment))

    def distances(points: np.ndarray, thing: np.ndarray, scene: np.ndarray) -> np.ndarray:
        return obstacles.cloud_distances(points, scene)  # of a scene's only cloud

    sphere, moment, _, gap, motion = _spheres_of(found, distances, travel)
    if (gap > motion).all():
        return _clear(moment, gap, motion)
    part = body.part[sphere]

    def ask(rows: np.ndarray, margin: np.ndarray) -> np.ndarray:
        placed = travel.placed(part[rows], moment[rows])
        scene = at.scene[moment[rows]]
        return body.hulls.from_clouds(part[rows], placed, obstacles, scene, margin)

    most = gap + body.slack[sphere]
    key = moment * len(body.part_reach) + part
    return _looked_at_closely(moment, gap, motion, most, travel.parts(part, moment), key, ask)


class _Links(NamedTuple):
    """N links, each at a moment and before a thing in its scene."""

    link: np.ndarray  # [N]
    moment: np.ndarray  # [N]
    thing: np.ndarray  # [N]


def _spheres_of(
    near: _Links,
    distances: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray],
    travel: Travel,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Every sphere of the links whose ball may come to touch the thing: its number, moment and
    thing, the gap between them, m, and how far it may move, m.

    Args:
        near: links to be looked at.
        distances: of points `[3, N]` to things `[N]` of scenes `[N]`, m.
        travel: of the links at the moments.
    """
    body, scene = travel.body, travel.at.scene
    link, moment, thing = near
    apart = distances(pick(travel.middles, link, moment), thing, scene[moment])
    left = ~(apart > pick(travel.reach, link, moment))
    link, moment, thing = link[left], moment[left], thing[left]
    row, sphere = members(body.first[link], body.count[link])
    link, moment, thing = link[row], moment[row], thing[row]
    points = place(pick(travel.frames, link, moment), body.centers[:, sphere])
    gap = distances(points, thing, scene[moment]) - body.radii[sphere]
    return sphere, moment, thing, gap, travel.spheres(sphere, moment, points)


def _gaps_within(travel: Travel) -> Gaps:
    body, (a, b) = travel.body, travel.body.link_pairs
    reach = (body.ball_radii[a] + body.ball_radii[b])[:, None] + travel.link_pairs()
    apart = sum_of_squares(travel.middles[:, a] - travel.middles[:, b])
    near = ~(apart > reach**2)  # [Q B]
    couple, moment = np.unravel_index(np.flatnonzero(near), near.shape)
    row, pair = members(body.pair_first[couple], body.pair_count[couple])
    couple, moment = couple[row], moment[row]
    first, second = body.pairs[pair].T
    between = sum_of_squares(
        place(pick(travel.frames, a[couple], moment), body.centers[:, first])
        - place(pick(travel.frames, b[couple], moment), body.centers[:, second])
    )
    gap = np.sqrt(between) - body.radii[first] - body.radii[second]
    motion = travel.pairs(pair, moment)
    if (gap > motion).all():
        return _clear(moment, gap, motion)
    part, other = body.part[first], body.part[second]

    def ask(rows: np.ndarray, margin: np.ndarray) -> np.ndarray:
        one, two = part[rows], other[rows]
        placed, beside = (travel.placed(x, moment[rows]) for x in (one, two))
        return body.hulls.from_parts(one, placed, two, beside, margin)

    number = body.part_pair[part, other]
    most = gap + body.slack[first] + body.slack[second]
    key = moment * max(1, len(body.part_pair_reach)) + number
    return _looked_at_closely(
        moment, gap, motion, most, travel.part_pairs(number, moment), key, ask
    )


def _clear(moment: np.ndarray, gap: np.ndarray, motion: np.ndarray) -> Gaps:
    """Gaps of spheres that leave nothing open, as they mostly do: parts need no look."""
    return Gaps(moment, gap, motion, np.zeros(len(gap), bool))


def _looked_at_closely(
    moment: np.ndarray,
    gap: np.ndarray,
    motion: np.ndarray,
    most: np.ndarray,
    part_motion: np.ndarray,
    key: np.ndarray,
    ask: Callable[[np.ndarray, np.ndarray], np.ndarray],
) -> Gaps:
    """The gaps `[N]` of spheres, but of parts where these may show what spheres leave open.

    Args:
        moment: at which of the moments.
        gap: of spheres, m.
        motion: that it may shrink by, m.
        most: that the gap of the parts can be, m.
        part_motion: that this may shrink by, m.
        key: the same for rows of the same moment and parts.
        ask: gaps of the parts of rows, as far as a margin is concerned.
    """
    spheres = Gaps(moment, gap, motion, ~(most > 0))
    open_rows = np.flatnonzero(~(gap > motion))
    if not (most[open_rows] > gap[open_rows]).any():
        return spheres
    _, first, group = np.unique(key[open_rows], return_index=True, return_inverse=True)
    reach = np.full(len(first), np.inf)
    np.minimum.at(reach, group, most[open_rows])
    wanted = reach > part_motion[open_rows[first]]
    rows = open_rows[first[wanted]]
    if not len(rows):
        return spheres
    left = np.ones(len(gap), bool)
    left[open_rows[wanted[group]]] = False
    found = Gaps(
        moment[rows], ask(rows, part_motion[rows]), part_motion[rows], np.zeros(len(rows), bool)
    )
    kept = (x[left] for x in spheres)
    return Gaps(*(np.concatenate(two) for two in zip(kept, found, strict=True)))


def clear_of_base(body: Spheres, obstacles: Obstacles) -> np.ndarray:
    """Whether obstacles are clear of the links that no joint moves, `[M P]`, or `[M+1 P]` with
    clouds, which come last."""
    points, radii, bodies = _base(body)
    sphere, thing, scene = np.indices((len(radii), *obstacles.exists.shape)).reshape(3, -1)
    gap = obstacles.distances(points[:, sphere], thing, scene) - radii[sphere]
    apart = (gap > 0).reshape(len(radii), *obstacles.exists.shape)
    if obstacles.allowed is not None:
        apart |= obstacles.allowed[bodies]
    clear = np.all(apart, axis=0) | ~obstacles.exists
    if not obstacles.has_clouds:
        return clear
    sphere, scene = np.indices((len(radii), obstacles.exists.shape[1])).reshape(2, -1)
    gap = obstacles.cloud_distances(points[:, sphere], scene) - radii[sphere]
    shape = len(radii), obstacles.exists.shape[1]  # also without any sphere
    of_clouds = np.all((gap > 0).reshape(shape), axis=0, keepdims=True)
    return np.concatenate([clear, of_clouds])


@functools.cache
def _base(body: Spheres) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centers `[3, F]`, radii `[F]` and bodies `[F]` of the spheres that no joint moves."""
    fixed = np.flatnonzero(~np.isin(body.link_of, body.moving))
    frames = of_links(body, joint_frames(body, body.robot.home[:, None]))
    frames = frames[:, :, body.link_of[fixed], 0]
    return place(frames, body.centers[:, fixed]), body.radii[fixed], body.bodies[fixed]


def members(first: np.ndarray, count: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """For groups of consecutive numbers: of which group each member is, and its number."""
    row = np.repeat(np.arange(len(count)), count)
    return row, np.arange(len(row)) + (first - np.cumsum(count) + count)[row]
