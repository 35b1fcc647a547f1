"""Arms that hold something: its shapes become further parts of the arm.

What is held hangs as a body of its own on the body that holds it, without a joint. So whoever knows
the arm knows it as well: kernels, certificate, distance field, MuJoCo worlds and pictures.
"""

import dataclasses
import functools
import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gnnjax.arm.bodies import read_body
from gnnjax.arm.contacts import always_touching, exclude_bodies, pair_explicitly
from gnnjax.arm.covers import pairs_of_spheres
from gnnjax.arm.load import Load
from gnnjax.arm.mjcf import self_pairs, without_warnings
from gnnjax.arm.parts import part_of_geom
from gnnjax.arm.robot import Robot
from gnnjax.errors import InputError, brief, check_number, is_list
from gnnjax.scene.held import Item, add_body, items_from, pose_from
from gnnjax.scene.numbers import number_of
from gnnjax.scene.pose import Pose
from gnnjax.scene.scene_file import read_json, shapes_of

_LOG = logging.getLogger(__name__)


def attach(
    robot: Robot,
    body: str,
    shapes: Sequence,
    *,
    pose: Sequence | None = None,
    mass: float | None = None,
    allow: Sequence[str] = (),
) -> Robot:
    """An arm that holds something: a new `Robot`, with a name of its own; the old one is as it was.

    The same arguments give the same object, of the last 32: kernels are compiled once for each.

    What is held stays clear of all parts of the arm but those of bodies that do not move against
    the one that holds it (its hand, and fingers that are held), and those of `allow`. Fingers that
    are planned for belong into `allow`.

    Args:
        robot: the arm; it may hold other things already.
        body: name of the body that holds it.
        shapes: what is held: boxes, spheres, capsules, cylinders.
        pose: position (m) and quaternion w x y z of the frame that the shapes are given in, in the
            body's; by default that of the body.
        mass: of all of it together, kg, spread evenly; without one it weighs nothing. It is in
            `Robot.mj_model`.
        allow: names of further bodies that it may touch.

    Raises:
        InputError: an unknown body, or one that no joint moves; no shapes, or one that cannot be
            held; a pose or mass that is none; the arm cannot move without touching what it holds.
    """
    _check(robot, body, allow)
    items = tuple(
        (item.kind, *(tuple(x.tolist()) for x in (*item.pose, item.size)))
        for item in items_from(shapes, pose_from(pose), body)
    )
    if mass is not None:
        check_number(mass, "mass")
        mass = float(mass)
    return _attached(robot, Load(body, items, mass, tuple(sorted({*allow}))))


def attach_again(robot: Robot, load: Load) -> Robot:
    """`attach` of what an arm of this name held before.

    Raises:
        InputError: this one has not the bodies for it.
    """
    _check(robot, load.body, load.allow)
    return _attached(robot, load)


@functools.lru_cache(maxsize=32)
def _attached(robot: Robot, load: Load) -> Robot:
    """`attach` of what was found good."""
    body, _, mass, allow = load
    items = [
        Item(kind, Pose(np.array(position), np.array(quat)), np.array(size))
        for kind, position, quat, size in load.items
    ]
    holder = robot.mj_model.body(body).id
    held_name = load.body_name(robot.name)

    spec = robot.mj_spec.copy()
    names = add_body(spec, body, held_name, items, mass)
    with without_warnings():
        model = spec.compile()
    held = np.array([model.geom(name).id for name in names])
    held_body = model.body(held_name).id
    # Compiling keeps the order of what was there before.
    old = np.setdiff1d(np.arange(model.ngeom), held)[robot.part_geoms]
    geoms = np.concatenate([old, held])
    shifted = [part._replace(body=part.body + (part.body >= held_body - 1)) for part in robot.parts]
    new = [part_of_geom(model, g, robot.path) for g in held.tolist()]
    parts = (*shifted, *new)

    free = {int(model.body_weldid[holder + (holder >= held_body)])}
    free |= {int(model.body_weldid[model.body(name).id]) for name in allow}
    wanted = np.array(
        [
            (p, len(old) + h)
            for p, part in enumerate(shifted)
            for h in range(len(new))
            if int(model.body_weldid[part.body + 1]) not in free
        ],
        np.int64,
    ).reshape(-1, 2)
    if pair_explicitly(spec, model, geoms[wanted]):
        with without_warnings():
            model = spec.compile()
    called = f"{robot.name} with what {body} holds"
    touching = always_touching(model, geoms, wanted, None, parts, called, "name bodies in allow")
    if touching:
        link = min(touching)[0]
        named = model.body(parts[link].body + 1).name
        raise InputError(
            f"what {body} holds touches {parts[link].name} in every configuration; if it may, let "
            f"allow name {named!r}"
        )
    pairs = np.concatenate([robot.part_pairs, wanted])
    if exclude_bodies(spec, parts, self_pairs(model, geoms), pairs):
        with without_warnings():
            model = spec.compile()

    covers = [item.cover(part) for item, part in zip(items, new, strict=True)]
    sphere_parts = np.concatenate(
        [
            robot.sphere_parts,
            *(np.full(len(x.radii), len(old) + h) for h, x in enumerate(covers)),
        ]
    )
    note = f"{body} holds {', '.join(names)}" + (f", {mass:g} kg" if mass else "")
    _LOG.info("%s: %s", robot.name, note)
    return dataclasses.replace(
        robot,
        name=load.name_of(robot.name),
        mj_spec=spec,
        mj_model=model,
        bodies=tuple(read_body(model, b) for b in range(1, model.nbody)),
        parts=parts,
        part_geoms=geoms,
        part_pairs=pairs,
        sphere_parts=sphere_parts,
        sphere_bodies=np.array([parts[p].body for p in sphere_parts.tolist()]),
        sphere_centers=np.concatenate([robot.sphere_centers, *(x.centers for x in covers)]),
        sphere_radii=np.concatenate([robot.sphere_radii, *(x.radii for x in covers)]),
        sphere_inner_radii=np.concatenate([robot.sphere_inner_radii, *(x.depths for x in covers)]),
        sphere_pairs=pairs_of_spheres(sphere_parts, pairs),
        loads=(*robot.loads, load),
        notes=(*robot.notes, note),
    )


def attach_from_json(robot: Robot, path: str | Path) -> Robot:
    """`attach` as a file says: `{"body": "hand", "boxes": [{"center": ..., ...}], "mass": 0.5}`.

    Beside the body there are lists of shapes as in a scene file, in the frame of that body, and, if
    need be, `mass` (kg) and `allow` (names of bodies).

    Raises:
        InputError: the file is missing, is no JSON, or holds anything else; see `attach`.
    """
    called = f"file to attach {str(path)!r}"
    data = read_json(path, "file to attach")
    if not isinstance(data, dict) or not isinstance(data.get("body"), str):
        raise InputError(f'{called} names no body; write {{"body": "NAME", "boxes": [...]}}')
    body, mass, allow = data.pop("body"), data.pop("mass", None), data.pop("allow", [])
    mass = None if mass is None else number_of(mass, f"{called} has mass", "kg")
    if not isinstance(allow, list) or not all(isinstance(name, str) for name in allow):
        raise InputError(f"{called} has allow = {brief(allow)}; give a list of names of bodies")
    shapes = shapes_of(data, ("body", "mass", "allow"), called, repr(str(path)))
    return attach(robot, body, shapes, mass=mass, allow=allow)


def _check(robot: Robot, body: str, allow: Sequence[str]) -> None:
    """Refuses a body that cannot hold anything, and bodies to allow that are none."""
    names = [x.name for x in robot.bodies if x.name]
    if body not in names:
        raise InputError(f"no body {body!r} in {robot.name} to hold something; there are {names}")
    if not robot.mj_model.body_weldid[robot.mj_model.body(body).id]:
        raise InputError(
            f"body {body!r} of {robot.name} is moved by no joint; put what it holds into the scene"
        )
    names = ["world", *names]
    if not is_list(allow):
        raise InputError(f"allow is {brief(allow)}; give a list of names of bodies")
    if unknown := [name for name in allow if name not in names]:
        raise InputError(f"no body {unknown[0]!r} in {robot.name} to allow; there are {names}")
