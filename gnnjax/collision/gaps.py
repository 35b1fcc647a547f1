"""The gaps between the arm and what it may touch, at many configurations at once.

Distances of the certificate, in NumPy and double precision, apart from the planning kernels. Arrays
have their components first and what they are computed for last, see `obstacles.py`.
"""

import functools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from gnnjax.collision.bounds import Rates, Spheres
from gnnjax.collision.link_frames import link_frames, place
from gnnjax.collision.obstacles import Obstacles, sum_of_squares

# m; added to every motion, for what double precision rounds off. That is less than 1e-11 m among
# numbers below 1e4 m.
_ROUNDING = 1e-9


class Moments(NamedTuple):
    """B configurations, and the motions whose middles they are."""

    q: np.ndarray  # [D B]
    scene: np.ndarray  # [B] in which scene each is
    motion: np.ndarray  # [B] of which motion it is a part
    share: np.ndarray  # [B] how much of that is done until the part's ends, at most


class Gaps(NamedTuple):
    """Whatever may touch: N pairs of a sphere or part and an obstacle, or of two of these."""

    moment: np.ndarray  # [N] at which of the moments
    gap: np.ndarray  # [N] m between their surfaces, at least
    motion: np.ndarray  # [N] m, that the gap may shrink by, at most
    touching: np.ndarray  # [N] that there is a contact, for sure


def gaps_of(body: Spheres, obstacles: Obstacles, at: Moments, rates: Rates) -> Gaps:
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
    frames = link_frames(body, at.q)
    middles = place(frames, body.middles[:, :, None])  # [3 L B]
    found = [
        _gaps_to(body, obstacles, at, rates, frames, middles),
        _gaps_within(body, at, rates, frames, middles),
    ]
    if obstacles.has_clouds:
        found.append(_gaps_to_clouds(body, obstacles, at, rates, frames, middles))
    return Gaps(*(np.concatenate(parts) for parts in zip(*found, strict=True)))


def _gaps_to(
    body: Spheres,
    obstacles: Obstacles,
    at: Moments,
    rates: Rates,
    frames: np.ndarray,
    middles: np.ndarray,
) -> Gaps:
    # Balls of links and balls of obstacles.
    reach = body.ball_radii[:, None] + _motion(rates.links, at)  # [L B]
    centers, radii, exists = (
        x.take(at.scene, axis=-1) for x in (obstacles.centers, obstacles.radii, obstacles.exists)
    )
    apart = sum_of_squares(middles[:, body.moving, None] - centers[:, None])  # [L M B]
    near = exists & ~(apart > (reach[body.moving, None] + radii) ** 2)
    if obstacles.allowed is not None:
        near &= ~obstacles.allowed[body.links[body.moving]].take(at.scene, axis=-1)
    link, thing, moment = np.unravel_index(np.flatnonzero(near), near.shape)
    link = body.moving[link]
    found = _Links(link, moment, thing)
    sphere, moment, thing, gap, motion = _spheres_of(
        found, obstacles.distances, body, at, rates, frames, middles
    )
    if (gap > motion).all():
        return _clear(moment, gap, motion)
    part = body.part[sphere]

    def ask(rows: np.ndarray, margin: np.ndarray) -> np.ndarray:
        found = part[rows], _pick(frames, body.part_links[part[rows]], moment[rows])
        return body.hulls.from_obstacles(
            *found, obstacles, thing[rows], at.scene[moment[rows]], margin
        )

    most = gap + body.slack[sphere]
    of_part = _pick(rates.parts, part, at.motion[moment]) * at.share[moment] + _ROUNDING
    key = (moment * len(body.part_reach) + part) * len(obstacles.exists) + thing
    return _looked_at_closely(moment, gap, motion, most, of_part, key, ask)


def _gaps_to_clouds(
    body: Spheres,
    obstacles: Obstacles,
    at: Moments,
    rates: Rates,
    frames: np.ndarray,
    middles: np.ndarray,
) -> Gaps:
    link, moment = np.indices((len(body.moving), len(at.scene))).reshape(2, -1)
    found = _Links(body.moving[link], moment, np.zeros_like(moment))

    def distances(points: np.ndarray, thing: np.ndarray, scene: np.ndarray) -> np.ndarray:
        return obstacles.cloud_distances(points, scene)  # of a scene's only cloud

    sphere, moment, _, gap, motion = _spheres_of(found, distances, body, at, rates, frames, middles)
    if (gap > motion).all():
        return _clear(moment, gap, motion)
    part = body.part[sphere]

    def ask(rows: np.ndarray, margin: np.ndarray) -> np.ndarray:
        placed = _pick(frames, body.part_links[part[rows]], moment[rows])
        scene = at.scene[moment[rows]]
        return body.hulls.from_clouds(part[rows], placed, obstacles, scene, margin)

    most = gap + body.slack[sphere]
    of_part = _pick(rates.parts, part, at.motion[moment]) * at.share[moment] + _ROUNDING
    key = moment * len(body.part_reach) + part
    return _looked_at_closely(moment, gap, motion, most, of_part, key, ask)


class _Links(NamedTuple):
    """N links, each at a moment and before a thing in its scene."""

    link: np.ndarray  # [N]
    moment: np.ndarray  # [N]
    thing: np.ndarray  # [N]


def _spheres_of(
    near: _Links,
    distances: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray],
    body: Spheres,
    at: Moments,
    rates: Rates,
    frames: np.ndarray,
    middles: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Every sphere of the links whose ball may come to touch the thing: its number, moment and
    thing, the gap between them, m, and how far it may move, m.

    Args:
        near: links to be looked at.
        distances: of points `[3, N]` to things `[N]` of scenes `[N]`, m.
        body: whose spheres they are.
        at: the moments.
        rates: of their motions.
        frames: of its links, at the moments.
        middles: of the balls around these.
    """
    link, moment, thing = near
    reach = body.ball_radii[:, None] + _motion(rates.links, at)  # [L B]
    apart = distances(_pick(middles, link, moment), thing, at.scene[moment])
    left = ~(apart > _pick(reach, link, moment))
    link, moment, thing = link[left], moment[left], thing[left]
    row, sphere = members(body.first[link], body.count[link])
    link, moment, thing = link[row], moment[row], thing[row]
    points = place(_pick(frames, link, moment), body.centers[:, sphere])
    gap = distances(points, thing, at.scene[moment]) - body.radii[sphere]
    motion = _pick(rates.spheres, sphere, at.motion[moment]) * at.share[moment] + _ROUNDING
    return sphere, moment, thing, gap, motion


def _gaps_within(
    body: Spheres, at: Moments, rates: Rates, frames: np.ndarray, middles: np.ndarray
) -> Gaps:
    a, b = body.link_pairs
    reach = (body.ball_radii[a] + body.ball_radii[b])[:, None] + _motion(rates.link_pairs, at)
    near = ~(sum_of_squares(middles[:, a] - middles[:, b]) > reach**2)  # [Q B]
    couple, moment = np.unravel_index(np.flatnonzero(near), near.shape)
    row, pair = members(body.pair_first[couple], body.pair_count[couple])
    couple, moment = couple[row], moment[row]
    first, second = body.pairs[pair].T
    between = sum_of_squares(
        place(_pick(frames, a[couple], moment), body.centers[:, first])
        - place(_pick(frames, b[couple], moment), body.centers[:, second])
    )
    gap = np.sqrt(between) - body.radii[first] - body.radii[second]
    motion = _pick(rates.pairs, pair, at.motion[moment]) * at.share[moment] + _ROUNDING
    if (gap > motion).all():
        return _clear(moment, gap, motion)
    part, other = body.part[first], body.part[second]

    def ask(rows: np.ndarray, margin: np.ndarray) -> np.ndarray:
        both = (
            (x[rows], _pick(frames, body.part_links[x[rows]], moment[rows])) for x in (part, other)
        )
        return body.hulls.from_parts(*next(both), *next(both), margin)

    number = body.part_pair[part, other]
    most = gap + body.slack[first] + body.slack[second]
    of_parts = _pick(rates.part_pairs, number, at.motion[moment]) * at.share[moment] + _ROUNDING
    key = moment * max(1, len(body.part_pair_reach)) + number
    return _looked_at_closely(moment, gap, motion, most, of_parts, key, ask)


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
    of_clouds = np.all((gap > 0).reshape(len(radii), -1), axis=0, keepdims=True)
    return np.concatenate([clear, of_clouds])


@functools.cache
def _base(body: Spheres) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centers `[3, F]`, radii `[F]` and bodies `[F]` of the spheres that no joint moves."""
    fixed = np.flatnonzero(~np.isin(body.link_of, body.moving))
    frames = link_frames(body, body.robot.home[:, None])[:, :, body.link_of[fixed], 0]
    return place(frames, body.centers[:, fixed]), body.radii[fixed], body.bodies[fixed]


def _pick(array: np.ndarray, row: np.ndarray, column: np.ndarray) -> np.ndarray:
    """Of an array `[..., L, B]` the places (row, column), `[..., N]`."""
    *rest, rows, columns = array.shape
    return array.reshape(*rest, rows * columns).take(row * columns + column, axis=-1)


def members(first: np.ndarray, count: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """For groups of consecutive numbers: of which group each member is, and its number."""
    row = np.repeat(np.arange(len(count)), count)
    return row, np.arange(len(row)) + (first - np.cumsum(count) + count)[row]


def _motion(rates: np.ndarray, at: Moments) -> np.ndarray:
    """How far things move, of rates `[X, E]`, `[X, B]`."""
    return rates.take(at.motion, axis=1) * at.share + _ROUNDING
