"""Motions in files: NumPy's arrays, a table, or a message of ROS."""

import csv
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from gnnjax.arm.choice import ArmChoice, choice_from_json
from gnnjax.arm.load import Load, load_from_json
from gnnjax.arm.robot import Robot, load_robot
from gnnjax.array_files import FileKind, read_arrays
from gnnjax.errors import InputError, brief
from gnnjax.files import atomic_write, check_target
from gnnjax.scene.holding import attach_again
from gnnjax.scene.scene_file import read_json
from gnnjax.trajectory.states import Setpoints, check_setpoints, sample_trajectory
from gnnjax.trajectory.trajectory import Trajectory

_NANO = 10**9
_FOUND = ("cost_before", "cost", "clearance_before", "clearance")  # of a motion, beside its states
_AGAIN = "write it again with python -m gnnjax.plan --trajectory"
_Facts: TypeAlias = dict[str, float]


def check_trajectory_file(path: str | Path) -> Path:
    """Returns the path of a file that `save_trajectory` can write.

    Raises:
        InputError: another ending, or no file can have that path.
    """
    path = Path(path)
    _form_of(path)
    return check_target(path)


def save_trajectory(
    robot: Robot, trajectory: Trajectory, path: str | Path, dt: float = 0.01
) -> None:
    """Writes a motion, sampled every `dt` seconds, of the kind that the file's ending says.

    Arrays and messages also tell the name of the arm, its joints and contacts where these were
    chosen, all of what it held, and of costs and clearances, before and after corners were rounded;
    messages do so under a key of their own, "gnnjax", which ROS does not know. A table has room for
    neither.

    Raises:
        InputError: see `check_trajectory_file` and `sample_trajectory`.
    """
    path = check_trajectory_file(path)
    points, write = sample_trajectory(robot, trajectory, dt), _form_of(path).write
    found = {name: getattr(trajectory, name) for name in _FOUND}
    facts = {name: value for name, value in found.items() if value is not None}
    atomic_write(path, lambda file: write(robot, points, facts, file))


def load_trajectory(robot: Robot, path: str | Path) -> Setpoints:
    """Reads the states of a motion that `save_trajectory` wrote for this arm.

    Raises:
        InputError: no such file, another ending, or what is in it is no motion of this arm, with
            what it held (see `robot_of_trajectory`): a table does not tell that.
    """
    called, read = f"trajectory file {str(path)!r}", _read(Path(path))
    _check_arm(robot, read, called)
    check_setpoints(robot, read.points, called, _AGAIN)
    return read.points


def robot_of_trajectory(robot: Robot, path: str | Path) -> Robot:
    """The arm that a file's motion is of: the robot, with the joints and contacts that were chosen,
    and with what it held.

    It is the robot itself where that holds something or has joints that were chosen already, the
    file's arm had neither or was another one, or the file is a table, which does not tell.

    Raises:
        InputError: no such file, another ending, or no motion is in it; see `Robot.attach`.
    """
    read = _read(Path(path))
    chosen = None if robot.choice else read.choice
    # Torques at rest are limited joint by joint, of other joints maybe.
    unlike = chosen is not None and robot.rest_limit is not None
    if robot.loads or unlike or read.robot != _name_of(robot.name, chosen, read.loads):
        return robot
    if chosen:
        robot = load_robot(robot.path, **chosen.arguments())
    for load in read.loads:
        robot = attach_again(robot, load)
    return robot


def choice_of_trajectory(name: str, path: str | Path) -> ArmChoice | None:
    """Joints and contacts that were chosen of the arm that a file's motion is of; None where these
    are as the arm's own file has them, its name is another one, or the file does not tell.

    Raises:
        InputError: no such file, another ending, or no motion is in it.
    """
    read = _read(Path(path))
    return read.choice if read.robot == _name_of(name, read.choice, read.loads) else None


def _name_of(name: str, choice: ArmChoice | None, loads: tuple[Load, ...]) -> str:
    """How an arm is called with all this. Names have a digest of it, so that a file that was edited
    is of no known arm."""
    name = choice.name_of(name) if choice else name
    for load in loads:
        name = load.name_of(name)
    return name


def _read(path: Path) -> "_Read":
    called = f"trajectory file {str(path)!r}"
    try:
        return _form_of(path).read(path)
    except FileNotFoundError:
        raise InputError(f"no {called}; check the path") from None
    except IsADirectoryError:
        raise InputError(f"{called} is a folder; check the path") from None
    except InputError:
        raise
    except (
        AttributeError,
        ValueError,
        KeyError,
        TypeError,
        IndexError,
        OverflowError,
        RecursionError,
        csv.Error,
    ) as error:
        what = f"no entry {brief(error.args[0])}" if isinstance(error, KeyError) else str(error)
        raise InputError(f"{called} holds no motion ({what}); {_AGAIN}") from None


def _check_arm(robot: Robot, read: "_Read", called: str) -> None:
    remedy = "name the arm that it was planned for"
    known = robot.name, robot.plain_name if read.untold else robot.name
    if read.robot not in (None, *known):
        raise InputError(
            f"{called} is of {brief(read.robot)}, not of {robot.name}; {remedy}, its joints "
            "(--joints, --hold, --allow), and what it held (--attach, or --request)"
        )
    if read.joint_names != list(robot.joint_names):
        raise InputError(
            f"{called} is of an arm with the joints {brief(read.joint_names)}, not of {robot.name} "
            f"with {list(robot.joint_names)}; {remedy}"
        )


class _Read(NamedTuple):
    """What a file holds, as it is."""

    robot: str | None  # None where files of the kind do not tell
    choice: ArmChoice | None  # of its joints and contacts
    untold: bool  # of a version that did not tell that
    loads: tuple[Load, ...]  # that this arm holds
    joint_names: list[str]
    points: Setpoints


def _npz(robot: Robot, points: Setpoints, facts: _Facts, file: Path) -> None:
    with open(file, "wb") as stream:
        np.savez_compressed(
            stream,
            robot=np.array(robot.name),
            choice=np.array(json.dumps(_chosen(robot))),
            held=np.array(json.dumps(_held(robot))),
            joint_names=np.array(robot.joint_names),
            **points._asdict(),
            **{name: np.array(value) for name, value in facts.items()},
        )


def _from_npz(path: Path) -> _Read:
    arrays = read_arrays(path, FileKind("trajectory file", "a motion", _AGAIN))
    points = Setpoints(*(np.asarray(arrays[name], float) for name in Setpoints._fields))
    # Files of version 0.1 do not tell what was held.
    loads = _loads(json.loads(str(arrays["held"]))) if "held" in arrays else ()
    untold = "choice" not in arrays
    choice = None if untold else _choice(json.loads(str(arrays["choice"])))
    joints = arrays["joint_names"].tolist()
    return _Read(str(arrays["robot"]), choice, untold, loads, joints, points)


def _csv(robot: Robot, points: Setpoints, facts: _Facts, file: Path) -> None:
    kinds = points._fields[1:]
    with open(file, "w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(["time", *(f"{kind}:{j}" for kind in kinds for j in robot.joint_names)])
        writer.writerows(np.column_stack(points).tolist())


def _from_csv(path: Path) -> _Read:
    with open(path, newline="", encoding="utf-8") as stream:
        head, *rows = csv.reader(stream)
    kinds = Setpoints._fields[1:]
    joints = [name.removeprefix(f"{kinds[0]}:") for name in head[1 : 1 + len(head[1:]) // 4]]
    if head != ["time", *(f"{kind}:{j}" for kind in kinds for j in joints)]:
        raise ValueError(f"its columns are {brief(head)}")
    table = np.array(rows, float).reshape(len(rows), len(head))
    points = Setpoints(table[:, 0], *np.split(table[:, 1:], len(kinds), axis=1))
    return _Read(None, None, True, (), joints, points)


def _json(robot: Robot, points: Setpoints, facts: _Facts, file: Path) -> None:
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
        "gnnjax": {"robot": robot.name, "choice": _chosen(robot), "held": _held(robot), **facts},
    }
    file.write_text(json.dumps(message, indent=1), encoding="utf-8")


def _from_json(path: Path) -> _Read:
    message = read_json(path, "trajectory file")
    points = message["points"]
    since = [point["time_from_start"] for point in points]
    times = np.array([time["sec"] + time["nanosec"] / _NANO for time in since], float)
    kinds = ("positions", "velocities", "accelerations", "effort")
    columns = (np.array([point[kind] for point in points], float) for kind in kinds)
    own = message.get("gnnjax", {})  # not in messages of others
    # Those of version 0.1 tell neither.
    told = own.keys() & {"held"}
    named, loads = (own["robot"], _loads(own["held"])) if told else (None, ())
    choice = _choice(own.get("choice"))
    points = Setpoints(times, *columns)
    return _Read(named, choice, "choice" not in own, loads, message["joint_names"], points)


def _chosen(robot: Robot) -> dict | None:
    return robot.choice and robot.choice.as_json()


def _choice(chosen: Any) -> ArmChoice | None:
    try:
        return None if chosen is None else choice_from_json(chosen)
    except (AttributeError, KeyError, OverflowError, TypeError, ValueError):
        raise ValueError(f"what was chosen of the arm is {brief(chosen)}") from None


def _held(robot: Robot) -> list[dict]:
    return [load.as_json() for load in robot.loads]


def _loads(held: Any) -> tuple[Load, ...]:
    try:
        return tuple(load_from_json(load) for load in held)
    except (AttributeError, KeyError, OverflowError, TypeError, ValueError):
        raise ValueError(f"what the arm held is {brief(held)}") from None


class _Form(NamedTuple):
    """A kind of file."""

    write: Callable[[Robot, Setpoints, _Facts, Path], None]
    read: Callable[[Path], _Read]


def _form_of(path: Path) -> _Form:
    if path.suffix.lower() not in _FORMS:
        raise InputError(
            f"trajectory file {str(path)!r} has the ending {path.suffix!r}; give .npz (arrays), "
            ".csv (a table) or .json (as ROS's trajectory_msgs/JointTrajectory)"
        )
    return _FORMS[path.suffix.lower()]


_FORMS = {
    ".npz": _Form(_npz, _from_npz),
    ".csv": _Form(_csv, _from_csv),
    ".json": _Form(_json, _from_json),
}
