"""Objects that MoveIt has attached to a robot: they are held, or refused in a sentence."""

import dataclasses

import jax
import numpy as np
import pytest
import yaml

from gnnjax import load_robot, query_from_moveit
from gnnjax.errors import InputError
from gnnjax.execute import ExecuteConfig, main
from gnnjax.problems import moveit
from gnnjax.query_options import QueryOptions, read_query
from gnnjax.scene.shapes import cylinder
from gnnjax.trajectory.files import save_trajectory
from gnnjax.trajectory.trajectory import time_path
from tests.moveit_messages import POSE, REQUEST, SCENE, TURN, problem_of, read, written


@pytest.fixture(autouse=True)
def notes_are_new():
    """Each is logged once a process."""
    moveit._note.cache_clear()


@pytest.fixture
def message():
    return yaml.safe_load(SCENE)


@pytest.fixture
def request_message():
    return yaml.safe_load(REQUEST)


def attached(**changes):
    """A moveit_msgs/AttachedCollisionObject, which MoveIt gives in the frame of its link."""
    pose = {"position": [0.3, 0, 0.02], "orientation": TURN}
    thing = {
        "id": "bottle",
        "header": {"frame_id": "lower"},
        "pose": {"position": [0.01, 0, 0], "orientation": [0, 0, 0, 1]},
        "primitives": [{"type": "cylinder", "dimensions": [0.2, 0.03]}],
        "primitive_poses": [pose],
    }
    held = {
        "link_name": "lower",
        "object": thing,
        "touch_links": ["middle", "lower", "arm_finger"],
        "detach_posture": {"joint_names": [], "points": []},
        "weight": 0.5,
    }
    return {**held, **changes}


THING = attached()["object"]


def query_of(folder, robot, request, scene, **options):
    scene, request = written(folder, scene), written(folder, request, "request.yaml")
    return query_from_moveit(scene, request, robot, **options)


@pytest.mark.parametrize("where", ["scene", "request"])
def test_what_is_attached_is_held(tmp_path, tiny_path, message, request_message, where, caplog):
    robot = load_robot(tiny_path)
    state = message["robot_state"] if where == "scene" else request_message["start_state"]
    state["attached_collision_objects"] = [attached()]
    found = query_of(tmp_path, robot, request_message, message)
    bottle = cylinder([0.31, 0, 0.02], radius=0.03, half_length=0.1, quat=[0.8, 0, 0, 0.6])
    wanted = robot.attach("lower", [bottle], mass=0.5, allow=["middle", "lower"])
    for mine, theirs in zip(found.robot.parts, wanted.parts, strict=True):
        np.testing.assert_allclose(mine.vertices, theirs.vertices, atol=1e-9)
    assert found.robot.mj_model.body_mass.sum() == pytest.approx(wanted.mj_model.body_mass.sum())
    np.testing.assert_array_equal(found.robot.part_pairs, wanted.part_pairs)
    assert query_of(tmp_path, robot, request_message, message).robot is found.robot
    assert [
        r.message for r in caplog.records if "let arm_finger be touched, which tiny" in r.message
    ]
    for mine, theirs in zip(found.problem, problem_of(tmp_path, robot, REQUEST), strict=True):
        jax.tree.map(np.testing.assert_array_equal, mine, theirs)
    with pytest.raises(InputError, match="attached to the robot; query_from_moveit gives the arm"):
        problem_of(tmp_path, robot, request_message, message)
    if where == "scene":
        with pytest.raises(InputError, match="attached to the robot; query_from_moveit"):
            read(tmp_path, message)


@pytest.mark.parametrize(
    ("joints", "link", "touches", "may"),
    [
        ("", "lower", ["left_middle", "middle_"], True),
        ("", "lower", ["left_middle", "leftmiddle", "arm_lower"], False),
        ("", "arm_lower", [], None),
        ("arm_", "arm_lower", ["armmiddle", "left_middle"], False),
        ("arm_", "lower", ["arm-middle"], True),
        ("arm_", "left_lower", [], None),
        ("arm_", "arm_lower", ["arm_middle"], True),
    ],
)
def test_what_is_held_touches_links_of_the_prefix_of_joints_alone(
    tmp_path, tiny_path, request_message, joints, link, touches, may, caplog
):
    robot = load_robot(tiny_path)
    thing = {**THING, "header": {"frame_id": link}}
    held = attached(link_name=link, object=thing, touch_links=touches)
    state, (goal,) = request_message["start_state"], request_message["goal_constraints"]
    state["attached_collision_objects"] = [held]
    names = state["joint_state"]["name"]
    state["joint_state"]["name"] = [joints + name for name in names]
    for each in goal["joint_constraints"]:
        each["joint_name"] = joints + each["joint_name"]
    if may is None:
        fault = rf"attached to '{link}' .* one of these, or say names={{'lower': '{link}'}}"
        with pytest.raises(InputError, match=fault):
            query_of(tmp_path, robot, request_message, SCENE)
        names = {"lower": link, "middle": "wrist"}
        held["touch_links"] = ["wrist", "middle"]
        (load,) = query_of(tmp_path, robot, request_message, SCENE, names=names).robot.loads
        assert (load.body, load.allow) == ("lower", ("middle",))
        return
    moveit._note.cache_clear()
    (load,) = query_of(tmp_path, robot, request_message, SCENE).robot.loads
    assert (load.body, "middle" in load.allow) == ("lower", may)
    told = "let left_middle be touched, which" in caplog.text
    assert told is ("left_middle" in touches)
    assert ("link arm_middle of planning scenes is taken for body middle" in caplog.text) is (
        "arm_middle" in touches
    )


def test_a_motion_of_what_a_request_has_attached_is_carried_out(
    tmp_path, tiny_path, request_message, capsys
):
    robot, file = load_robot(tiny_path), tmp_path / "motion.json"
    request_message["start_state"]["attached_collision_objects"] = [attached()]
    found = query_of(tmp_path, robot, request_message, yaml.safe_load(SCENE))
    path = [found.problem.start, found.problem.start + np.float32(0.05)]
    limits = {"velocity": 1.5, "acceleration": 5.0}
    motion = time_path(found.robot, found.problem.scene, path, **limits)
    save_trajectory(found.robot, motion, file)
    config = ExecuteConfig(
        robot=str(tiny_path),
        scene=tmp_path / "scene.yaml",
        request=tmp_path / "request.yaml",
        trajectory=file,
        torque=(40.0, 40.0, 20.0),
    )
    assert main(config) == 0
    assert "says, lower holds" not in capsys.readouterr().out
    assert main(dataclasses.replace(config, request=None)) == 0  # the file tells
    assert "motion.json says, lower holds held_cylinder_0, 0.5 kg" in capsys.readouterr().out
    request_message["start_state"]["attached_collision_objects"][0]["weight"] = 0.4
    other = dataclasses.replace(config, request=written(tmp_path, request_message, "other.yaml"))
    with pytest.raises(InputError, match=r"not of tiny_hold.* what it held \(--attach, or --req"):
        main(other)
    with pytest.raises(InputError, match=r"--request needs a planning scene of MoveIt"):
        main(dataclasses.replace(config, scene=tmp_path / "scene.json"))


@pytest.mark.parametrize("kind", ["npz", "csv"])
def test_a_motion_in_a_scene_that_has_something_attached_needs_no_request(
    tmp_path, tiny_path, message, kind, capsys
):
    robot, file = load_robot(tiny_path), tmp_path / f"motion.{kind}"
    held = attached(link_name="arm_lower", object={**THING, "header": {"frame_id": "arm_lower"}})
    message["robot_state"]["attached_collision_objects"] = [held]
    message["robot_state"]["joint_state"] = {
        "name": ["arm_a", "arm_b", "arm_f"],
        "position": [0] * 3,
    }
    scene = written(tmp_path, message)
    options = QueryOptions(
        scene=scene, start=(0.0,) * 3, goal=(0.05, 0.0, 0.0), robot=str(tiny_path)
    )
    arm, _, _, obstacles = read_query(options, robot)
    assert [load.body for load in arm.loads] == ["lower"]
    path = np.array([options.start, options.goal], np.float32)
    save_trajectory(arm, time_path(arm, obstacles, path, velocity=1.5, acceleration=5.0), file)
    config = ExecuteConfig(
        robot=str(tiny_path), scene=scene, trajectory=file, torque=(40.0, 40.0, 20.0)
    )
    assert main(config) == 0
    assert "carried out: nothing was touched" in capsys.readouterr().out
    held["weight"] = 0.4
    other = dataclasses.replace(config, scene=written(tmp_path, message, "other.yaml"))
    if kind == "npz":  # tables do not tell what was held
        with pytest.raises(InputError, match=r"not of tiny_hold.* what it held \(--attach, or --r"):
            main(other)
    message["robot_state"]["joint_state"] = {}  # nothing says that all links are called so
    with pytest.raises(InputError, match=r"attached to 'arm_lower' .* or say names="):
        main(dataclasses.replace(config, scene=written(tmp_path, message, "other.yaml")))


def test_an_arm_to_which_nothing_is_attached_is_as_it_was(tmp_path, tiny_path):
    robot = load_robot(tiny_path)
    assert query_of(tmp_path, robot, REQUEST, SCENE).robot is robot


MESH = {"vertices": [], "triangles": []}


@pytest.mark.parametrize(
    ("changes", "fault"),
    [
        (
            {"link_name": "arm_wing"},
            "attached to 'arm_wing' in .* in the frame 'lower'; give it",
        ),
        ({"object": {**THING, "header": {}}}, "is in the frame ''; give it in that of its link"),
        (
            {"object": {**THING, "meshes": [MESH], "mesh_poses": [POSE]}},
            "a mesh or a plane, which no",
        ),
        (
            {"object": {**THING, "planes": [{"coef": [0, 0, 1, 0]}], "plane_poses": [POSE]}},
            "a plane",
        ),
        ({"object": {"header": {"frame_id": "lower"}}}, "no primitives, planes or meshes"),
        ({"weight": -1}, "weight of object attached to 'lower' .* is -1; it must not"),
        ({"weight": "much"}, "weight of .* finite"),
        ({"touch_links": "hand"}, "touch_links = 'hand'; give a list"),
        ({"weigth": 1}, r"has \['weigth'\]"),
        (
            {"link_name": "wing", "object": {**THING, "header": {"frame_id": "wing"}}},
            r"attached to 'wing' .*: tiny has .*; call it like one of these, or say names=",
        ),
    ],
)
def test_what_cannot_be_held_is_refused_in_a_sentence(tmp_path, tiny_path, message, changes, fault):
    message["robot_state"]["attached_collision_objects"] = [attached(**changes)]
    with pytest.raises(InputError, match=fault):
        query_of(tmp_path, load_robot(tiny_path), REQUEST, message)


def test_objects_attached_in_both_files_are_refused(tmp_path, tiny_path, message, request_message):
    for state in (message["robot_state"], request_message["start_state"]):
        state["attached_collision_objects"] = [attached()]
    with pytest.raises(InputError, match="both have objects attached to the robot; keep those of"):
        query_of(tmp_path, load_robot(tiny_path), request_message, message)
