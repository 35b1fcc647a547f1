"""Joints and contacts that are chosen of an arm's file: its name, files and commands tell them."""

import json
import logging

import numpy as np
import pytest

from gnnjax.arguments import parse_arguments
from gnnjax.arm.choice import choice_from_json
from gnnjax.arm.robot import load_robot
from gnnjax.arm_options import ArmOptions, HoldingOptions, load_arm, load_bare_arm
from gnnjax.errors import InputError
from gnnjax.evaluate import EvaluateConfig, evaluate
from gnnjax.execute import ExecuteConfig, main
from gnnjax.problems.file import save_problems
from gnnjax.problems.problem import Problem, ProblemSet
from gnnjax.problems.shards import load_problems
from gnnjax.scene.batches import stack_scenes
from gnnjax.scene.scene import make_scene
from gnnjax.scene.shapes import box
from gnnjax.train_motion import TrainMotionConfig, train_motion
from gnnjax.trajectory.files import load_trajectory, robot_of_trajectory, save_trajectory
from gnnjax.trajectory.trajectory import time_path

HELD = {"hold": {"c": 0.2}}


def problems_for(robot):
    ends = np.zeros((2, robot.num_dof), np.float32), np.ones((2, robot.num_dof), np.float32)
    return ProblemSet(robot.name, Problem(*ends, stack_scenes([make_scene([], [])] * 2)))


def test_names_tell_what_was_chosen_and_nothing_that_the_file_has_by_itself(tiny, tiny_path):
    choices = [
        HELD,
        {"hold": {"c": 0.3}},
        {"hold": {"b": 0.2}},
        {"joints": ["a"]},
        {"allow": [("upper", "lower")]},
        {**HELD, "allow": [("upper", "lower")]},
    ]
    robots = [load_robot(tiny_path, **choice) for choice in choices]
    names = [robot.name for robot in (tiny, *robots)]
    assert len(set(names)) == len(names)
    assert all(name.startswith("tiny_chosen_") for name in names[1:])
    assert {robot.plain_name for robot in robots} == {"tiny"}
    # The same arms, called otherwise: `c` is at 0 where it is not planned for.
    assert (
        load_robot(tiny_path, joints=["a", "b", "c"], allow=[("middle", "middle")]).name == "tiny"
    )
    other = {"joints": ["a"], "hold": {"c": 0.0, "b": 0.0}}
    assert load_robot(tiny_path, **other).name == names[4]
    turned = {**HELD, "allow": [("lower", "upper")]}
    assert load_robot(tiny_path, **turned).name == names[6]
    things = [box([0, 0, 0.1], [0.01] * 3)]
    held = [robot.attach("middle", things, allow=["upper", "lower"]) for robot in (tiny, robots[0])]
    assert held[0].name != held[1].name
    assert held[1].plain_name == held[0].name


@pytest.mark.parametrize("choice", [HELD, {"joints": ["b"], "allow": [("upper", "lower")]}])
def test_what_was_chosen_makes_the_same_arm_again(tiny_path, choice):
    robot = load_robot(tiny_path, **choice)
    kept = choice_from_json(json.loads(json.dumps(robot.choice.as_json())))
    assert kept == robot.choice
    again = load_robot(tiny_path, **kept.arguments())
    assert (again.name, again.joint_names, again.held) == (
        *(robot.name, robot.joint_names, robot.held),
    )
    np.testing.assert_array_equal(again.part_pairs, robot.part_pairs)
    np.testing.assert_array_equal(again.mj_model.body_quat, robot.mj_model.body_quat)


def test_problems_of_an_arm_that_is_held_otherwise_are_refused(tiny_path, tmp_path, caplog):
    plain, held, other = (
        load_robot(tiny_path, joints=["a", "b"], hold={"c": x}) for x in (0.0, 0.2, 0.3)
    )
    save_problems(tmp_path / "held.npz", problems_for(held))
    assert load_problems(tmp_path / "held.npz", held).robot == held.name
    for robot in (other, plain, load_robot(tiny_path)):
        with pytest.raises(InputError, match=r"is for robot 'tiny_chosen_.*--joints, --hold and"):
            load_problems(tmp_path / "held.npz", robot)
    config = EvaluateConfig(
        problems=tmp_path / "held.npz",
        json=tmp_path / "results.json",
        robot=str(tiny_path),
        hold=(("c", 0.3),),
    )
    with pytest.raises(InputError, match=rf"not '{other.name}'; name that robot with its --joints"):
        evaluate(config)
    # A file that names the arm alone is of no other one; files of others do not tell.
    save_problems(tmp_path / "plain.npz", ProblemSet("tiny", problems_for(held).problems))
    with pytest.raises(InputError, match="is for robot 'tiny', not 'tiny_chosen_"):
        load_problems(tmp_path / "plain.npz", held)
    with np.load(tmp_path / "plain.npz") as arrays:
        kept = {name: arrays[name] for name in arrays.files if name != "format"}
    np.savez(tmp_path / "foreign.npz", **kept)
    with caplog.at_level(logging.WARNING):
        assert load_problems(tmp_path / "foreign.npz", held).robot == held.name
    assert "does not tell where joints were held; taken for tiny_chosen_" in caplog.text


@pytest.fixture(scope="module")
def motion(tiny_path):
    robot = load_robot(tiny_path, **HELD)
    free = make_scene([], [])
    return robot, time_path(robot, free, [[-1, 0], [1, 0.2]], velocity=1.5, acceleration=5.0)


@pytest.mark.parametrize("kind", ["npz", "json", "csv"])
def test_a_motions_file_tells_the_arm_that_was_chosen(motion, tiny, tiny_path, tmp_path, kind):
    robot, trajectory = motion
    things = [box([0.1, 0, 0.1], [0.02] * 3)]
    for name, arm in (("bare", robot), ("holding", robot.attach("lower", things))):
        file = tmp_path / f"{name}.{kind}"
        save_trajectory(arm, trajectory, file)
        again = robot_of_trajectory(tiny, file)
        if kind == "csv":
            assert again is tiny
            continue
        assert (again.name, again.loads) == (arm.name, arm.loads)
        assert len(load_trajectory(again, file).times) > 2
        other = load_robot(tiny_path, hold={"c": 0.3})
        assert robot_of_trajectory(other, file) is other
        with pytest.raises(InputError, match=r"its joints .--joints, --hold, --allow., and what"):
            load_trajectory(other, file)
    if kind == "json":  # an arm of no known name
        file.write_text(file.read_text().replace('"c": 0.2', '"c": 0.1'))
        assert robot_of_trajectory(tiny, file) is tiny
        file.write_text(file.read_text().replace('"c": 0.1', '"c": NaN'))
        with pytest.raises(InputError, match=r"holds no motion \(what was chosen of the arm is"):
            robot_of_trajectory(tiny, file)


@pytest.mark.parametrize("hold", [(), (("c", 0.2),), (("c", 0.3),)])
def test_execute_has_the_arm_as_it_was_chosen(motion, tiny_path, tmp_path, capsys, hold):
    save_trajectory(*motion, tmp_path / "motion.npz")
    (tmp_path / "scene.json").write_text('{"boxes": []}')
    config = ExecuteConfig(
        robot=str(tiny_path),
        scene=tmp_path / "scene.json",
        trajectory=tmp_path / "motion.npz",
        torque=(40.0,),
        hold=hold,
    )
    if hold == (("c", 0.3),):
        with pytest.raises(InputError, match=r"is of 'tiny_chosen_.*, not of tiny_chosen_"):
            main(config)
        return
    assert main(config) == 0
    told = "says, planned for: a, b; held: c at 0.2" in capsys.readouterr().out
    assert told == (hold == ())


def test_commands_take_what_load_robot_takes(tiny_path):
    words = "--joints a --hold b -0.5 c 0.25 --allow upper lower world lower".split()
    options = parse_arguments(HoldingOptions, args=["--robot", str(tiny_path), *words], prog="do")
    robot = load_arm(options)
    assert robot.joint_names == ("a",)
    assert robot.held == {"b": -0.5, "c": 0.25}
    # Upper and lower do not move against each other, and are no pair.
    assert robot.choice.allow == (("lower", "world"),)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"joints": ("upper",)}, r"no joint 'upper' in '.*'; there are \['a', 'b', 'c'\]"),
        ({"hold": (("C", 0.1),)}, r"no joint 'C' in"),
        ({"hold": (("c", np.nan),)}, "joint 'c' is to be held at nan; give a finite number"),
        ({"hold": (("c", 2.5),)}, "joint 'c' is to be held at 2.5; it must lie between -2 and 2"),
        ({"hold": (("c", 0.1), ("c", 0.2))}, "joint 'c' is held at two values; give it one"),
        ({"joints": ()}, r"joints is \[\]; name those to plan for, of \['a', 'b', 'c'\]"),
        ({"allow": (("uper", "lower"),)}, r"no body 'uper' in .* to allow \(perhaps 'upper'\); th"),
    ],
)
def test_what_cannot_be_chosen_is_said_in_a_sentence(tiny_path, options, message):
    with pytest.raises(InputError, match=message):
        load_bare_arm(str(tiny_path), ArmOptions(**options))


def test_a_name_is_of_one_arm_where_several_are_trained_for(tiny_path, tmp_path):
    config = TrainMotionConfig(
        robots=(str(tiny_path), "kuka_iiwa14"), hold=(("c", 0.2),), out=tmp_path / "run"
    )
    with pytest.raises(InputError, match="hold is of one arm, and robots names 2; name that alone"):
        train_motion(config)
