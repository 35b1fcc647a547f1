"""Motions in files: NumPy's arrays, a table, or a message of ROS."""

import csv
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np

from gnnjax.arm.robot import Robot
from gnnjax.errors import InputError
from gnnjax.files import atomic_write, check_target
from gnnjax.trajectory.trajectory import Setpoints, Trajectory, sample_trajectory

_NANO = 10**9


def check_trajectory_file(path: str | Path) -> Path:
    """Returns the path of a file that `save_trajectory` can write.

    Raises:
        InputError: another ending, or no file can have that path.
    """
    path = Path(path)
    if path.suffix.lower() not in _WRITERS:
        raise InputError(
            f"trajectory file {str(path)!r} has the ending {path.suffix!r}; give .npz (arrays), "
            ".csv (a table) or .json (as ROS's trajectory_msgs/JointTrajectory)"
        )
    return check_target(path)


def save_trajectory(
    robot: Robot, trajectory: Trajectory, path: str | Path, dt: float = 0.01
) -> None:
    """Writes a motion, sampled every `dt` seconds, of the kind that the file's ending says.

    Raises:
        InputError: see `check_trajectory_file` and `sample_trajectory`.
    """
    path = check_trajectory_file(path)
    points, write = sample_trajectory(robot, trajectory, dt), _WRITERS[path.suffix.lower()]
    atomic_write(path, lambda file: write(robot, points, file))


def _npz(robot: Robot, points: Setpoints, file: Path) -> None:
    with open(file, "wb") as stream:
        np.savez_compressed(
            stream,
            robot=np.array(robot.name),
            joint_names=np.array(robot.joint_names),
            **points._asdict(),
        )


def _csv(robot: Robot, points: Setpoints, file: Path) -> None:
    kinds = points._fields[1:]
    with open(file, "w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(["time", *(f"{kind}:{j}" for kind in kinds for j in robot.joint_names)])
        writer.writerows(np.column_stack(points).tolist())


def _json(robot: Robot, points: Setpoints, file: Path) -> None:
    rows = zip(*(x.tolist() for x in points), strict=True)
    message = {
        "header": {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": ""},
        "joint_names": list(robot.joint_names),
        "points": [
            {
                "positions": positions,
                "velocities": velocities,
                "accelerations": accelerations,
                "effort": torques,
                "time_from_start": dict(
                    zip(("sec", "nanosec"), divmod(round(time * _NANO), _NANO), strict=True)
                ),
            }
            for time, positions, velocities, accelerations, torques in rows
        ],
    }
    file.write_text(json.dumps(message, indent=1), encoding="utf-8")


_WRITERS: dict[str, Callable[[Robot, Setpoints, Path], None]] = {
    ".npz": _npz,
    ".csv": _csv,
    ".json": _json,
}
