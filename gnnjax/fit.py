"""Shows the spheres that a planner has in place of an arm's links, and saves them as an MJCF.

    python -m gnnjax.fit arm.urdf --picture arm.png --out arm_spheres.xml

Any arm can be planned for without this: `load_robot` fits the same spheres by itself. The MJCF is
for those who want to change them by hand, or plan without the exact shapes.
"""

import dataclasses
import itertools
from pathlib import Path
from typing import Annotated

import mujoco
import numpy as np
import tyro
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from gnnjax.arguments import parse_arguments
from gnnjax.arm.covers import Rows, cover_file, save_cover
from gnnjax.arm.mjcf import add_geom, keep_inertias
from gnnjax.arm.robot import Robot
from gnnjax.arm_options import JointOptions, load_bare_arm
from gnnjax.errors import InputError, needs_extra, run_command
from gnnjax.files import atomic_write, check_apart, check_target

_ROUNDING = 1e-5  # m by which saved spheres are larger: an MJCF has six digits


@dataclasses.dataclass(frozen=True)
class FitConfig(JointOptions):
    """Show and save the spheres that enclose an arm's links."""

    robot: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="ARM")]
    """Shipped robot, or path of an MJCF (.xml) or URDF (.urdf)."""
    out: Path | None = None
    """An MJCF (.xml) of the arm with these spheres as its collision geometry."""
    keep: bool = False
    """Write the spheres beside the arm's file, where they are found at the next load."""
    picture: Path | None = None
    """Where a picture of the links and their spheres goes (needs the viz extra)."""


def fit(config: FitConfig) -> Robot:
    """Loads the arm, prints a table of its parts, and writes what is asked for."""
    if config.out is not None:
        check_target(config.out)
        if config.out.suffix != ".xml":
            raise InputError(f"out is {str(config.out)!r}; its name must end in .xml, of an MJCF")
    check_apart((config.out, config.picture), (config.robot,))
    draw_cover = None
    if config.picture is not None:
        with needs_extra("--picture", "viz"):
            from gnnjax.plot import check_picture, draw_cover
        check_picture(config.picture)
    robot = load_bare_arm(config.robot, config)
    over = 1e3 * (robot.sphere_radii - robot.sphere_inner_radii)
    table = Table(title=escape(robot.name))
    for name in ("part", "body", "spheres", "overshoot [mm]"):
        table.add_column(escape(name), overflow="fold")
    for number, part in enumerate(robot.parts):
        rows = robot.sphere_parts == number
        body = robot.bodies[part.body].name if part.body >= 0 else "world"
        table.add_row(escape(part.name), escape(body), str(rows.sum()), f"{over[rows].max():.1f}")
    table.add_row("all", "", str(len(over)), f"{over.max():.1f}", style="bold")
    Console().print(table)
    print(f"{len(robot.sphere_pairs)} pairs of spheres tell whether the arm meets itself")
    print("planned for, in the order of start and goal, rad (or m):")
    for name, *ends in zip(robot.joint_names, robot.joint_lower, robot.joint_upper, strict=True):
        print(f"  {name}: {ends[0]:.4g} to {ends[1]:.4g}")
    if draw_cover is not None and config.picture is not None:
        draw_cover(robot, config.picture)
        print(f"wrote {config.picture}")
    if config.keep:
        rows = Rows(
            robot.sphere_parts, robot.sphere_centers, robot.sphere_radii, robot.sphere_inner_radii
        )
        save_cover(cover_file(robot.path), robot.parts, rows)
        print(f"wrote {cover_file(robot.path)}")
    if config.out is not None:
        text = mjcf_of_spheres(robot)
        atomic_write(config.out, lambda file: file.write_text(text, encoding="utf-8"))
        print(f"wrote {config.out}")
    return robot


def mjcf_of_spheres(robot: Robot) -> str:
    """The MJCF of an arm that collides as its cover."""
    spec, model = robot.mj_spec.copy(), robot.mj_model
    spec.compile()  # for the ids
    keep_inertias(spec, model)
    bodies = {body.id: body for body in spec.bodies}
    geoms = {geom.id: geom for geom in spec.geoms}
    spheres: dict[str, list[str]] = {}  # in the place of geoms that have names
    for number, (part, g) in enumerate(zip(robot.parts, robot.part_geoms.tolist(), strict=True)):
        if len(part.vertices) <= 2:
            continue
        rows = np.flatnonzero(robot.sphere_parts == number)
        if name := geoms[g].name:
            spheres[name] = [f"{name}_sphere_{i}" for i in range(len(rows))]
        for i, row in enumerate(rows):
            add_geom(
                bodies[part.body + 1],
                name=spheres[name][i] if name else "",
                type=mujoco.mjtGeom.mjGEOM_SPHERE,
                pos=robot.sphere_centers[row],
                size=[robot.sphere_radii[row] + _ROUNDING, 0, 0],
                contype=int(model.geom_contype[g]),
                conaffinity=int(model.geom_conaffinity[g]),
                group=3,
                mass=0,
                rgba=[0.2, 0.6, 0.9, 0.35],
            )
        spec.delete(geoms[g])
    for pair in list(spec.pairs):
        ends = [spheres.get(name, [name]) for name in (pair.geomname1, pair.geomname2)]
        if len(ends[0]) == len(ends[1]) == 1 and ends[0][0] == pair.geomname1:
            continue
        spec.delete(pair)
        for first, second in itertools.product(*ends):
            spec.add_pair(geomname1=first, geomname2=second)
    # Meshes that nothing shows any more; others are read from where they are.
    used = {geom.meshname for geom in spec.geoms}
    for mesh in list(spec.meshes):
        if mesh.name not in used:
            spec.delete(mesh)
    folder = (robot.path.parent / spec.meshdir).resolve()
    if spec.meshes:
        spec.meshdir = str(folder)
    limits = {
        "velocity_limit": robot.velocity_limit,
        "acceleration_limit": robot.acceleration_limit,
    }
    for numeric in list(spec.numerics):  # which may have those of joints that are held
        if numeric.name in limits:
            spec.delete(numeric)
    for name, limit in limits.items():
        if limit is not None:
            spec.add_numeric(name=name, data=limit.astype(float))
    # That of the file is gone where it has joints that are held.
    middle = robot.mj_model.jnt_range.mean(axis=1).astype(np.float32)
    if not any(key.name == "home" for key in spec.keys) and (robot.home != middle).any():
        spec.add_key(name="home", qpos=robot.home.astype(float))
    spec.compile()
    return spec.to_xml()


def main() -> None:
    fit(parse_arguments(FitConfig))


if __name__ == "__main__":
    run_command(main)
