"""MuJoCo's C engine as a judge of certified motions, in worlds that the package had no part in.

Arms are read from their MJCF, and obstacles and what arms hold are put in as people describe them.
Motions are looked at every `step`, but for stretches in which no contact can be: where the engine
finds a gap at least twice as large as what the arm can move there, by a bound of this module's own.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import mujoco
import numpy as np

from gnnjax.arm.joints import joint_name
from gnnjax.arm.robot import Robot
from gnnjax.scene.shapes import Shape, for_every_kind

_REACH = 0.06  # m; gaps up to this are found
# m; below, gaps are asked for pair by pair. Those of contacts are made for the engine's forces, and
# with such a reach they were wrong by half a millimetre for capsules beside meshes, either way.
_CLOSELY = 5e-3
NEAR = 2e-3  # m; gaps up to this are told
_FIRST = 0.1  # configuration units; longer stretches are not looked at as a whole
_PARTS = 7  # that a piece is cut into at once, at most; odd
_AWAY = 1e3  # m; where obstacles wait that a scene has not
_GEOMS = mujoco.mjtGeom
# How many of a kind a world has room for, MuJoCo's geom, and its sizes.
_SLOTS = for_every_kind(
    "judge",
    box=(4, _GEOMS.mjGEOM_BOX, lambda v: v["half_extents"]),
    sphere=(3, _GEOMS.mjGEOM_SPHERE, lambda v: [v["radius"], 0, 0]),
    capsule=(3, _GEOMS.mjGEOM_CAPSULE, lambda v: [v["radius"], v["half_length"], 0]),
    cylinder=(3, _GEOMS.mjGEOM_CYLINDER, lambda v: [v["radius"], v["half_length"], 0]),
    half_space=(1, _GEOMS.mjGEOM_PLANE, None),
)
ROOM = {kind: slots for kind, (slots, *_) in _SLOTS.items()}


class Arm(NamedTuple):
    """An arm, and what the judge makes of it."""

    robot: Robot
    base: str = ""  # the body of its MJCF that obstacles are placed on; empty: the worldbody
    reach: float = 0.9  # m; obstacles are within it
    holder: str = ""  # the body that holds something
    held: tuple[Shape, ...] = ()  # in its frame


class Scan(NamedTuple):
    """What was found along a motion."""

    gap: float  # m, of the deepest or nearest contact; infinite beyond 2 mm
    between: tuple[str, str] | None  # the geoms
    num_configurations: int  # that were looked at


class Judge:
    """The world of an arm, in which obstacles come and go."""

    def __init__(self, arm: Arm, points: np.ndarray | None = None, radius: float = 0.0):
        """Args:
        arm: whose MJCF is read.
        points: `[K, 3]` m of a cloud, about its own origin; None for worlds without.
        radius: of the cloud's balls, m.
        """
        spec = mujoco.MjSpec.from_file(str(arm.robot.path))
        if arm.held:
            body = spec.body(arm.holder).add_body(name="held by the judge", mass=1, inertia=[1] * 3)
            for shape in arm.held:
                values = shape.values
                _, kind, size = _SLOTS[shape.kind]
                body.add_geom(
                    type=kind,
                    size=size(values),
                    pos=values["center"],
                    quat=values.get("quat", [1, 0, 0, 0]),
                    contype=-1,
                    conaffinity=-1,
                )
        slots = [(f"{kind} {i}", kind) for kind, num in ROOM.items() for i in range(num)]
        for name, kind in slots:
            body = spec.worldbody.add_body(name=name, mocap=True)
            size = [1, 1, 1] if kind == "half_space" else [0.1, 0.1, 0.1]
            body.add_geom(name=name, type=_SLOTS[kind][1], size=size, contype=-1, conaffinity=-1)
        self.names = [name for name, _ in slots]
        if points is not None:
            body = spec.worldbody.add_body(name="cloud", mocap=True)
            for i, point in enumerate(points):
                body.add_geom(
                    name=f"cloud {i}",
                    type=_GEOMS.mjGEOM_SPHERE,
                    pos=point,
                    size=[radius, 0, 0],
                    contype=-1,
                    conaffinity=-1,
                )
            self.names.append("cloud")
        for first, name in enumerate(self.names):
            for other in self.names[first + 1 :]:
                spec.add_exclude(bodyname1=name, bodyname2=other)
        self.model = model = spec.compile()
        model.geom_margin[:], model.body_margin[:], model.pair_margin[:] = _REACH, _REACH, _REACH
        self.data = mujoco.MjData(model)
        self.slots = {name: int(model.body(name).mocapid[0]) for name in self.names}
        held = [arm.robot.held.get(joint_name(model, j)) for j in range(model.njnt)]
        self.planned = np.array([value is None for value in held])
        self.data.qpos[~self.planned] = [value for value in held if value is not None]
        mujoco.mj_kinematics(model, self.data)
        base = model.body(arm.base).id if arm.base else 0
        self._base = self.data.xpos[base].copy(), self.data.xquat[base].copy()
        self._moves = model.body_weldid[model.geom_bodyid] > 0
        self._rates = _rates(model)[..., self.planned]

    def place(
        self, shapes: Sequence[Shape], cloud: tuple[np.ndarray, np.ndarray] | None = None
    ) -> None:
        """Puts obstacles into the world, given in the frame of the arm's base.

        Args:
            shapes: no more of a kind than there is room for.
            cloud: position and quaternion of the world's cloud.
        """
        data, used = self.data, dict.fromkeys(ROOM, 0)
        for at in self.slots.values():
            data.mocap_pos[at], data.mocap_quat[at] = [0, 0, -_AWAY * (1 + at)], [1, 0, 0, 0]
        for shape in shapes:
            values, kind = shape.values, shape.kind
            name = f"{kind} {used[kind]}"
            used[kind] += 1
            if kind == "half_space":
                quat = np.zeros(4)
                mujoco.mju_quatZ2Vec(quat, np.asarray(values["normal"], float))
                self._put(name, values["point"], quat)
                continue
            self._put(name, values["center"], values.get("quat", [1, 0, 0, 0]))
            self._resize(name, np.asarray(_SLOTS[kind][2](values), float))
        if cloud is not None:
            self._put("cloud", *cloud)

    def _put(self, name: str, position: Sequence, quat: Sequence) -> None:
        at, (origin, turn) = self.slots[name], self._base
        turned = np.asarray(quat, float) / np.linalg.norm(quat)
        mujoco.mju_mulPose(
            self.data.mocap_pos[at],
            self.data.mocap_quat[at],
            origin,
            turn,
            np.asarray(position, float),
            turned,
        )

    def _resize(self, name: str, size: np.ndarray) -> None:
        """With all that the engine's first tests go by."""
        model, geom = self.model, self.model.geom(name).id
        kind = model.geom_type[geom]
        round_ends = size[0] if kind == _GEOMS.mjGEOM_CAPSULE else 0.0
        around = {
            _GEOMS.mjGEOM_BOX: size,
            _GEOMS.mjGEOM_SPHERE: size[[0, 0, 0]],
        }.get(kind, np.array([size[0], size[0], size[1] + round_ends]))
        model.geom_size[geom] = size
        model.geom_rbound[geom] = np.linalg.norm(around)
        model.geom_aabb[geom, 3:] = around
        model.bvh_aabb[model.body_bvhadr[model.geom_bodyid[geom]], 3:] = around

    def scan(self, start: np.ndarray, end: np.ndarray, step: float) -> Scan:
        """Looks at a motion between configurations `[D]`, every `step` wherever it could matter."""
        way = end - start
        return self.scan_curve(
            lambda shares: start + shares[:, None] * way,
            np.abs(way),
            float(np.linalg.norm(way)),
            step,
        )

    def scan_curve(
        self, at: Callable[[np.ndarray], np.ndarray], most: np.ndarray, length: float, step: float
    ) -> Scan:
        """Looks at a curve likewise.

        Args:
            at: configurations `[N, D]` at shares `[N]` from 0 to 1.
            most: `[D]` how fast each joint is at most, rad or m for a share of 1.
            length: how far neighbouring shares are apart at most, configuration units for 1.
            step: configuration units.
        """
        rates = self._rates @ most  # [G G] m that the gap of two geoms may shrink by
        unseen = float(rates.max(initial=0.0)) / _REACH  # of gaps that are not told
        cuts = np.linspace(0, 1, max(1, int(np.ceil(length / _FIRST))) + 1)
        low, high = np.append(cuts[:-1], [0, 1]), np.append(cuts[1:], [0, 1])
        gap, between, count = np.inf, None, 0
        while len(low):
            row, geoms, dist = self._gaps(at((low + high) / 2))
            count += len(low)
            if len(dist) and dist.min() < min(gap, NEAR):
                gap = float(dist.min())
                between = tuple(self.model.geom(int(g)).name for g in geoms[dist.argmin()])
            # Into how many parts a piece must be cut so that no gap shrinks by more than half of
            # itself from the middle of a part to its ends; and so that they are no longer than a
            # step.
            need = (high - low) * unseen
            shrinks = (high - low)[row] * rates[geoms[:, 0], geoms[:, 1]]
            np.maximum.at(need, row, shrinks / np.maximum(dist, 1e-9))
            need = np.minimum(need, (high - low) * length / step)
            low, high = _cut(low, high, need)
        return Scan(gap, between, count)

    def _gaps(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """All gaps of up to `_REACH` at configurations `[N, D]`: in which of them, between which
        geoms `[C, 2]`, and how large they are, m."""
        model, data = self.model, self.data
        geoms, gaps = [], []
        for configuration in q:
            data.qpos[self.planned] = configuration
            mujoco.mj_kinematics(model, data)
            mujoco.mj_collision(model, data)
            contact = data.contact
            two, dist = contact.geom.copy(), contact.dist.copy()
            for i in np.flatnonzero(dist < _CLOSELY):
                if self._moves[two[i]].any():
                    dist[i] = mujoco.mj_geomDistance(model, data, *two[i].tolist(), 1.0, None)
            geoms.append(two)
            gaps.append(dist)
        row = np.repeat(np.arange(len(q)), [len(x) for x in gaps])
        between, gap = np.concatenate(geoms), np.concatenate(gaps)
        matters = self._moves[between].any(axis=1)
        return row[matters], between[matters], gap[matters]


def _cut(low: np.ndarray, high: np.ndarray, need: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cuts pieces into as many parts as they need, and returns those whose middles are not known.

    They are odd in number: the one in the middle has the middle of the piece.
    """
    parts = np.ceil(np.clip(need, 1, _PARTS)).astype(int) // 2 * 2 + 1
    row = np.repeat(np.arange(len(parts)), parts)
    number = np.arange(len(row)) - np.repeat(np.cumsum(parts) - parts, parts)
    width = ((high - low) / parts)[row]
    left = (2 * number + 1 != parts[row]) | (need > parts)[row]
    begin = low[row] + number * width
    return begin[left], (begin + width)[left]


def _rates(model: mujoco.MjModel) -> np.ndarray:
    """`[G, G, J]` how much the gap of two geoms can shrink by for each unit that a joint moves, m.

    A hinge moves a point by no more than its distance from the hinge, and that is at most the sum
    of all lengths on the way from one to the other.
    """
    size = np.zeros((model.ngeom, model.njnt))
    lengths = np.linalg.norm(model.jnt_pos, axis=1)
    slide = model.jnt_type == mujoco.mjtJoint.mjJNT_SLIDE
    # How far a joint may take the origin of its own body.
    shift = np.where(slide, np.abs(model.jnt_range).max(axis=1) + np.abs(model.qpos0), 2 * lengths)
    for geom in range(model.ngeom):
        body = int(model.geom_bodyid[geom])
        away = float(np.linalg.norm(model.geom_pos[geom]) + model.geom_rbound[geom])
        while body:
            first = int(model.body_jntadr[body])
            own = range(first, first + int(model.body_jntnum[body])) if first >= 0 else range(0)
            away += float(shift[list(own)].sum())
            for joint in own:
                size[geom, joint] = 1.0 if slide[joint] else away + lengths[joint]
            away += float(np.linalg.norm(model.body_pos[body]))
            body = int(model.body_parentid[body])
    moved = size > 0
    # What a joint moves along with both leaves their gap alone.
    return np.where(moved[:, None] != moved[None], size[:, None] + size[None], 0.0)
