"""Motions in files."""

import csv
import dataclasses
import json

import numpy as np
import pytest

from gnnjax.arm.robot import load_robot
from gnnjax.errors import InputError
from gnnjax.plan import PlanConfig
from gnnjax.plan import main as plan_once
from gnnjax.scene.holding import _attached
from gnnjax.scene.scene import make_scene
from gnnjax.scene.shapes import box, capsule, cylinder, sphere
from gnnjax.trajectory.files import load_trajectory, robot_of_trajectory, save_trajectory
from gnnjax.trajectory.states import sample_trajectory
from gnnjax.trajectory.trajectory import time_path


@pytest.fixture(scope="module")
def motion(tiny_path):
    robot, path = load_robot(tiny_path), [[0, 0, 0], [1, 0.5, 0], [1.5, 0, 0.4]]
    return robot, time_path(robot, make_scene([], []), path, velocity=1.0, acceleration=2.0)


def test_all_kinds_of_files_hold_the_motion(motion, tmp_path):
    robot, trajectory = motion
    points = sample_trajectory(robot, trajectory, 0.02)
    for kind in ("npz", "csv", "json"):
        save_trajectory(robot, trajectory, tmp_path / f"motion.{kind}", dt=0.02)

    with np.load(tmp_path / "motion.npz") as arrays:
        assert arrays["joint_names"].tolist() == ["a", "b", "c"]
        for name, values in points._asdict().items():
            np.testing.assert_array_equal(arrays[name], values)

    with open(tmp_path / "motion.csv", newline="") as stream:
        head, *rows = csv.reader(stream)
    assert head[:4] == ["time", "positions:a", "positions:b", "positions:c"]
    np.testing.assert_array_equal(np.array(rows, float), np.column_stack(points))

    message = json.loads((tmp_path / "motion.json").read_text())
    assert message["joint_names"] == ["a", "b", "c"]
    assert len(message["points"]) == len(points.times)
    last = message["points"][-1]
    assert last["positions"] == points.positions[-1].tolist()
    assert last["effort"] == points.torques[-1].tolist()
    time = last["time_from_start"]
    assert time["sec"] + 1e-9 * time["nanosec"] == pytest.approx(trajectory.duration, abs=1e-9)
    assert all(isinstance(p["time_from_start"]["nanosec"], int) for p in message["points"])


@pytest.mark.parametrize("name", ["motion.txt", "motion", "motion.npz.gz"])
def test_other_endings_are_refused(motion, tmp_path, name):
    with pytest.raises(InputError, match=r"has the ending .*; give \.npz \(arrays\), \.csv"):
        save_trajectory(*motion, tmp_path / name)
    assert not list(tmp_path.iterdir())


KINDS = ("npz", "csv", "json")


@pytest.mark.parametrize("kind", KINDS)
def test_motions_are_read_as_they_were_written(motion, tmp_path, kind):
    robot, trajectory = motion
    save_trajectory(robot, trajectory, tmp_path / f"motion.{kind}", dt=0.02)
    found, written = (
        load_trajectory(robot, tmp_path / f"motion.{kind}"),
        sample_trajectory(robot, trajectory, 0.02),
    )
    np.testing.assert_allclose(found.times, written.times, atol=1e-9)
    for name in written._fields[1:]:
        np.testing.assert_array_equal(getattr(found, name), getattr(written, name))


@pytest.mark.parametrize("kind", KINDS)
def test_motions_of_other_arms_are_refused(motion, tmp_path, kind):
    save_trajectory(*motion, tmp_path / f"motion.{kind}", dt=0.05)
    with pytest.raises(InputError, match=r"is of .*, not of kuka_iiwa14.*; name the arm"):
        load_trajectory(load_robot("kuka_iiwa14"), tmp_path / f"motion.{kind}")
    with pytest.raises(InputError, match="no trajectory file"):
        load_trajectory(motion[0], tmp_path / f"missing.{kind}")


@pytest.mark.parametrize("kind", ["npz", "json"])
def test_files_tell_what_the_arm_held_and_are_read_for_no_other(motion, tmp_path, kind):
    robot, trajectory = motion
    body, file = robot.bodies[-1].name, tmp_path / f"motion.{kind}"
    light, heavy = (
        robot.attach(
            body, [sphere([0.2, 0, 0], 0.03)], mass=mass, allow=[x.name for x in robot.bodies]
        )
        for mass in (0.25, 0.5)
    )
    save_trajectory(heavy, trajectory, file, dt=0.05)
    assert len(load_trajectory(heavy, file).times) > 2
    for other in (robot, light):
        with pytest.raises(InputError, match=r"tiny_holding_.*; name .*, and what it held .--atta"):
            load_trajectory(other, file)
    assert robot_of_trajectory(robot, file) is heavy
    for other in (light, load_robot("kuka_iiwa14")):  # refused, as above
        assert robot_of_trajectory(other, file) is other


@pytest.mark.parametrize("kind", KINDS)
def test_what_an_arm_holds_by_two_bodies_is_held_again_bit_by_bit(motion, tmp_path, kind):
    robot, trajectory = motion
    file, free = tmp_path / f"motion.{kind}", [x.name for x in robot.bodies]
    turn = ([0.1, 0.2, 0.3], [0.3, 0.1, 0.7, 0.2])
    things = [box([1 / 3, 0, 0], [0.1, 0.02, 1 / 30], turn[1]), capsule([0, 0, 0.1], 0.01, 0.02)]
    both = robot.attach(free[-1], things, pose=turn, mass=1 / 7, allow=free)
    both = both.attach(free[-2], [cylinder([0.1, 0.1, 0], 0.02, 0.1)], allow=free)
    save_trajectory(both, trajectory, file, dt=0.05)
    _attached.cache_clear()  # as another process would
    again = robot_of_trajectory(robot, file)
    if kind == "csv":
        assert again is robot
        return
    assert (again.name, again.loads, again is both) == (both.name, both.loads, False)
    for mine, theirs in zip(again.parts, both.parts, strict=True):
        np.testing.assert_array_equal(mine.vertices, theirs.vertices)
    np.testing.assert_array_equal(again.mj_model.body_mass, both.mj_model.body_mass)
    np.testing.assert_array_equal(again.part_pairs, both.part_pairs)
    assert len(load_trajectory(again, file).times) > 2
    if kind == "json":
        changed(lambda x: x["gnnjax"]["held"][0].update(mass=0.1))(file)
    else:  # as version 0.1 wrote it
        with np.load(file) as arrays:
            kept = {name: arrays[name] for name in arrays.files if name != "held"}
        np.savez(file, **kept)
    assert robot_of_trajectory(robot, file) is robot
    with pytest.raises(InputError, match=r"is of 'tiny_holding_.*, not of tiny; name the arm"):
        load_trajectory(robot, file)
    assert len(load_trajectory(both, file).times) > 2


def changed(change):
    """Writes a JSON file of which something was changed."""

    def write(file):
        message = json.loads(file.read_text())
        change(message)
        file.write_text(json.dumps(message))

    return write


BROKEN = [
    ("npz", lambda file: file.write_bytes(file.read_bytes()[:200]), "cannot be read as a motion"),
    ("npz", lambda file: np.savez(file, robot="tiny"), "holds no motion .no entry 'times'.; write"),
    ("csv", lambda file: file.write_text(""), "holds no motion"),
    ("csv", lambda file: file.write_text("time,x\n0,1\n"), "its columns are"),
    ("csv", lambda file: file.write_text(file.read_text() + "1,2\n"), "holds no motion"),
    (
        "csv",
        lambda file: file.write_text(file.read_text().split("\n")[0]),
        "has arrays of the shape",
    ),
    ("csv", lambda file: file.write_text(file.read_text().replace("\n0.02,", "\nnan,")), "finite"),
    ("json", lambda file: file.write_text("{"), "is no JSON"),
    ("json", lambda file: file.write_text("[1]"), "holds no motion"),
    ("json", changed(lambda x: x.update(gnnjax=[])), "holds no motion"),
    ("json", changed(lambda x: x["points"][3].pop("effort")), "no entry 'effort'"),
    ("json", changed(lambda x: x["points"].reverse()), "do not begin at 0 and ascend"),
    ("json", changed(lambda x: x["points"][1].update(effort=[1.0])), "holds no motion"),
    ("json", changed(lambda x: x["points"][1].update(positions=[0, 9, 0])), "joint b at 9, beyond"),
    ("json", changed(lambda x: x.update(joint_names=["a", "b"])), "of an arm with the joints"),
    ("json", changed(lambda x: x["gnnjax"].pop("robot")), "no entry 'robot'"),
    ("json", changed(lambda x: x["gnnjax"].update(held=["a ball"])), "the arm held is .'a ball'."),
    (
        "json",
        changed(lambda x: x["points"][1].update(effort=[10**400] * 3)),
        "too large to convert",
    ),
    ("json", changed(lambda x: x["gnnjax"].update(held=3)), "what the arm held is 3.; write"),
]


@pytest.mark.parametrize(("kind", "spoil", "message"), BROKEN)
def test_files_that_hold_no_motion_are_refused(motion, tmp_path, kind, spoil, message):
    file = tmp_path / f"motion.{kind}"
    save_trajectory(*motion, file, dt=0.02)
    spoil(file)
    with pytest.raises(InputError, match=message):
        load_trajectory(motion[0], file)


@pytest.mark.parametrize("name", ["motion.txt", "folder.csv"])
def test_what_is_no_trajectory_file_is_refused(motion, tmp_path, name):
    (tmp_path / name).mkdir()
    with pytest.raises(InputError, match=r"has the ending '.txt'|is a folder; check the path"):
        load_trajectory(motion[0], tmp_path / name)


def config_of(tiny_path, tmp_path, **changes):
    scene = tmp_path / "scene.json"
    scene.write_text(json.dumps({"boxes": [{"center": [0.6, 0, 0], "half_extents": [0.1] * 3}]}))
    return PlanConfig(
        robot=str(tiny_path),
        scene=scene,
        start=(-1.5, 0.0, 0.0),
        goal=(1.5, 0.0, 0.0),
        out=tmp_path / "path.npz",
        planner="lazysp",
        num_nodes=60,
        max_roadmaps=2,
        **changes,
    )


LIMITS = {"velocity": (1.0,), "acceleration": (2.0, 3.0, 4.0)}


def test_the_command_writes_a_motion_from_start_to_goal(tiny_path, tmp_path, capsys):
    config = config_of(tiny_path, tmp_path, trajectory=tmp_path / "motion.json", **LIMITS)
    assert plan_once(config) == 0
    points = json.loads(config.trajectory.read_text())["points"]
    ends = [points[0]["positions"], points[-1]["positions"]]
    np.testing.assert_allclose(ends, [config.start, config.goal], atol=1e-9)
    found = json.loads(config.trajectory.read_text())["gnnjax"]
    names = {"cost_before", "cost", "clearance_before", "clearance"}
    assert set(found) == {"robot", "choice", "held", *names}
    assert found["cost"] < found["cost_before"]
    assert 0 < found["clearance"] <= 0.25
    told = capsys.readouterr().out
    assert "motion of " in told
    costs = " to ".join(f"{found[name]:.3f}" for name in ("cost_before", "cost"))
    path, curve = (f"{1e3 * found[name]:.0f} mm" for name in ("clearance_before", "clearance"))
    assert f"the cost from {costs} rad; proven clearance: {path} for the path, {curve} for" in told


def test_the_command_says_why_there_is_no_motion(tiny_path, tmp_path, capsys):
    weak = {"trajectory": tmp_path / "motion.csv", "torque": (50.0, 1.0, 50.0), **LIMITS}
    assert plan_once(config_of(tiny_path, tmp_path, **weak)) == 1
    assert "no motion: joint b needs" in capsys.readouterr().out
    assert not (tmp_path / "motion.csv").exists()
    assert (tmp_path / "path.npz").exists()


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({**LIMITS, "trajectory": "motion.txt"}, "has the ending '.txt'; give .npz"),
        ({"velocity": (1.0,), "trajectory": "motion.npz"}, "tiny has no acceleration limits"),
        ({**LIMITS, "video": "motion.avi"}, "has the ending '.avi'; give .gif or .mp4"),
        ({**LIMITS, "trajectory": "motion.npz", "dt": 0.0}, "dt is 0.0; give a step"),
        ({**LIMITS, "trajectory": "motion.npz", "jerk": (-1.0,)}, "jerk limits of tiny are"),
        ({**LIMITS, "trajectory": "motion.npz", "blend": -1.0}, "blend is -1.0; give a length"),
        ({"velocity": (1.0,)}, "^--velocity is of a motion, and none is asked for; give --traj"),
        ({"dt": 0.02}, "--dt is of a motion"),
        ({"torque": (9.0,)}, "--torque is of a motion"),
    ],
)
def test_the_command_refuses_before_it_plans(tiny_path, tmp_path, given, message):
    given = {k: tmp_path / v if k in ("trajectory", "video") else v for k, v in given.items()}
    with pytest.raises(InputError, match=message):
        plan_once(config_of(tiny_path, tmp_path, **given))
    assert [file.name for file in tmp_path.iterdir()] == ["scene.json"]


def test_torques_that_hold_the_arm_at_rest_need_no_motion(tiny_path, tmp_path):
    given = {"torque": (500.0,), "rest_share": 0.5, "num_nodes": 1}
    with pytest.raises(InputError, match="num_nodes is 1"):  # which is looked at later
        plan_once(dataclasses.replace(config_of(tiny_path, tmp_path), **given))
