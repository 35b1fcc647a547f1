"""A viewer in the browser: `python -m gnnjax.view --robot R --scene scene.json`."""

import contextlib
import dataclasses
import os
import socket
import threading
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from gnnjax.arguments import parse_arguments
from gnnjax.arm.robot import Robot
from gnnjax.arm_options import load_arm
from gnnjax.errors import InputError, brief, needs_extra, run_command
from gnnjax.planning.load import own_planner
from gnnjax.planning.options import PlannerOptions
from gnnjax.pose.goal import PoseGoal
from gnnjax.query_options import QueryOptions, of_pose, read_query
from gnnjax.scene.shapes import IDENTITY_QUAT
from gnnjax.trajectory.options import MotionOptions
from gnnjax.viewer.answers import Query, make_reach


@dataclasses.dataclass(frozen=True, kw_only=True)
class ViewConfig(QueryOptions, PlannerOptions, MotionOptions):
    """Edit a query in the browser, and see it planned anew after each change."""

    scene: Path | None = None
    """File of the obstacles, as for planning; none to begin with by default. Start and goal are the
    arm's home by default."""
    frame: str | None = None
    """Site or body that is dragged, and that should be at the goal pose; by default the site
    "tool", or else the last body."""
    free: tuple[Literal["x", "y", "z", "rx", "ry", "rz"], ...] = ()
    """Axes of the dragged hand and of the goal pose along which the position is free (x y z), and
    about which the rotation is free (rx ry rz; one of these, or all)."""
    port: int = 8080
    """Where the page is served."""
    host: str = "127.0.0.1"
    """Address that the page is served at; 0.0.0.0 opens it to whoever reaches this machine."""


def main(config: ViewConfig) -> None:
    """Serves the page until it is interrupted."""
    print("reading arm and scene; the page is there in some seconds ...", flush=True)
    with contextlib.closing(open_page(config)) as page:
        shown = "localhost" if config.host in ("127.0.0.1", "0.0.0.0") else config.host
        print(f"open http://{shown}:{page.port} in a browser; Ctrl-C ends this", flush=True)
        threading.Event().wait()


def open_page(config: ViewConfig):
    """Serves the page, from threads; `close` ends that.

    Raises:
        InputError: the view extra is missing, the port is taken, or a query that cannot be shown.
    """
    with needs_extra("gnnjax.view", "view"):
        from gnnjax.viewer.page import Page
    _check_port(config.host, config.port)
    robot, query, pose = _read(config)
    return Page(own_planner(robot, config), query, pose, config)


def _read(config: ViewConfig) -> tuple[Robot, Query, PoseGoal]:
    """The arm, the query, and a pose of the hand whose frame, free axes and tolerance count."""
    robot, start, goal, scene = read_query(config, load_arm(config, config.torque), edited=True)
    pose = PoseGoal((0, 0, 0), IDENTITY_QUAT, *of_pose(config))
    start = _shown("start", robot, start)
    if "goal_pose" in goal:
        wanted = goal["goal_pose"]
        reach = make_reach(robot, pose, config.margin)
        goal = {"goal": reach(scene, start, np.array(wanted.position), np.array(wanted.quat))}
    return robot, Query(scene, start, _shown("goal", robot, goal["goal"])), pose


def _shown(name: str, robot: Robot, q: ArrayLike) -> np.ndarray:
    """A start or goal that can be drawn; whether it can be planned for, the page says."""
    array = np.asarray(q, np.float32)
    if array.shape != (robot.num_dof,) or not np.isfinite(array).all():
        raise InputError(
            f"{name} is {brief(np.ravel(q).tolist())}; {robot.name} needs {robot.num_dof} joint "
            "values"
        )
    return array


def _check_port(host: str, port: int) -> None:
    """Refuses a port that cannot be served, where viser would take another one."""
    if not 0 <= port < 65536:
        raise InputError(f"port is {port}; choose 1024 to 65535, or 0 for any that is free")
    try:
        socket.create_server((host, port)).close()
    except OSError as error:
        # Python adds to what the system says; of names that are no hosts it says all.
        why = os.strerror(error.errno) if (error.errno or 0) > 0 else error.strerror
        raise InputError(
            f"port {port} of {host!r} cannot be served ({why}); choose another --port, or 0 for "
            "any that is free"
        ) from None


if __name__ == "__main__":
    run_command(lambda: main(parse_arguments(ViewConfig)))
