"""Certification: a path is collision-free at every instant, not only where it was tested.

Conservative advancement in NumPy and double precision, apart from the planning kernels, so that
both would have to be wrong for a colliding path to pass.
"""

import functools

import numpy as np

from gnnjax.robot import CAPSULE, SPHERE, Robot
from gnnjax.scene import Scene

# Pieces of a path shorter than this (configuration units) are not cut further: a path that comes
# this close to touching is refused.
_SHORTEST_PIECE = 1e-4
_PIECES_A_BATCH = 256


def certify_path(robot: Robot, scene: Scene, path: np.ndarray) -> bool:
    """Proves that a path is free of collisions, boxes and the arm itself, along its whole length.

    The path is cut into pieces. A piece is free when, at its middle, every collision geom is
    farther from everything else than any of its points can move until the piece's ends; otherwise
    the piece is halved. Capsules count as chains of spheres that enclose them.

    Args:
        robot: the arm, with spheres and capsules as collision geoms.
        scene: one scene.
        path: `[L, D]` configurations, joined by straight lines.

    Returns:
        True if proven free; False if a collision was found or the path grazes something too
        closely to tell.
    """
    return (
        all(certify_edges(robot, scene, path[:-1], path[1:]))
        if len(path) > 1
        else bool(certify_edges(robot, scene, path, path)[0])
    )


def certify_edges(robot: Robot, scene: Scene, starts: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """`certify_path` for each straight line from `starts` to `ends` `[E, D]`; returns `[E]`."""
    starts, ends = np.asarray(starts, float), np.asarray(ends, float)
    # Half an ulp of single precision: limits are stored as float32.
    slack = 1e-6
    lower, upper = robot.joint_lower - slack, robot.joint_upper + slack
    certified = np.ones(len(starts), bool)
    for q in (starts, ends):
        certified &= ((q >= lower) & (q <= upper)).all(axis=1)
    body = _spheres(robot)
    pieces = [(e, starts[e], ends[e]) for e in np.flatnonzero(certified)]
    while pieces:
        batch, pieces = pieces[:_PIECES_A_BATCH], pieces[_PIECES_A_BATCH:]
        edge = np.array([piece[0] for piece in batch])
        low, high = np.array([p[1] for p in batch]), np.array([p[2] for p in batch])
        middle, half = (low + high) / 2, np.abs(high - low) / 2
        clearance, margin = body.margins(scene, middle, half)
        too_short = np.linalg.norm(half, axis=1) * 2 < _SHORTEST_PIECE
        certified[edge[(clearance <= 0) | ((margin <= 0) & too_short)]] = False
        split = (margin <= 0) & certified[edge]
        pieces = [p for p in pieces if certified[p[0]]]
        for i in np.flatnonzero(split):
            pieces += [(edge[i], low[i], middle[i]), (edge[i], middle[i], high[i])]
    return certified


def configuration_clearance(robot: Robot, scene: Scene, q: np.ndarray) -> float:
    """Distance [m] of the arm at q `[D]` to boxes and itself; negative in collision."""
    still = np.zeros((1, robot.num_dof))
    return float(_spheres(robot).margins(scene, np.asarray(q, float)[None], still)[0][0])


class _Spheres:
    """The robot as spheres, with bounds on how far each can move."""

    def __init__(self, robot: Robot):
        self.robot = robot
        owner, bodies, centers, radii = [], [], [], []
        for g in range(len(robot.geom_radii)):
            if robot.geom_types[g] not in (SPHERE, CAPSULE):
                raise NotImplementedError("only spheres and capsules can be certified")
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
        self.bodies, self.centers = np.array(bodies), np.array(centers)
        self.radii = np.array(radii)
        self.reach = np.array([self._reach(b, c) for b, c in zip(bodies, centers, strict=True)])
        self.moves = self.reach.any(axis=1)
        owner = np.array(owner)
        pairs = [
            (i, j)
            for a, b in robot.self_pairs
            for i in np.flatnonzero(owner == a)
            for j in np.flatnonzero(owner == b)
        ]
        self.pairs = np.array(pairs, int).reshape(-1, 2)
        first, second = self.pairs.T
        # A joint that carries both spheres leaves their distance alone.
        upstream = self._upstream()
        shared = upstream[self.bodies[first]] & upstream[self.bodies[second]]
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
                        + (0 if other.hinge else np.ptp(self.robot.mj_model.jnt_range[other.index]))
                        for other in link.joints
                    )
                reach[joint.index] = radial + beyond
            beyond += np.linalg.norm(offset)
            for joint in link.joints:
                model = self.robot.mj_model
                travel = model.jnt_range[joint.index] - model.qpos0[joint.index]
                slides = not joint.hinge
                beyond += np.abs(travel).max() if slides else 2 * np.linalg.norm(joint.anchor)
            offset, body = link.position, link.parent
        return reach

    def margins(
        self, scene: Scene, q: np.ndarray, half: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Clearance `[B]` at q `[B, D]`, and what is left of it after moving by `half` `[B, D]`."""
        centers = self._world_centers(q)  # [B S 3]
        clearance = np.full(len(q), np.inf)
        margin = np.full(len(q), np.inf)
        motion = half @ self.reach.T  # [B S]
        mask = np.asarray(scene.mask)
        quats = np.asarray(scene.quats, float)[mask]
        for center, size, quat in zip(
            np.asarray(scene.centers, float)[mask],
            np.asarray(scene.half_extents, float)[mask],
            quats,
            strict=True,
        ):
            local = (centers[:, self.moves] - center) @ _rotation(quat)
            outside = np.linalg.norm(np.maximum(np.abs(local) - size, 0), axis=-1)
            gaps = outside - self.radii[self.moves]
            clearance = np.minimum(clearance, gaps.min(axis=1, initial=np.inf))
            left = gaps - motion[:, self.moves]
            margin = np.minimum(margin, left.min(axis=1, initial=np.inf))
        first, second = self.pairs.T
        apart = np.linalg.norm(centers[:, first] - centers[:, second], axis=-1)
        gaps = apart - self.radii[first] - self.radii[second]
        left = gaps - half @ self.pair_reach.T
        clearance = np.minimum(clearance, gaps.min(axis=1, initial=np.inf))
        return clearance, np.minimum(margin, left.min(axis=1, initial=np.inf))

    def _world_centers(self, q: np.ndarray) -> np.ndarray:
        rotations = [np.broadcast_to(np.eye(3), (len(q), 3, 3))]
        positions = [np.zeros((len(q), 3))]
        # Bodies lie as the MJCF places them when a joint is at its reference (`ref`).
        reference = self.robot.mj_model.qpos0
        for body in self.robot.bodies:  # the world comes first here: indices are shifted by one
            rotation, position = rotations[body.parent + 1], positions[body.parent + 1]
            position = position + rotation @ body.position
            rotation = rotation @ body.rotation
            for joint in body.joints:
                value = q[:, joint.index] - reference[joint.index]
                if not joint.hinge:
                    position = position + (rotation @ joint.axis) * value[:, None]
                    continue
                anchor = position + rotation @ joint.anchor
                rotation = rotation @ _turn(joint.axis, value)
                position = anchor - rotation @ joint.anchor
            rotations.append(rotation)
            positions.append(position)
        of_sphere = self.bodies + 1
        rotated = np.einsum("sbij,sj->bsi", np.stack(rotations)[of_sphere], self.centers)
        return rotated + np.stack(positions, axis=1)[:, of_sphere]


def _turn(axis: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Rotations `[B, 3, 3]` about a unit axis (Rodrigues)."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    sin, cos = np.sin(angle)[:, None, None], np.cos(angle)[:, None, None]
    return np.eye(3) + sin * cross + (1 - cos) * (cross @ cross)


def _rotation(quat: np.ndarray) -> np.ndarray:
    """Rotation matrix of a unit quaternion w x y z."""
    w, v = quat[0], quat[1:]
    cross = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross


@functools.cache
def _spheres(robot: Robot) -> _Spheres:
    return _Spheres(robot)
