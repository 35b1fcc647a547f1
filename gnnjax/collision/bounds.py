"""What the certificate knows of the arm: spheres, and bounds on how far each can move.

In NumPy and double precision, apart from the planning kernels. Arrays have their components first
and what they are computed for last (see `obstacles.py`).
"""

import functools
from typing import NamedTuple

import numpy as np

from gnnjax.arm.bodies import Joint
from gnnjax.arm.robot import Robot
from gnnjax.collision.hulls import Hulls
from gnnjax.collision.obstacles import sum_of_squares
from gnnjax.collision.reaches import AtHome, reach_between
from gnnjax.errors import InputError


class Rates(NamedTuple):
    """How far things can move while a fraction of a motion is done, m, for each of E motions."""

    spheres: np.ndarray  # [S E]
    pairs: np.ndarray  # [P E] of the distance between two spheres
    links: np.ndarray  # [L E] of any sphere of a link
    link_pairs: np.ndarray  # [Q E] of the distance of any two
    parts: np.ndarray  # [T E] of any point of a part
    part_pairs: np.ndarray  # [U E] of the distance of any two points of two parts


class Spheres:
    """The robot as spheres, with bounds on how far each can move."""

    def __init__(self, robot: Robot):
        if not ((robot.sphere_radii > 0) & np.isfinite(robot.sphere_radii)).all():
            raise InputError(f"geoms of {robot.name} have radii that are not positive; mend them")
        self.robot = robot
        # Spheres of one body lie side by side: they are a link.
        owner = np.argsort(robot.sphere_bodies, kind="stable")
        self.bodies, self.centers = robot.sphere_bodies[owner], robot.sphere_centers[owner].T
        self.radii = robot.sphere_radii[owner]
        self.reach = np.empty((len(owner), robot.num_dof))
        for body in np.unique(self.bodies).tolist():
            own = self.bodies == body
            self.reach[own] = self._reach(body, self.centers[:, own].T)
        axes, self.hinges = np.zeros((robot.num_dof, 3)), np.zeros(robot.num_dof, bool)
        for joint in (joint for body in robot.bodies for joint in body.joints):
            axes[joint.index], self.hinges[joint.index] = joint.axis, joint.hinge
        # [D 3 3], whose products with vectors are those of the axes: row i is e_i x axis.
        self.crosses = np.cross(np.eye(3), axes[:, None])
        self._find_links()
        self.part = robot.sphere_parts[owner]
        # How much farther away than a sphere its part may be: no farther than a ball in the part.
        inner = robot.sphere_inner_radii[owner]
        self.slack = np.where(inner > 0, self.radii - inner, np.inf)
        self.part_links = np.searchsorted(self.links, [part.body for part in robot.parts])
        self._reach_of_parts()
        self._sort_pairs(np.argsort(owner)[robot.sphere_pairs])

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
        self.spread = np.maximum.reduceat(beyond, self.first)  # [L] m; of centers, around middles

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
        reach = np.where(shared, 0.0, self.reach[first] + self.reach[second])
        self.pair_reach = np.minimum(reach, self._reach_between_spheres())

    @functools.cached_property
    def hulls(self) -> Hulls:
        """Of the parts; made when spheres leave something open for the first time."""
        return Hulls(self.robot)

    def _reach_of_parts(self) -> None:
        """Of any of a part's points: of the vertices, since reach is convex; balls turn about
        them."""
        robot = self.robot
        low, high = (
            np.stack([f(part.vertices, axis=0) for part in robot.parts], axis=1)
            for f in (np.min, np.max)
        )
        self.part_middles = (low + high) / 2  # [3 T] m, in the body's frame
        self.part_spread = np.array(  # [T] m, of vertices, around these
            [
                np.linalg.norm(part.vertices - middle, axis=1).max()
                for part, middle in zip(robot.parts, self.part_middles.T, strict=True)
            ]
        )
        self.part_reach = np.array(
            [self._reach(part.body, part.vertices).max(axis=0) for part in robot.parts]
        )
        first, second = robot.part_pairs.T
        upstream = self.upstream[self.part_links]
        shared = upstream[first] & upstream[second]
        both = self.part_reach[first] + self.part_reach[second]
        both = np.where(shared, 0.0, both)
        self.part_pair_reach = np.minimum(both, self._reach_between_parts())
        self.part_pair = np.full((len(robot.parts),) * 2, -1)  # which of `part_pairs` two parts are
        self.part_pair[first, second] = self.part_pair[second, first] = np.arange(len(first))

    def _reach_between_spheres(self) -> np.ndarray:
        """`[P, D]` bounds on how much each joint changes the distance of pairs of spheres; 0 of
        those that move none of both, or both alike."""
        found, home = np.zeros((len(self.pairs), self.robot.num_dof)), AtHome(self.robot)
        bodies, centers = self.bodies[self.pairs], self.centers.T
        for two in np.unique(bodies, axis=0).tolist():
            rows = np.flatnonzero((bodies == two).all(axis=1))
            ends = [
                home.placed(b, centers[x]) for b, x in zip(two, self.pairs[rows].T, strict=True)
            ]
            joints, *both = reach_between(ends, home.lines(*two))
            found[rows[:, None], joints] = np.minimum(*both)
        return found

    def _reach_between_parts(self) -> np.ndarray:
        """The same of pairs of parts, `[U, D]`."""
        robot = self.robot
        found, home = np.zeros((len(robot.part_pairs), robot.num_dof)), AtHome(robot)
        for number, pair in enumerate(robot.part_pairs.tolist()):
            first, second = parts = [robot.parts[p] for p in pair]
            ends = [home.placed(part.body, part.vertices) for part in parts]
            joints, *both = reach_between(ends, home.lines(first.body, second.body))
            found[number, joints] = np.minimum(*(reach.max(axis=0) for reach in both))
        return found

    def _upstream(self) -> np.ndarray:
        """`[bodies + 1, D]`: which joints move a body; the last row is the world's."""
        upstream = np.zeros((len(self.robot.bodies) + 1, self.robot.num_dof), bool)
        for b, body in enumerate(self.robot.bodies):
            upstream[b] = upstream[body.parent]  # parent -1 is the world's row
            upstream[b, [joint.index for joint in body.joints]] = True
        return upstream

    def _reach(self, body: int, points: np.ndarray) -> np.ndarray:
        """`[N, D]` bounds on how far points `[N, 3]` of a body move a unit of each joint, m/rad or
        m/m.

        A point turns about a joint's axis on a circle at most as large as the sum of the links
        between them; the part along the axis does not count for the link next to it.
        """
        reach = np.zeros((len(points), self.robot.num_dof))
        offset, beyond = np.asarray(points, float), np.zeros(len(points))
        while body >= 0:
            link = self.robot.bodies[body]
            # Several joints of one body move each other's anchors: then nothing is left out.
            several = len(link.joints) > 1
            for joint in link.joints:
                if not joint.hinge:
                    reach[:, joint.index] = 1.0
                    continue
                arm = offset - joint.anchor
                radial = np.linalg.norm(arm if several else np.cross(joint.axis, arm), axis=1)
                if several:
                    radial = radial + sum(
                        2 * np.linalg.norm(other.anchor - joint.anchor)
                        + (0 if other.hinge else self._travel(other))
                        for other in link.joints
                    )
                reach[:, joint.index] = radial + beyond
            beyond = beyond + np.linalg.norm(offset, axis=1)
            for joint in link.joints:
                turned = 2 * np.linalg.norm(joint.anchor)
                beyond = beyond + (turned if joint.hinge else self._travel(joint))
            offset, body = np.tile(link.position, (len(points), 1)), link.parent
        return reach

    def _travel(self, joint: Joint) -> float:
        """How far a slide joint can take its body from where the MJCF places it, m."""
        model = self.robot.mj_model
        return float(np.abs(model.jnt_range[joint.index] - model.qpos0[joint.index]).max())

    def rates(self, change: np.ndarray) -> Rates:
        """Bounds for motions by up to `change` `[D, E]` of each joint."""
        every, ends = self._every_reach
        total = np.zeros((len(every), change.shape[1]))
        for j, by in enumerate(change):
            total += every[:, j, None] * by
        spheres, pairs, parts, part_pairs = np.split(total, ends)
        links = np.maximum.reduceat(spheres, self.first, axis=0)
        link_pairs = np.maximum.reduceat(pairs, self.pair_first, axis=0)
        return Rates(spheres, pairs, links, link_pairs, parts, part_pairs)

    def bends(self, way: np.ndarray) -> Rates:
        """Bounds on second derivatives along motions by `way` `[D, E]`.

        The derivative of a point's place by two joints is a turn about the one nearer to the base
        of what the other does to the point, so no longer than this, which is at most its reach;
        and 0 where the nearer one slides. Joints are numbered from the base on.
        """
        by = np.abs(way)
        turns = by * self.hinges[:, None]
        # Of each joint, twice what those before it turn, and once what it turns itself.
        return self.rates(by * (2 * np.cumsum(turns, axis=0) - turns))

    @functools.cached_property
    def _every_reach(self) -> tuple[np.ndarray, np.ndarray]:
        """All of them, and where those of pairs, of parts and of pairs of parts begin."""
        every = self.reach, self.pair_reach, self.part_reach, self.part_pair_reach
        return np.concatenate(every), np.cumsum([len(reach) for reach in every])[:-1]

    def same_rates(self, meters: float) -> Rates:
        """Of one motion, by which anything may move as far as anything else."""
        sizes = len(self.radii), len(self.pairs), len(self.links), len(self.pair_first)
        sizes = *sizes, len(self.part_reach), len(self.part_pair_reach)
        return Rates(*(np.full((size, 1), meters) for size in sizes))


@functools.cache
def spheres_of(robot: Robot) -> Spheres:
    return Spheres(robot)


@functools.cache
def compile_certificates(robot: Robot) -> None:
    """Compiles what certificates and clearances of an arm need, which is no time of a query."""
    body = spheres_of(robot)
    if (body.slack > 0).any():  # or spheres are all that is looked at
        body.hulls.compile()
