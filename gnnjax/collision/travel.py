"""How far the arm travels around the middles of motions, at most, in NumPy and double precision.

Two bounds hold, and the lesser counts. By reach: nothing travels farther than if each joint swung
it on the largest circle that there is, in whatever configuration. By speed: a straight motion in
joint space takes a point from x(0), at the middle, no farther than t |x'(0)| + t^2/2 max |x''|
(Taylor). The speed is that of the very configuration, where joints mostly undo a part of each
other's work, and the second derivative is bounded by reach (`Spheres.bends`). What strays from its
line travels that much farther.

Arrays have their components first and what they are computed for last, see `obstacles.py`.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from gnnjax.collision.bounds import Rates, Spheres
from gnnjax.collision.link_frames import joint_frames, link_twists, of_links, pick, place
from gnnjax.collision.obstacles import cross, sum_of_squares

# m; added to every motion, for what double precision rounds off. That is less than 1e-11 m among
# numbers below 1e4 m.
_ROUNDING = 1e-9


class Lines(NamedTuple):
    """E straight motions in joint space."""

    way: np.ndarray  # [D E] what each joint moves in all of it
    rates: Rates  # how far things travel in all of it
    bends: Rates  # the second derivatives, by the share of it that is done


class Motions(NamedTuple):
    """E motions of the arm."""

    lines: Lines | None  # along which they go; None: they stay where they are
    strays: Rates | None  # how far things may be from where these have them; None: they are there


class Moments(NamedTuple):
    """B configurations, and the motions whose middles they are."""

    q: np.ndarray  # [D B]
    scene: np.ndarray  # [B] in which scene each is
    motion: np.ndarray  # [B] of which motion it is a part
    share: np.ndarray  # [B] how much of that is done until the part's ends, at most


def straight_motions(body: Spheres, way: np.ndarray, slack: np.ndarray | None) -> Motions:
    """Motions along `way` `[D, E]`, of which each joint may stray by a slack `[D, E]`."""
    lines = Lines(way, body.rates(np.abs(way)), body.bends(way))
    return Motions(lines, None if slack is None else body.rates(slack))


class Travel:
    """Where links are at B moments, and how far what belongs to them may travel, m."""

    def __init__(self, body: Spheres, at: Moments, motions: Motions):
        self.body, self.at = body, at
        self._lines, self._strays = motions
        joints = joint_frames(body, at.q)
        self.frames = of_links(body, joints)  # [4 3 L B]
        self.middles = place(self.frames, body.middles[:, :, None])  # [3 L B] of links' balls
        speed = None
        if self._lines is not None:
            self._twists = link_twists(body, joints, self._lines.way.take(at.motion, axis=1))
            speed = _speed(self._twists, self.middles, body.spread[:, None])
        most = self._at_most(lambda x: x.links.take(at.motion, axis=1), at.share, speed)
        self.reach = body.ball_radii[:, None] + most  # [L B] from the middles, of any sphere

    def placed(self, part: np.ndarray, moment: np.ndarray) -> np.ndarray:
        """Frames `[4, 3, N]` of the links of parts `[N]` at moments `[N]`."""
        return pick(self.frames, self.body.part_links[part], moment)

    def link_pairs(self) -> np.ndarray:
        """The most that the distance of any spheres of two links changes, `[Q, B]`."""
        motion = self.at.motion
        return self._at_most(lambda x: x.link_pairs.take(motion, axis=1), self.at.share)

    def spheres(self, sphere: np.ndarray, moment: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Of spheres `[N]` at moments `[N]`; their centers `[3, N]` are there."""
        speed = None
        if self._lines is not None:
            speed = _speed(pick(self._twists, self.body.link_of[sphere], moment), points)
        motion = self.at.motion[moment]
        return self._at_most(
            lambda x: pick(x.spheres, sphere, motion), self.at.share[moment], speed
        )

    def pairs(self, pair: np.ndarray, moment: np.ndarray) -> np.ndarray:
        """Of the distance of two spheres."""
        motion = self.at.motion[moment]
        return self._at_most(lambda x: pick(x.pairs, pair, motion), self.at.share[moment])

    def parts(self, part: np.ndarray, moment: np.ndarray) -> np.ndarray:
        """Of any point of parts `[N]` at moments `[N]`."""
        speed = None
        if self._lines is not None:
            body = self.body
            middles = place(self.placed(part, moment), body.part_middles[:, part])
            twists = pick(self._twists, body.part_links[part], moment)
            speed = _speed(twists, middles, body.part_spread[part])
        motion = self.at.motion[moment]
        return self._at_most(lambda x: pick(x.parts, part, motion), self.at.share[moment], speed)

    def part_pairs(self, number: np.ndarray, moment: np.ndarray) -> np.ndarray:
        """Of the distance of any two points of two parts."""
        motion = self.at.motion[moment]
        return self._at_most(lambda x: pick(x.part_pairs, number, motion), self.at.share[moment])

    def _at_most(
        self,
        bound: Callable[[Rates], np.ndarray],
        share: np.ndarray,
        speed: np.ndarray | None = None,
    ) -> np.ndarray:
        """How far the things of a bound travel, which have a speed at the middle, if known."""
        total = np.array(_ROUNDING)
        if self._lines is not None:
            most = bound(self._lines.rates)
            if speed is not None:
                most = np.minimum(most, speed + share / 2 * bound(self._lines.bends))
            total = share * most + _ROUNDING
        return total if self._strays is None else total + bound(self._strays)


def _speed(twists: np.ndarray, points: np.ndarray, around: np.ndarray | None = None) -> np.ndarray:
    """How fast points `[3, ...]` are, or any within a distance around them, by the twists
    `[2, 3, ...]` of their links."""
    turning, moving = twists
    speed = np.sqrt(sum_of_squares(cross(turning, points) + moving))
    return speed if around is None else speed + np.sqrt(sum_of_squares(turning)) * around
