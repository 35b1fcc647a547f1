"""Plans one query: `python -m gnnjax.plan --robot R --scene scene.json --start ... --goal ...`."""

import dataclasses
from pathlib import Path

import numpy as np
import tyro

from gnnjax.arguments import parse_arguments
from gnnjax.arm.turns import in_all_turns
from gnnjax.arm_options import load_arm
from gnnjax.errors import InputError, needs_extra, run_command
from gnnjax.files import atomic_write, check_apart, check_target
from gnnjax.planning.load import own_planner
from gnnjax.planning.options import PlannerOptions
from gnnjax.planning.query import unit_of
from gnnjax.query_options import QueryOptions, read_query
from gnnjax.trajectory.files import check_trajectory_file, save_trajectory
from gnnjax.trajectory.options import MotionOptions, check_motion_options
from gnnjax.trajectory.states import check_step, sample_trajectory
from gnnjax.video import check_video, draw_video

_UNTOLD = ("reason", "trajectory")  # of a plan, in the file of its path


@dataclasses.dataclass(frozen=True, kw_only=True)
class PlanConfig(QueryOptions, PlannerOptions, MotionOptions):
    """Plan one query and write its path."""

    any_turn: bool = False
    """Go to the goal in whichever turn is nearest of joints that turn by more than 2 pi."""
    out: Path = Path("path.npz")
    """Where the path goes: arrays path [L, D], cost, clearance (m, from obstacles,
    proven) and counts."""
    image: Path | None = None
    """Where a picture of the path goes (needs the viz extra)."""
    trajectory: Path | None = None
    """Where the fastest motion along the path goes: .npz (arrays), .csv (a table) or .json (as
    ROS's trajectory_msgs/JointTrajectory)."""
    video: Path | None = None
    """Where a film of that motion goes, .gif or .mp4 (needs the video extra, and OpenGL: where
    there is no display, MUJOCO_GL=egl)."""
    clearance: tyro.conf.Suppress[bool] = True  # which is printed
    dt: float = 0.01
    """Seconds between the states in the motion's file."""


def main(config: PlanConfig) -> int:
    """Plans, prints a summary and writes the files; returns 1 where there is no path."""
    # All that can be refused is refused before planning, which may take a minute.
    check_apart(
        (config.out, config.image, config.trajectory, config.video),
        (config.scene, config.request, config.attach, config.robot),
    )
    if check_target(config.out).suffix.lower() != ".npz":
        raise InputError(
            f"path file {str(config.out)!r} has the ending {config.out.suffix!r}; give .npz "
            "(arrays), or a motion's file as --trajectory, which may be .csv or .json"
        )
    robot, start, goal, scene = read_query(config, load_arm(config, config.torque))
    if config.any_turn:
        if "goal" not in goal:
            raise InputError("--any-turn is of a --goal; a pose is reached in any turn as it is")
        goal = {"goals": in_all_turns(robot, goal["goal"])}
    moves = config.trajectory is not None or config.video is not None
    if config.trajectory is not None:
        check_trajectory_file(config.trajectory)
    if config.video is not None:
        check_video(config.video)
    _check_of_motion(config, moves)
    if moves:
        check_motion_options(robot, config)
        check_step(config.dt)
    planner = own_planner(robot, config)
    draw = None
    if config.image is not None:
        with needs_extra("--image", "viz"):
            from gnnjax.plot import check_picture
            from gnnjax.plot import draw_plan as draw
        check_picture(config.image)
    print("compiling (the first run takes up to a minute, later ones seconds) and planning ...")
    wanted = config if moves else False
    plan = planner.plan(scene, start, **goal, seed=config.seed, trajectory=wanted)
    if not plan.success:
        print(plan.reason)
        return 1
    unit = unit_of(robot)
    print(
        f"path of {len(plan.path)} configurations, cost {plan.cost:.3f} {unit}, certified free; "
        f"{plan.edge_checks} edge checks, {plan.configuration_checks} configuration checks "
        f"({plan.sampling_checks} for sampling)"
    )
    clearance = planner.clearance(scene, plan)
    print(f"proven to keep {1e3 * clearance:.0f} mm from all obstacles, or more")

    def write(file: Path) -> None:
        arrays = {name: getattr(plan, name) for name in plan._fields if name not in _UNTOLD}
        arrays |= {"robot": np.array(planner.robot.name), "clearance": np.array(clearance)}
        with open(file, "wb") as stream:
            np.savez_compressed(stream, **arrays)

    atomic_write(config.out, write)
    print(f"wrote {config.out}")
    if config.image is not None and draw is not None:
        draw(planner.robot, scene, plan.path, config.image)
        print(f"wrote {config.image}")
    motion = plan.trajectory
    if motion is not None:
        if not motion.success:
            print(f"no motion: {motion.reason}")
            return 1
        print(f"motion of {motion.duration:.2f} s, certified free, {motion.stops} stops on its way")
        assert motion.clearance is not None
        print(
            f"its rounded corners take the cost from {motion.cost_before:.3f} to {motion.cost:.3f} "
            f"{unit}; proven clearance: {1e3 * clearance:.0f} mm for the path, "
            f"{1e3 * motion.clearance:.0f} mm for the curve"
        )
        if config.trajectory is not None:
            save_trajectory(planner.robot, motion, config.trajectory, config.dt)
            print(f"wrote {config.trajectory}")
        if config.video is not None:
            shown = sample_trajectory(planner.robot, motion, 0.01)
            draw_video(planner.robot, scene, shown.times, shown.positions, config.video)
            print(f"wrote {config.video}")
    return 0


def _check_of_motion(config: PlanConfig, moves: bool) -> None:
    """Refuses options of a motion where there is none."""
    if moves:
        return
    of_motion = {field.name for field in dataclasses.fields(MotionOptions)} | {"dt"}
    if config.rest_share is not None:
        of_motion -= {"torque"}  # which that is a share of
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if field.name in of_motion and not np.array_equal(value, field.default):
            raise InputError(
                f"--{field.name} is of a motion, and none is asked for; give --trajectory or "
                "--video, or leave it out"
            )


if __name__ == "__main__":
    run_command(lambda: main(parse_arguments(PlanConfig)), smaller="give a smaller --num-nodes")
