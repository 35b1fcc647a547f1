"""What the certificate knows of the arm: spheres, and bounds on how far each can move.

In NumPy and double precision, apart from the planning kernels. Arrays have their components first
and what they are computed for last (see `obstacles.py`).
"""

import functools
from typing import NamedTuple

import numpy as np

from gnnjax.arm.robot import CAPSULE, Joint, Robot, require_round_geoms
from gnnjax.collision.obstacles import Boxes, sum_of_squares
from gnnjax.errors import InputError

# m; added to every motion, for what double precision rounds off. That is less than 1e-11 m among
# numbers below 1e4 m.
_ROUNDING = 1e-9


class Rates(NamedTuple):
    """How far things can move while a fraction of a motion is done, m, for each of E motions."""

    spheres: np.ndarray  # [S E]
    pairs: np.ndarray  # [P E] of the distance between two spheres
    links: np.ndarray  # [L E] of any sphere of a link
    link_pairs: np.ndarray  # [Q E] of the distance of any two


class Moments(NamedTuple):
    """B configurations, and the motions whose middles they are."""

    q: np.ndarray  # [D B]
    scene: np.ndarray  # [B] in which scene each is
    motion: np.ndarray  # [B] of which motion it is a part
    share: np.ndarray  # [B] how much of that is done until the part's ends, at most


class Gaps(NamedTuple):
    """Whatever may touch: N pairs of a sphere and an obstacle, or of two spheres."""

    moment: np.ndarray  # [N] at which of the moments
    gap: np.ndarray  # [N] m between their surfaces; negative in collision
    motion: np.ndarray  # [N] m, that the gap may shrink by, at most


class Spheres:
    """The robot as spheres, with bounds on how far each can move."""

    def __init__(self, robot: Robot):
        require_round_geoms(robot)
        if not ((robot.geom_radii > 0) & np.isfinite(robot.geom_radii)).all():
            raise InputError(f"geoms of {robot.name} have radii that are not positive; mend them")
        self.robot = robot
        owner, bodies, centers, radii = [], [], [], []
        # Spheres of one body lie side by side: they are a link.
        for g in np.argsort(robot.geom_bodies, kind="stable"):
            radius, steps = robot.geom_radii[g], np.zeros(1)
            if robot.geom_types[g] == CAPSULE:
                length = 2 * np.linalg.norm(robot.geom_axes[g])
                count = int(np.ceil(2 * length / radius)) + 1
                steps = np.linspace(-1, 1, count)
                radius = np.hypot(radius, length / (count - 1) / 2)
            for step in steps:
                owner.append(g)
                bodies.append(int(robot.geom_bodies[g]))
                centers.append(robot.geom_centers[g] + step * robot.geom_axes[g])
                radii.append(radius)
        self.bodies, self.centers = np.array(bodies), np.array(centers).T
        self.radii = np.array(radii)
        self.reach = np.array([self._reach(b, c) for b, c in zip(bodies, centers, strict=True)])
        axes = np.zeros((robot.num_dof, 3))
        for joint in (joint for body in robot.bodies for joint in body.joints):
            axes[joint.index] = joint.axis
        # [D 3 3], whose products with vectors are those of the axes: row i is e_i x axis.
        self.crosses = np.cross(np.eye(3), axes[:, None])
        self._find_links()
        owner = np.array(owner)
        pairs = [
            (i, j)
            for a, b in robot.self_pairs
            for i in np.flatnonzero(owner == a)
            for j in np.flatnonzero(owner == b)
        ]
        self._sort_pairs(np.array(pairs, int).reshape(-1, 2))

    def _find_links(self) -> None:
        """What the spheres of a body have in common: L links, and a ball around each."""
        self.links, self.first, self.link_of, self.count = np.unique(
            self.bodies, return_index=True, return_inverse=True, return_counts=True
        )
        self.upstream = self._upstream()[self.links]  # [L D]
        self.moving = np.flatnonzero(self.upstream.any(axis=1))
        low = np.minimum.reduceat(self.centers, self.first, axis=1)
        high = np.maximum.reduceat(self.centers, self.first, axis=1)
        self.middles = (low + high) / 2
        beyond = np.sqrt(sum_of_squares(self.centers - self.middles[:, self.link_of]))
        self.ball_radii = np.maximum.reduceat(beyond + self.radii, self.first)

    def _sort_pairs(self, pairs: np.ndarray) -> None:
        """Pairs `[P, 2]` of spheres, those of the same two links side by side."""
        key = self.link_of[pairs] @ [len(self.links), 1]
        self.pairs = pairs[np.argsort(key, kind="stable")]
        key, self.pair_first, self.pair_count = np.unique(
            np.sort(key), return_index=True, return_counts=True
        )
        self.link_pairs = np.stack(np.divmod(key, len(self.links)))
        first, second = self.pairs.T
        # A joint that carries both spheres leaves their distance alone.
        shared = self.upstream[self.link_of[first]] & self.upstream[self.link_of[second]]
        self.pair_reach = np.where(shared, 0.0, self.reach[first] + self.reach[second])

    def _upstream(self) -> np.ndarray:
        """`[bodies + 1, D]`: which joints move a body; the last row is the world's."""
        upstream = np.zeros((len(self.robot.bodies) + 1, self.robot.num_dof), bool)
        for b, body in enumerate(self.robot.bodies):
            upstream[b] = upstream[body.parent]  # parent -1 is the world's row
            upstream[b, [joint.index for joint in body.joints]] = True
        return upstream

    def _reach(self, body: int, center: np.ndarray) -> np.ndarray:
        """`[D]` bounds on how far a point of a body moves a unit of each joint, m/rad or m/m.

        A point turns about a joint's axis on a circle at most as large as the sum of the links
        between them; the part along the axis does not count for the link next to it.
        """
        reach = np.zeros(self.robot.num_dof)
        offset, beyond = np.asarray(center, float), 0.0
        while body >= 0:
            link = self.robot.bodies[body]
            # Several joints of one body move each other's anchors: then nothing is left out.
            several = len(link.joints) > 1
            for joint in link.joints:
                if not joint.hinge:
                    reach[joint.index] = 1.0
                    continue
                arm = offset - joint.anchor
                radial = np.linalg.norm(arm if several else np.cross(joint.axis, arm))
                if several:
                    radial += sum(
                        2 * np.linalg.norm(other.anchor - joint.anchor)
                        + (0 if other.hinge else self._travel(other))
                        for other in link.joints
                    )
                reach[joint.index] = radial + beyond
            beyond += np.linalg.norm(offset)
            for joint in link.joints:
                turned = 2 * np.linalg.norm(joint.anchor)
                beyond += turned if joint.hinge else self._travel(joint)
            offset, body = link.position, link.parent
        return reach

    def _travel(self, joint: Joint) -> float:
        """How far a slide joint can take its body from where the MJCF places it, m."""
        model = self.robot.mj_model
        return float(np.abs(model.jnt_range[joint.index] - model.qpos0[joint.index]).max())

    def rates(self, change: np.ndarray) -> Rates:
        """Bounds for motions by up to `change` `[D, E]` of each joint."""
        spheres, pairs = (
            np.zeros((len(reach), change.shape[1])) for reach in (self.reach, self.pair_reach)
        )
        for j, by in enumerate(change):
            spheres += self.reach[:, j, None] * by
            pairs += self.pair_reach[:, j, None] * by
        links = np.maximum.reduceat(spheres, self.first, axis=0)
        return Rates(spheres, pairs, links, np.maximum.reduceat(pairs, self.pair_first, axis=0))

    def any_rates(self) -> Rates:
        """Of one motion that nothing is beyond the reach of."""
        sizes = len(self.radii), len(self.pairs), len(self.links), len(self.pair_first)
        return Rates(*(np.full((size, 1), np.inf) for size in sizes))

    def gaps(self, obstacles: list[Boxes], at: Moments, rates: Rates) -> Gaps:
        """The gaps that a motion might use up, to obstacles and of the arm to itself.

        What is left out cannot touch: a gap is at least the distance of what encloses the two,
        the ball of a link and the ball of an obstacle or the obstacle itself, and this is more
        than the motion of any of their spheres. (Written so that what is not a number stays.)
        Links that no joint moves are not compared with obstacles: no configuration changes the
        outcome, see `base_touches`.
        """
        frames = self._frames(at.q)
        middles = _place(frames, self.middles[:, :, None])  # [3 L B]
        found = [self._gaps_to(kind, at, rates, frames, middles) for kind in obstacles]
        found.append(self._gaps_within(at, rates, frames, middles))
        return Gaps(*(np.concatenate(parts) for parts in zip(*found, strict=True)))

    def _gaps_to(
        self, kind: Boxes, at: Moments, rates: Rates, frames: np.ndarray, middles: np.ndarray
    ) -> Gaps:
        reach = self.ball_radii[:, None] + _motion(rates.links, at)  # [L B]
        centers, radii, exists = (
            x.take(at.scene, axis=-1) for x in (kind.centers, kind.radii, kind.exists)
        )
        apart = sum_of_squares(middles[:, self.moving, None] - centers[:, None])  # [L M B]
        near = exists & ~(apart > (reach[self.moving, None] + radii) ** 2)
        link, thing, moment = np.unravel_index(np.flatnonzero(near), near.shape)
        link = self.moving[link]
        apart = kind.distances(_pick(middles, link, moment), thing, at.scene[moment])
        near = ~(apart > _pick(reach, link, moment))
        link, thing, moment = link[near], thing[near], moment[near]
        row, sphere = members(self.first[link], self.count[link])
        link, thing, moment = link[row], thing[row], moment[row]
        points = _place(_pick(frames, link, moment), self.centers[:, sphere])
        apart = kind.distances(points, thing, at.scene[moment])
        motion = _pick(rates.spheres, sphere, at.motion[moment]) * at.share[moment] + _ROUNDING
        return Gaps(moment, apart - self.radii[sphere], motion)

    def _gaps_within(
        self, at: Moments, rates: Rates, frames: np.ndarray, middles: np.ndarray
    ) -> Gaps:
        a, b = self.link_pairs
        reach = (self.ball_radii[a] + self.ball_radii[b])[:, None] + _motion(rates.link_pairs, at)
        near = ~(sum_of_squares(middles[:, a] - middles[:, b]) > reach**2)  # [Q B]
        couple, moment = np.unravel_index(np.flatnonzero(near), near.shape)
        row, pair = members(self.pair_first[couple], self.pair_count[couple])
        couple, moment = couple[row], moment[row]
        first, second = self.pairs[pair].T
        between = sum_of_squares(
            _place(_pick(frames, a[couple], moment), self.centers[:, first])
            - _place(_pick(frames, b[couple], moment), self.centers[:, second])
        )
        gap = np.sqrt(between) - self.radii[first] - self.radii[second]
        motion = _pick(rates.pairs, pair, at.motion[moment]) * at.share[moment] + _ROUNDING
        return Gaps(moment, gap, motion)

    def _frames(self, q: np.ndarray) -> np.ndarray:
        """The axes and the origin of every link at q `[D, B]`, `[4, 3, L, B]`."""
        # Bodies lie as the MJCF places them when a joint is at its reference (`ref`).
        value = q - self.robot.mj_model.qpos0[:, None]
        sin, cos = np.sin(value)[:, None, None], np.cos(value)[:, None, None]
        # Rodrigues, [D 3 3 B].
        cross, squared = self.crosses[..., None], (self.crosses @ self.crosses)[..., None]
        turns = np.eye(3)[..., None] + cross * sin + squared * (1 - cos)
        world = np.concatenate([np.eye(3), np.zeros((1, 3))])[..., None]
        # The world comes first here: indices are shifted by one.
        frames = [np.broadcast_to(world, (4, 3, q.shape[1]))]
        for body in self.robot.bodies:
            parent = frames[body.parent + 1]
            origin = _place(parent, body.position)
            axes = _turned(parent, body.rotation[..., None])
            for joint in body.joints:
                if not joint.hinge:
                    origin = origin + _along(axes, joint.axis) * value[joint.index]
                    continue
                turned = _turned(axes, turns[joint.index])
                if joint.anchor.any():
                    origin = origin + _along(axes, joint.anchor) - _along(turned, joint.anchor)
                axes = turned
            frames.append(np.concatenate([axes, origin[None]]))
        return np.stack([frames[link + 1] for link in self.links], axis=2)


def _along(axes: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Points `[3, ...]`, given by components `[3, ...]` along axes `[3, 3, ...]`."""
    return axes[0] * point[0] + axes[1] * point[1] + axes[2] * point[2]


def _place(frames: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Points in the world, of points in frames `[4, 3, ...]`."""
    return frames[3] + _along(frames, point)


def _turned(axes: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Axes `[3, 3, B]`, turned by rotations `[3, 3, B]` as seen along themselves."""
    return _along(axes[:, None], turn[:, :, None])


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


@functools.cache
def spheres_of(robot: Robot) -> Spheres:
    return Spheres(robot)
