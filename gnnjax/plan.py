"""Plans one query: `python -m gnnjax.plan --robot R --scene scene.json --start ... --goal ...`."""

import dataclasses
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro

from gnnjax.arm.robot import Robot, load_robot
from gnnjax.errors import InputError, run_command
from gnnjax.files import atomic_write, check_target
from gnnjax.planning.load import own_planner
from gnnjax.planning.options import PlannerOptions
from gnnjax.pose.goal import PoseGoal, check_goal, tool_frame
from gnnjax.problems.moveit import query_from_moveit
from gnnjax.scene.any_file import read_scene
from gnnjax.scene.holding import attach_from_json
from gnnjax.scene.scene import Scene
from gnnjax.trajectory.files import check_trajectory_file, save_trajectory
from gnnjax.trajectory.options import MotionOptions, check_motion_options
from gnnjax.trajectory.trajectory import check_step, sample_trajectory
from gnnjax.video import check_video, draw_video

_UNTOLD = ("reason", "trajectory")  # of a plan, in the file of its path


@dataclasses.dataclass(frozen=True, kw_only=True)
class PlanConfig(PlannerOptions, MotionOptions):
    """Plan one query and write its path."""

    scene: Path
    """File of the obstacles: .json (lists of them), .yaml (a planning scene of MoveIt), .xml (a
    MuJoCo model, less the robot in it), .bt or .ot (an octomap)."""
    start: tuple[float, ...] | None = None
    """Joint values, rad."""
    goal: tuple[float, ...] | None = None
    """Joint values, rad."""
    goal_pose: tuple[float, float, float, float, float, float, float] | None = None
    """In place of a goal: where a frame of the arm should be, x y z (m) and a quaternion w x y z,
    in the frame of the arm's base."""
    frame: str | None = None
    """Of the goal pose: the site or body; by default the site "tool", or else the last body."""
    free: tuple[Literal["x", "y", "z", "rx", "ry", "rz"], ...] = ()
    """Of the goal pose: its own axes along which the place is free (x y z), and about which the
    turn is (rx ry rz; one of these, or all)."""
    tolerance: tuple[float, float] = (1e-4, 1e-3)
    """Of the goal pose: how far from it is near enough, m and rad."""
    request: Path | None = None
    """MoveIt's motion plan request (.yaml), in place of start and goal."""
    robot: str = "kuka_iiwa14"
    """Shipped robot, or path of an MJCF."""
    attach: Path | None = None
    """JSON file with what the arm holds: {"body": NAME, "boxes": [...]}, lists as in a scene, in
    the frame of that body; "mass" (kg) and "allow" (bodies that it may touch) if need be."""
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
    """Of the motion: seconds between the states in its file."""
    seed: int = 0
    """Seed of the roadmaps."""


def main(config: PlanConfig) -> int:
    """Plans, prints a summary and writes the files; returns 1 where there is no path."""
    # All that can be refused is refused before planning, which may take a minute.
    check_target(config.out)
    robot = load_robot(config.robot)
    if config.attach is not None:
        robot = attach_from_json(robot, config.attach)
    robot, start, goal, scene = _read(config, robot)
    moves = config.trajectory is not None or config.video is not None
    if config.trajectory is not None:
        check_trajectory_file(config.trajectory)
    if config.video is not None:
        check_video(config.video)
    if moves:
        check_motion_options(robot, config)
        check_step(config.dt)
    planner = own_planner(robot, config)
    draw = None
    if config.image is not None:
        try:
            from gnnjax.plot import check_picture
            from gnnjax.plot import draw_plan as draw
        except ImportError as error:
            raise InputError(
                f"--image needs the viz extra ({error}); pip install 'gnnjax[viz]'"
            ) from None
        check_picture(config.image)
    print("compiling (the first run takes up to a minute, later ones seconds) and planning ...")
    wanted = config if moves else False
    plan = planner.plan(scene, start, **goal, seed=config.seed, trajectory=wanted)
    if not plan.success:
        print(plan.reason)
        return 1
    print(
        f"path of {len(plan.path)} configurations, cost {plan.cost:.3f} rad, certified free; "
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
            f"rad, and what is proven to be kept from {1e3 * clearance:.0f} to "
            f"{1e3 * motion.clearance:.0f} mm"
        )
        if config.trajectory is not None:
            save_trajectory(planner.robot, motion, config.trajectory, config.dt)
            print(f"wrote {config.trajectory}")
        if config.video is not None:
            shown = sample_trajectory(planner.robot, motion, 0.01)
            draw_video(planner.robot, scene, shown.times, shown.positions, config.video)
            print(f"wrote {config.video}")
    return 0


def _read(config: PlanConfig, robot: Robot) -> tuple[Robot, np.ndarray, dict[str, Any], Scene]:
    """Start, goal and scene that files and options say; the goal as an argument of a planner's. And
    the arm, which holds what a request or scene of MoveIt has attached to it."""
    ends = [config.goal is not None, config.goal_pose is not None]
    of_pose = config.frame, config.free, config.tolerance
    if config.goal_pose is None and of_pose != (None, (), PlanConfig.tolerance):
        raise InputError("--frame, --free and --tolerance are of a --goal-pose; give one, too")
    if config.request is None:
        if config.start is None or sum(ends) != 1:
            raise InputError(
                "a query needs --start and --goal, or a --request of MoveIt's; --goal-pose may "
                "take the place of --goal"
            )
        scene, start = read_scene(config.scene, robot), np.array(config.start)
        if config.goal_pose is None:
            return robot, start, {"goal": np.array(config.goal)}, scene
        place, quat = config.goal_pose[:3], config.goal_pose[3:]
        pose = PoseGoal(place, quat, config.free, config.tolerance, config.frame)
        check_goal(pose)
        tool_frame(robot, pose.frame)
        return robot, start, {"goal_pose": pose}, scene
    if config.start is not None or any(ends):
        raise InputError("--request has a start and a goal; leave --start and --goal out")
    if config.scene.suffix.lower() not in (".yaml", ".yml"):
        raise InputError(
            f"--request needs a planning scene of MoveIt (.yaml); --scene is {str(config.scene)!r}"
        )
    robot, (start, goal, scene) = query_from_moveit(config.scene, config.request, robot)
    return robot, np.asarray(start), {"goal": goal}, scene


if __name__ == "__main__":
    run_command(lambda: main(tyro.cli(PlanConfig)))
