"""What the certificate knows: obstacles and the arm, and bounds on how far the arm can move.

In NumPy and double precision, apart from the planning kernels, and checked by itself, whatever was
checked before.
"""

import functools

import numpy as np

from gnnjax.arm.robot import CAPSULE, Joint, Robot, require_round_geoms
from gnnjax.errors import InputError
from gnnjax.scene.scene import Scene
from gnnjax.scene.shapes import for_every_kind

_MOST_METERS = 1e4  # of a box; what lies beyond is no scene of an arm
_QUAT_ERROR = 1e-4  # how far from 1 a quaternion's length may be


class Boxes:
    """The existing boxes of a scene, in double precision."""

    def __init__(self, scene: Scene):
        mask = np.asarray(scene.mask)
        centers, half_extents, quats = (np.asarray(x, float) for x in scene[:3])
        # Numbers instead of a mask would choose rows.
        if mask.dtype != bool or mask.ndim != 1:
            raise InputError(f"the mask of the scene is {mask.dtype} {mask.shape}; give bool [M]")
        for name, array, width in (
            ("centers", centers, 3),
            ("half_extents", half_extents, 3),
            ("quats", quats, 4),
        ):
            if array.shape != (len(mask), width):
                raise InputError(
                    f"{name} of the scene have shape {array.shape}; give [{len(mask)}, {width}]"
                )
        self.centers, self.half_extents, quats = centers[mask], half_extents[mask], quats[mask]
        # Written so that NaN fails.
        size = self.half_extents
        _refuse_unless(np.abs(self.centers) <= _MOST_METERS, "centers", self.centers, "finite")
        _refuse_unless((size > 0) & (size <= _MOST_METERS), "half_extents", size, "positive")
        with np.errstate(over="ignore"):
            norms = np.linalg.norm(quats, axis=1, keepdims=True)
        _refuse_unless(np.abs(norms - 1) <= _QUAT_ERROR, "quats", quats, "of length 1")
        self.rotations = np.array([_rotation(q) for q in quats / norms])

    def distances(self, points: np.ndarray) -> np.ndarray:
        """Distances [m] of points `[B, S, 3]` to the nearest box, `[B, S]`; 0 inside."""
        nearest = np.full(points.shape[:2], np.inf)
        for center, size, rotation in zip(
            self.centers, self.half_extents, self.rotations, strict=True
        ):
            outside = np.maximum(np.abs((points - center) @ rotation) - size, 0)
            nearest = np.minimum(nearest, np.einsum("bsi,bsi->bs", outside, outside))
        return np.sqrt(nearest)


# Of its own code, and checked by itself: see `shapes.py`.
_KINDS = for_every_kind("certificate", box=Boxes)


def obstacles_of(scene: Scene) -> list[Boxes]:
    """The existing obstacles of a scene, by kind, or what is wrong with them."""
    return [kind(scene) for kind in _KINDS.values()]


def _refuse_unless(good: np.ndarray, name: str, values: np.ndarray, rule: str) -> None:
    bad = ~good.all(axis=1)
    if bad.any():
        raise InputError(
            f"existing box {int(bad.argmax())} of the scene has {name} "
            f"{values[bad.argmax()].tolist()}, which must be {rule} (m, below {_MOST_METERS:g}); "
            "make scenes with make_scene"
        )


class Spheres:
    """The robot as spheres, with bounds on how far each can move."""

    def __init__(self, robot: Robot):
        require_round_geoms(robot)
        if not ((robot.geom_radii > 0) & np.isfinite(robot.geom_radii)).all():
            raise InputError(f"geoms of {robot.name} have radii that are not positive; mend them")
        self.robot = robot
        owner, bodies, centers, radii = [], [], [], []
        for g in range(len(robot.geom_radii)):
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

    def clearance_and_need(
        self, obstacles: list["Boxes"], q: np.ndarray, half: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """What keeps the arm free at q `[B, D]` and while it moves by up to `half` `[B, D]`.

        Returns:
            Clearance `[B]`, m; and the largest share of a gap `[B]` that the motion can use up:
            below 1 nothing is touched.
        """
        centers = self._world_centers(q)  # [B S 3]
        clearance, need = np.full(len(q), np.inf), np.zeros(len(q))

        def account(gaps: np.ndarray, motion: np.ndarray) -> None:
            nonlocal clearance, need
            clearance = np.minimum(clearance, gaps.min(axis=1, initial=np.inf))
            share = motion / np.maximum(gaps, 1e-12)
            need = np.maximum(need, share.max(axis=1, initial=0.0))

        motion = half @ self.reach[self.moves].T
        moving, radii = centers[:, self.moves], self.radii[self.moves]
        nearest = np.full(motion.shape, np.inf)
        for kind in obstacles:
            nearest = np.minimum(nearest, kind.distances(moving))
        account(nearest - radii, motion)
        first, second = self.pairs.T
        between = centers[:, first] - centers[:, second]
        apart = np.sqrt(np.einsum("bpi,bpi->bp", between, between))
        account(apart - self.radii[first] - self.radii[second], half @ self.pair_reach.T)
        return clearance, need

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
def spheres_of(robot: Robot) -> Spheres:
    return Spheres(robot)
