"""Carries a motion out in simulation: `python -m gnnjax.execute --scene S --trajectory M`."""

import dataclasses
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from gnnjax.arguments import parse_arguments
from gnnjax.arm.robot import Robot, load_robot
from gnnjax.arm_options import ArmOptions, load_bare_arm
from gnnjax.errors import needs_extra, run_command
from gnnjax.files import check_apart
from gnnjax.problems.moveit import surroundings_from_moveit
from gnnjax.query_options import SceneOptions, read_request
from gnnjax.scene.any_file import is_moveit, read_scene
from gnnjax.scene.holding import attach_from_json
from gnnjax.trajectory.execution import (
    Execution,
    execute_trajectory,
    motion_clearance,
)
from gnnjax.trajectory.files import choice_of_trajectory, load_trajectory, robot_of_trajectory
from gnnjax.trajectory.simulate import ModelErrors
from gnnjax.trajectory.steps import at_steps
from gnnjax.video import check_video, draw_video


@dataclasses.dataclass(frozen=True, kw_only=True)
class ExecuteConfig(SceneOptions, ArmOptions):
    """Carry a motion out in MuJoCo, with contacts, by a controller that knows the arm's model."""

    trajectory: Path
    """The motion: a file of python -m gnnjax.plan --trajectory (.npz, .csv or .json). It also tells
    what the arm held, and --joints, --hold and --allow; a .csv does not."""
    request: Path | None = None
    """MoveIt's motion plan request (.yaml) that was planned. The base then stands where the request
    has it, and the arm holds what request or scene has attached."""
    attach: Path | None = None
    """JSON file with what the arm holds, as for planning, if the motion does not tell. The
    controller knows its mass."""
    controller: str = "computed_torque"
    """computed_torque (the model's torques for the motion, and a spring and damper for errors), or
    position (servos with velocity damping, and the model's weight)."""
    torque: tuple[float, ...] | None = None
    """Limits of motors, one for all joints or one each, N m; the model's by default."""
    mass_error: float = 0.0
    """Share by which the arm is heavier than its model."""
    friction: float = 0.0
    """Dry friction of each joint, unknown to the model, N m."""
    delay: float = 0.0
    """Seconds from a measurement to the torque that answers it."""
    payload: float = 0.0
    """Mass that the last link carries, unknown to the controller, kg."""
    most_error: float = 0.5
    """Error of a joint beyond which the motion has diverged, rad."""
    figure: Path | None = None
    """Where a picture of joint values, velocities, torques and errors goes (needs the viz
    extra)."""
    video: Path | None = None
    """Where a film of the executed motion goes, .gif or .mp4 (needs the video extra, and OpenGL:
    where there is no display, MUJOCO_GL=egl)."""


def main(config: ExecuteConfig) -> int:
    """Simulates, prints what became of the motion and writes the files; returns 1 where something
    was touched, or the arm does not arrive."""
    check_apart(
        (config.figure, config.video),
        (config.scene, config.trajectory, config.request, config.attach, config.robot),
    )
    robot = _read_arm(config)
    if config.attach is not None:
        robot = attach_from_json(robot, config.attach)
    scene = None
    if config.request is not None:
        robot, (_, _, scene) = read_request(config.scene, config.request, robot)
    elif is_moveit(config.scene):
        robot, scene = surroundings_from_moveit(config.scene, robot)
    given = robot
    robot = robot_of_trajectory(given, config.trajectory)
    for note in robot.notes[len(given.notes) :]:
        print(f"as {config.trajectory} says, {note}")
    points = load_trajectory(robot, config.trajectory)
    if scene is None:
        scene = read_scene(config.scene, robot)
    draw = None
    if config.figure is not None:
        with needs_extra("--figure", "viz"):
            from gnnjax.plot import check_picture
            from gnnjax.plot_execution import draw_execution as draw
        check_picture(config.figure)
    if config.video is not None:
        check_video(config.video)
    errors = ModelErrors(config.mass_error, config.friction, config.delay, config.payload)
    print("compiling and simulating, which takes some seconds ...")
    found = execute_trajectory(
        robot,
        scene,
        points,
        controller=config.controller,
        torque=config.torque,
        errors=errors,
        most_error=config.most_error,
    )
    _tell(robot, found)
    # All of the curve, where the arm may not have come.
    clearance = motion_clearance(robot, scene, at_steps(robot, points).positions)
    print(
        f"no point of the arm is more than {_mm(found.stray)} from the curve, which is proven to "
        f"keep {_mm(clearance)} from all obstacles, or more"
    )
    print("carried out: nothing was touched" if found.success else f"failed: {found.reason}")
    if config.figure is not None and draw is not None:
        draw(robot, found, config.figure)
        print(f"wrote {config.figure}")
    if config.video is not None:
        draw_video(robot, scene, found.trace.times, found.trace.positions, config.video)
        print(f"wrote {config.video}")
    return 0 if found.success else 1


def _read_arm(config: ExecuteConfig) -> Robot:
    """The arm, of which the options choose, or else the file of the motion says what was chosen."""
    choice = None
    if config.joints is None and not config.hold and not config.allow:
        choice = choice_of_trajectory(Path(config.robot).stem, config.trajectory)
    if choice is None:
        return load_bare_arm(config.robot, config)
    print(f"as {config.trajectory} says, {choice}")
    return load_robot(config.robot, **choice.arguments())


def _tell(robot: Robot, found: Execution) -> None:
    """Prints a summary."""
    uses = np.abs(found.trace.torques / found.trace.torque_limit).max(axis=0)
    units = escape("[rad or m]")
    table = Table(
        *("joint", f"largest error\n{units}", f"rms error\n{units}", "largest torque\n% of limit")
    )
    for row in zip(robot.joint_names, found.max_error, found.rms_error, uses, strict=True):
        name, most, rms, use = row
        table.add_row(escape(name), f"{most:.5f}", f"{rms:.5f}", f"{100 * use:.1f}")
    Console().print(table)
    print(f"motion of {found.duration:.2f} s; the last link is off by up to {_mm(found.tip_error)}")


def _mm(length: float) -> str:
    return f"{1e3 * length:.1f} mm"


if __name__ == "__main__":
    run_command(lambda: main(parse_arguments(ExecuteConfig)))
