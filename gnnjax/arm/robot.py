"""Robots: joint limits, kinematic constants and collision geometry, read from MJCF or URDF.

Everything here is NumPy, computed once when a robot is loaded. The arrays of `Robot` are constants
from which `kinematics.py` and `collision/fused.py` generate their kernels.

What an arm collides as are its parts, which are convex (`parts.py`). The first and fastest tests
are of spheres around them (`covers.py`): where those are clear, so are the parts.

Scenes are given in the frame of the arm's base, wherever the file puts that in its world. So the
file is read with its world moved to the base (`mjcf.py`), and from there on, in every kernel, in
MuJoCo's own models and in pictures, "the world" is the base.
"""

import dataclasses
import functools
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from gnnjax.arm.bodies import Body, read_body
from gnnjax.arm.choice import ArmChoice
from gnnjax.arm.contacts import always_touching, bearings, exclude_bodies, without_bodies
from gnnjax.arm.covers import cover_file, cover_parts, pairs_of_spheres
from gnnjax.arm.joints import joint_name
from gnnjax.arm.load import Load, held_names, names_with
from gnnjax.arm.mjcf import check_joints, collision_geoms, self_pairs, without_warnings
from gnnjax.arm.parts import Part, part_of_geom
from gnnjax.arm.reading import ONE_TURN, Reading, read_arm
from gnnjax.arm.shipped import assets_dir, find_model, in_kind
from gnnjax.arm.sources import Written, written
from gnnjax.errors import InputError, brief, is_list, is_pair_of_names

_HINGE = int(mujoco.mjtJoint.mjJNT_HINGE)
_LOG = logging.getLogger(__name__)


@dataclasses.dataclass(frozen=True, eq=False)
class Robot:
    """A robot arm. Configurations `q` are `[D]`, rad (hinge) or m (slide)."""

    name: str
    path: Path
    mj_spec: mujoco.MjSpec  # of `mj_model`; copy it before adding to it
    mj_model: mujoco.MjModel  # the arm alone, without obstacles
    bodies: tuple[Body, ...]  # parents before children
    joint_names: tuple[str, ...]  # D of those that are planned for
    held: dict[str, float]  # the other joints of the file, and where they are held, rad or m
    choice: ArmChoice | None  # joints and contacts, where they are not as the file alone has them
    joint_lower: np.ndarray  # [D] rad or m
    joint_upper: np.ndarray  # [D] rad or m
    velocity_limit: np.ndarray | None  # [D] rad/s or m/s; None where the file does not name all
    acceleration_limit: np.ndarray | None  # [D] rad/s^2 or m/s^2
    torque_limit: np.ndarray | None  # [D] N m or N
    rest_limit: np.ndarray | None  # [D] N m or N, that may hold the arm at rest; None: any may
    home: np.ndarray  # [D] the keyframe "home", or the middle of the joint ranges
    parts: tuple[Part, ...]  # P, the collision geometry
    part_geoms: np.ndarray  # [P] geom of `mj_model` that each part is
    part_pairs: np.ndarray  # [Q 2] indices of parts that must stay clear of each other
    allowed_pairs: tuple[tuple[str, str], ...]  # names of parts that always touch, and may
    # The cover: spheres that enclose the parts.
    sphere_parts: np.ndarray  # [G] index into `parts`
    sphere_bodies: np.ndarray  # [G] index into `bodies`, -1 of what is fixed to the world
    sphere_centers: np.ndarray  # [G 3] m, in the body's frame
    sphere_radii: np.ndarray  # [G] m
    # [G] m, of what lies inside the part; not above 0: the centre is outside of it
    sphere_inner_radii: np.ndarray
    sphere_pairs: np.ndarray  # [S 2] of spheres that must stay clear of each other
    loads: tuple[Load, ...]  # what it holds, in the order of `attach`
    notes: tuple[str, ...]  # what was decided where the file leaves it open

    def __getstate__(self) -> dict[str, Any]:
        """What another process gets: all but the spec, which only MuJoCo's worlds need."""
        return {name: value for name, value in vars(self).items() if name != "mj_spec"}

    def __repr__(self) -> str:
        """What it is, in a line: its arrays would fill pages of a notebook."""
        return (
            f"Robot({self.name!r}, joints {', '.join(self.joint_names)}, {len(self.parts)} parts, "
            f"{len(self.sphere_radii)} spheres)"
        )

    @property
    def sphere_geoms(self) -> np.ndarray:
        """`[G]` geom of `mj_model` that each sphere covers."""
        return self.part_geoms[self.sphere_parts]

    @property
    def plain_name(self) -> str:
        """How it is called in files that do not tell joints and contacts that were chosen."""
        return names_with(self.path.stem, self.loads)[-1]

    @functools.cached_property
    def held_bodies(self) -> tuple[int, ...]:
        """Indices of the bodies that are what it holds, in the order of `attach`."""
        bare = self.path.stem if self.choice is None else self.choice.name_of(self.path.stem)
        names = [body.name for body in self.bodies]
        return tuple(names.index(name) for name in held_names(bare, self.loads))

    @property
    def num_dof(self) -> int:
        return len(self.joint_lower)

    @property
    def joint_range(self) -> np.ndarray:
        return self.joint_upper - self.joint_lower

    @functools.cached_property
    def turns_more_than_once(self) -> np.ndarray:
        """`[D]` which joints are hinges that turn by more than 2 pi."""
        hinge = self.mj_model.jnt_type == _HINGE
        return hinge & (self.joint_range > ONE_TURN)

    @functools.cached_property
    def drawn_lower(self) -> np.ndarray:
        """`[D]` rad or m, from where configurations are drawn: the joint limits, but one turn alone
        of joints that turn more than once, the one nearest to -pi to pi.

        All that the arm can do is in there, and the others would thin out what is drawn.
        """
        first = np.clip(-np.pi, self.joint_lower, self.joint_upper - 2 * np.pi)
        return np.where(self.turns_more_than_once, first, self.joint_lower).astype(np.float32)

    @functools.cached_property
    def drawn_upper(self) -> np.ndarray:
        """`[D]` rad or m, up to where; see `drawn_lower`."""
        last = np.minimum(self.drawn_lower + 2 * np.pi, self.joint_upper)
        return np.where(self.turns_more_than_once, last, self.joint_upper).astype(np.float32)

    def attach(self, body: str, shapes: Sequence, **how: Any) -> "Robot":
        """A new arm whose body of that name holds shapes, by `pose`, `mass`, `allow`: see
        `gnnjax.scene.holding.attach`."""
        # Shapes are those of scenes, which come after arms.
        from gnnjax.scene.holding import attach

        return attach(self, body, shapes, **how)

    def at_rest_within(self, share: float, **how: Any) -> "Robot":
        """A new arm that is planned for only where a share of its motors' torques holds it, by
        `torque`: see `gnnjax.arm.torques.at_rest_within`."""
        from gnnjax.arm.torques import at_rest_within

        return at_rest_within(self, share, **how)


def load_robot(
    robot: str | Path,
    *,
    joints: Sequence[str] | None = None,
    hold: Mapping | None = None,
    allow: Sequence | None = None,
) -> Robot:
    """Loads a shipped robot by name, or any arm from the path of its MJCF (.xml) or URDF (.urdf).

    What the file leaves open is decided, logged and kept in `Robot.notes`. An MJCF may hold
    `<custom><numeric name="velocity_limit" data="..."/></custom>`, likewise `acceleration_limit`,
    and a keyframe called `home`; a URDF's limits `acceleration` or `drake:acceleration`. The same
    arguments give the same object, until that file changes, or one that it includes or has a mesh
    from.

    Args:
        robot: name or path.
        joints: names of the joints to plan for, in the order of the file; by default all that are
            neither in `hold` nor coupled to others (fingers).
        hold: values, in rad or m, of joints that do not move; others that are not planned for are
            held at home, or at zero.
        allow: pairs of bodies that may touch, besides those that the file excludes.

    Raises:
        InputError: unknown name, a broken file, or one that lacks what planning needs.
    """
    if joints is not None and not _are_names(joints):
        raise InputError(f"joints is {brief(joints)}; give a list of names")
    held = hold or {}
    if (
        not isinstance(held, Mapping)
        or not _are_names(list(held))
        or not all(_is_number(x) for x in held.values())
    ):
        raise InputError(f'hold is {brief(hold)}; give numbers by names, such as {{"finger": 0.0}}')
    pairs: tuple = tuple(allow or ()) if allow is None or is_list(allow) else (allow,)
    if not all(is_pair_of_names(pair) for pair in pairs):
        raise InputError(
            f'allow is {brief(allow)}; give pairs of names of bodies, such as [("hand", "link_4")]'
        )
    path = Path(robot)
    return _load(
        path.absolute() if path.is_file() else path,  # whoever adds to the arm reads it again
        written(path) if path.suffix else (),
        None if joints is None else tuple(joints),
        tuple(sorted((name, float(value)) for name, value in held.items())),
        tuple((a, b) for a, b in pairs),
    )


def _is_number(value: object) -> bool:
    # Integers may be greater than any float.
    return isinstance(value, float | np.number) or (isinstance(value, int) and abs(value) < 1e300)


def _are_names(values: object) -> bool:
    return is_list(values) and all(isinstance(value, str) for value in values)


@functools.cache
def _load(
    path: Path,
    when: Written,  # a file that was edited is read anew
    joints: tuple[str, ...] | None,
    hold: tuple[tuple[str, float], ...],
    allow: tuple[tuple[str, str], ...],
) -> Robot:
    path = find_model(path)
    try:
        with without_warnings():
            reading = read_arm(path, joints, dict(hold))
            model = reading.spec.compile()
            robot = _robot_of(reading, model, path, allow)
    except InputError:
        raise
    except ValueError as error:
        raise InputError(f"MuJoCo cannot read {str(path)!r}: {str(error).strip()}") from None
    # Of shipped arms it is known.
    level = logging.INFO if path.parent == assets_dir() else logging.WARNING
    for note in robot.notes:
        _LOG.log(level, "%s: %s", robot.name, note)
    return robot


def _robot_of(
    reading: Reading, model: mujoco.MjModel, path: Path, allow: tuple[tuple[str, str], ...]
) -> Robot:
    check_joints(model, path)
    # All bodies, which makes parents simple: body b is bodies[b - 1], as 0 is MuJoCo's world.
    bodies = tuple(read_body(model, b) for b in range(1, model.nbody))

    geom_ids = collision_geoms(model)
    if not len(geom_ids):
        how = in_kind(path, mjcf='geoms contype="1" conaffinity="1"', urdf="links <collision>")
        raise InputError(f"{str(path)!r} has no collision geometry; give the robot's {how}")
    parts = tuple(part_of_geom(model, g, path) for g in geom_ids.tolist())

    lower, upper = (model.jnt_range[:, side].astype(np.float32) for side in (0, 1))
    home = model.jnt_range.mean(axis=1) if reading.home is None else reading.home
    home = home.astype(np.float32)
    outside = ~((home >= lower) & (home <= upper))  # NaN is outside, too
    if outside.any():
        j = int(outside.argmax())
        raise InputError(
            f"keyframe home of {str(path)!r} has {home[j]} for joint {joint_name(model, j)}; it "
            f"must lie between {lower[j]} and {upper[j]}"
        )

    tested = self_pairs(model, geom_ids)
    names = [body.name for body in bodies]
    pairs, may = without_bodies(tested, parts, names, allow, path)
    remedy = in_kind(path, mjcf=", or exclude them in the MJCF (<contact><exclude .../>)", urdf="")
    touching = always_touching(model, geom_ids, pairs, reading.home, parts, repr(path.name), remedy)
    free = touching | bearings(model, geom_ids, pairs, parts)
    pairs = np.array([two for two in pairs.tolist() if tuple(two) not in free], np.int64)
    pairs = pairs.reshape(-1, 2)
    if exclude_bodies(reading.spec, parts, tested, pairs):
        model = reading.spec.compile()
    allowed = tuple((parts[a].name, parts[b].name) for a, b in sorted(touching))
    notes = reading.notes
    if allowed:
        named = ", ".join(f"{a} and {b}" for a, b in allowed)
        notes = *notes, f"parts that always touch, or do at home, may: {named}"

    rows = cover_parts(parts, cover_file(path))
    planned = tuple(joint_name(model, j) for j in range(model.njnt))
    by_itself = reading.by_itself and not may
    choice = None if by_itself else ArmChoice(planned, reading.fixed, may)
    return Robot(
        name=path.stem if choice is None else choice.name_of(path.stem),
        path=path,
        mj_spec=reading.spec,
        mj_model=model,
        bodies=bodies,
        joint_names=planned,
        held=reading.held,
        choice=choice,
        joint_lower=lower,
        joint_upper=upper,
        velocity_limit=reading.velocity_limit,
        acceleration_limit=reading.acceleration_limit,
        torque_limit=reading.torque_limit,
        rest_limit=None,
        home=home,
        parts=parts,
        part_geoms=geom_ids,
        part_pairs=pairs,
        allowed_pairs=allowed,
        sphere_parts=rows.parts,
        sphere_bodies=np.array([parts[p].body for p in rows.parts.tolist()]),
        sphere_centers=rows.centers,
        sphere_radii=rows.radii,
        sphere_inner_radii=rows.inner_radii,
        sphere_pairs=pairs_of_spheres(rows.parts, pairs),
        loads=(),
        notes=notes,
    )
