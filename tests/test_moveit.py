"""MoveIt's planning scenes and requests: what stands where, and what is refused."""

import copy
import dataclasses
import logging

import jax
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from gnnjax import load_robot, problem_from_moveit, query_from_moveit, scene_from_moveit
from gnnjax.errors import InputError
from gnnjax.execute import ExecuteConfig, main
from gnnjax.problems import moveit
from gnnjax.problems.moveit_names import end_alike, prefix_of
from gnnjax.scene.messages import read_message
from gnnjax.scene.scene import Scene
from gnnjax.scene.shapes import KINDS, cylinder, kind_of
from gnnjax.trajectory.files import save_trajectory
from gnnjax.trajectory.trajectory import time_path

TURN = [0.0, 0.0, 0.6, 0.8]  # x y z w

# As the benchmarks are published: types by name, poses as lists, headers left out.
SCENE = """
robot_model_name: panda
name: ""
fixed_frame_transforms:
  - transform: {translation: [0, 0, 0], rotation: [0, 0, 0, 1]}
    child_frame_id: world
allowed_collision_matrix: {entry_names: [hand], entry_values: [[false]]}
robot_state:
  joint_state: {name: [a], position: [0]}
  multi_dof_joint_state:
    joint_names: [virtual_joint]
    transforms: [{translation: [0, 0, 0], rotation: [0, 0, 0, 1]}]
    wrench: []
    twist: []
world:
  collision_objects:
    - id: can
      primitives: [{type: cylinder, dimensions: [0.14, 0.03]}]
      primitive_poses: [{position: [0.5, 0.1, 0.3], orientation: [0, 0, 0.6, 0.8]}]
    - id: table
      primitives: [{type: box, dimensions: [0.8, 0.4, 0.02]}, {type: sphere, dimensions: [0.2]}]
      primitive_poses:
        - {position: [0, 1, 0], orientation: [0.6, 0, 0, 0.8]}
        - {position: [1e-05, -1, 2], orientation: [0, 0, 0, 1]}
"""
REQUEST = """
group_name: arm
workspace_parameters: {min_corner: [-1, -1, -1], max_corner: [1, 1, 1]}
start_state:
  multi_dof_joint_state:
    joint_names: [virtual_joint]
    transforms: [{translation: [0, 0, 0], rotation: [0, 0, 0, 1]}]
  joint_state: {name: [c, finger, a, b], position: [0.3, 0.04, 0.1, 0.2]}
goal_constraints:
  - joint_constraints:
      - {joint_name: b, position: -0.2}
      - {joint_name: c, position: -0.3, tolerance_above: 0.01, tolerance_below: 0.01, weight: 1}
      - {joint_name: a, position: -0.1}
"""


def written(folder, message, name="scene.yaml"):
    path = folder / name
    text = message if isinstance(message, str) else yaml.safe_dump(message)
    path.write_text(text, encoding="utf-8")
    return path


def read(folder, message) -> Scene:
    return scene_from_moveit(written(folder, message))


@pytest.fixture
def message():
    return yaml.safe_load(SCENE)


def existing(scene: Scene) -> dict[str, np.ndarray]:
    """Of each kind, the centres and what follows."""
    kinds = np.where(scene.mask, kind_of(scene.half_extents, scene.radii), -1)
    columns = np.concatenate([np.asarray(x) for x in scene[:4]], axis=-1)
    return {kind: columns[kinds == number] for number, kind in enumerate(KINDS)}


def test_full_edges_heights_and_quaternions_become_ours(tmp_path, message):
    found = existing(read(tmp_path, message))
    #                              centre       half extents     w x y z           disc, ball
    box = [0, 1, 0, 0.4, 0.2, 0.01, 0.8, 0.6, 0, 0, 0, 0]
    ball = [1e-5, -1, 2, 0, 0, 0, 1, 0, 0, 0, 0, 0.2]
    can = [0.5, 0.1, 0.3, 0, 0, 0.07, 0.8, 0, 0, 0.6, 0.03, 0]
    np.testing.assert_allclose(found["box"], [box], atol=1e-7)
    np.testing.assert_allclose(found["sphere"], [ball], atol=1e-7)
    np.testing.assert_allclose(found["cylinder"], [can], atol=1e-7)


def test_types_by_number_fields_by_name_and_a_second_document_are_read(tmp_path, message):
    expected = read(tmp_path, message)
    world = message["world"]["collision_objects"]
    for each, numbers in zip(world, ([3], [1, 2]), strict=True):
        for primitive, number in zip(each["primitives"], numbers, strict=True):
            primitive["type"] = number
        each |= {"operation": 0, "header": {"frame_id": "world"}, "meshes": [], "plane_poses": []}
        for pose in each["primitive_poses"]:
            for name, axes in (("position", "xyz"), ("orientation", "xyzw")):
                pose[name] = dict(zip(axes, pose[name], strict=True))
    message["world"]["octomap"] = {"octomap": {"id": "", "data": [], "resolution": 0.0}}
    echoed = yaml.safe_dump(message) + "\n---\n"
    for mine, theirs in zip(read(tmp_path, echoed), expected, strict=True):
        np.testing.assert_array_equal(mine, theirs)


def random_pose(rng):
    return rng.uniform(-1, 1, 3), Rotation.random(rng=rng)


def as_fields(pose, names=("position", "orientation")):
    return {names[0]: pose[0].tolist(), names[1]: pose[1].as_quat().tolist()}


def test_the_poses_of_frame_object_primitive_and_robot_are_composed(tmp_path, message):
    rng = np.random.default_rng(0)
    frame, thing, primitive, robot = (random_pose(rng) for _ in range(4))
    message["fixed_frame_transforms"].append(
        {"child_frame_id": "camera", "transform": as_fields(frame, ("translation", "rotation"))}
    )
    message["robot_state"]["multi_dof_joint_state"]["transforms"] = [
        as_fields(robot, ("translation", "rotation"))
    ]
    message["world"]["collision_objects"] = [
        {
            "id": 7,
            "header": {"frame_id": "camera"},
            "pose": as_fields(thing),
            "primitives": [{"type": "box", "dimensions": [0.2, 0.4, 0.6]}],
            "primitive_poses": [as_fields(primitive)],
            "planes": [{"coef": [1.0, 2.0, 2.0, 3.0]}],
            "plane_poses": [as_fields(primitive)],
        }
    ]
    found = existing(read(tmp_path, message))
    corners = rng.uniform(-1, 1, (5, 3)) * [0.1, 0.2, 0.3]

    def to_base(points):
        for position, rotation in (primitive, thing, frame):
            points = rotation.apply(points) + position
        return robot[1].inv().apply(points - robot[0])

    (row,) = found["box"]
    seen = Rotation.from_quat(row[6:10], scalar_first=True).apply(corners) + row[:3]
    np.testing.assert_allclose(seen, to_base(corners), atol=1e-6)
    # The plane: what is on it is on the face of the half-space, which the base is not in.
    on = np.array([[-3.0, 0, 0], [0, -1.5, 0], [0, 0, -1.5]])
    (row,) = found["half_space"]
    local = Rotation.from_quat(row[6:10], scalar_first=True).inv()
    np.testing.assert_allclose(local.apply(to_base(on) - row[:3])[:, 2], row[5], atol=1e-4)
    assert local.apply(-row[:3])[2] > row[5]


@pytest.mark.parametrize(("coef", "up"), [([0, 0, 1, 0.5], 1), ([0, 0, -2, -1.0], 1)])
def test_a_plane_leaves_the_arm_on_the_side_of_its_base(tmp_path, message, coef, up):
    message["world"]["collision_objects"] = [
        {
            "id": "floor",
            "planes": [{"coef": coef}],
            "plane_poses": [{"position": [0, 0, 0], "orientation": [0, 0, 0, 1]}],
        }
    ]
    (row,) = existing(read(tmp_path, message))["half_space"]
    np.testing.assert_allclose(row[2] + up * row[5], -0.5, atol=1e-6)


def test_an_object_may_have_the_pose_of_its_only_shapes(tmp_path, message):
    table = message["world"]["collision_objects"][0]
    pose = table.pop("primitive_poses")[0]
    table["pose"] = pose
    np.testing.assert_allclose(
        existing(read(tmp_path, message))["cylinder"][0, :3], [0.5, 0.1, 0.3]
    )
    # As fields have that nobody set.
    table |= {"pose": {"position": [0] * 3, "orientation": [0] * 4}, "primitive_poses": [pose]}
    np.testing.assert_allclose(
        existing(read(tmp_path, message))["cylinder"][0, :3], [0.5, 0.1, 0.3]
    )


def test_one_frame_that_nothing_else_names_is_the_planning_frame(tmp_path, message):
    del message["fixed_frame_transforms"]
    objects = message["world"]["collision_objects"]
    for each in objects:
        each["header"] = {"frame_id": "base_link"}
    assert read(tmp_path, message).mask.sum() == 3
    objects[1]["header"] = {"frame_id": "camera"}
    with pytest.raises(InputError, match=r"is in the frame 'base_link', and there are \[''\]"):
        read(tmp_path, message)


def put(*path_and_value):
    """A change of a message: a value at a path into it; the function `dict.pop` removes."""
    *path, value = path_and_value

    def change(message):
        for step in path[:-1]:
            message = message[step]
        if value is dict.pop:
            message.pop(path[-1])
        else:
            message[path[-1]] = value

    return change


FIRST = ("world", "collision_objects", 0)
TABLE = ("world", "collision_objects", 1)
POSE = {"position": [0, 0, 0], "orientation": [0, 0, 0, 1]}


def test_meshes_are_enclosed_where_they_stand(tmp_path, message):
    corners = [[0, 0, 0], [0.2, 0, 0], [0, 0.2, 0], [0, 0, 0.2]]
    vertices = [dict(zip("xyz", corner, strict=True)) for corner in corners]
    triangles = [{"vertex_indices": x} for x in ([0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3])]
    thing = message["world"]["collision_objects"][0]
    thing["meshes"] = [{"vertices": vertices, "triangles": triangles}]
    # Turned by 180 degrees about z.
    thing["mesh_poses"] = [{"position": [0.5, 0, 0.1], "orientation": [0, 0, 1, 0]}]
    scene, before = read(tmp_path, message), read(tmp_path, yaml.safe_load(SCENE))
    assert before.cloud is None
    assert scene.mask.sum() == before.mask.sum()
    assert scene.cloud is not None
    points = scene.cloud.points[: scene.cloud.num]
    # The frame of what else the object has, without the mesh's own pose.
    thing["meshes"], thing["mesh_poses"] = [], []
    thing["primitives"], thing["primitive_poses"] = (
        [{"type": "sphere", "dimensions": [0.01]}] * 4,
        [{"position": [0.5 - x, -y, 0.1 + z], "orientation": [0, 0, 0, 1]} for x, y, z in corners],
    )
    spheres = read(tmp_path, message)
    expected = spheres.centers[spheres.mask & (np.abs(spheres.radii[:, 1] - 0.01) < 1e-6)]
    assert len(expected) == 4
    apart = np.linalg.norm(points - expected[:, None], axis=2).min(axis=1)
    assert (apart <= scene.cloud.radius + 1e-6).all()
    assert (points >= expected.min(axis=0) - 0.01).all()
    assert (points <= expected.max(axis=0) + 0.01).all()
    thing["meshes"] = [{"vertices": vertices, "triangles": [{"vertex_indices": [0, 1, 4]}]}]
    thing["mesh_poses"] = thing["primitive_poses"][:1]
    with pytest.raises(InputError, match=r"triangle 0 of .* are \[0, 1, 4\]; there are 4 vertices"):
        read(tmp_path, message)


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        (put(*FIRST, "primitives", 0, "type", "cone"), "type 'cone'; there are .* enclose it"),
        (put(*FIRST, "primitives", 0, "type", 4), "type 'cone'"),
        (put(*FIRST, "primitives", 0, "type", "torus"), r"type 'torus'; there are \['box'"),
        (put(*FIRST, "primitives", 0, "type", 9), "type 9"),
        (put(*FIRST, "primitives", 0, "dimensions", [0.1]), "height, radius.* list of 2 finite"),
        (put(*TABLE, "primitives", 0, "dimensions", [1, 1, -1]), "object 'table'.* positive"),
        (put(*FIRST, "primitives", 0, "dimensions", 3), "dimensions .* give a list of 2"),
        (put(*FIRST, "primitives", 0, "polygon", [1]), None),
        (put(*FIRST, "primitive_poses", []), "0 primitive_poses for 1 primitives"),
        (put(*FIRST, "primitive_poses", 0, "position", dict.pop), "position .* list of 3 finite"),
        (put(*FIRST, "primitive_poses", 0, "position", [0, float("nan"), 0]), "3 finite numbers"),
        (put(*FIRST, "primitive_poses", 0, "position", [True, 0, 0]), "3 finite numbers"),
        (put(*FIRST, "primitive_poses", 0, "position", ["far", 0, 0]), "3 finite numbers"),
        (put(*FIRST, "primitive_poses", 0, "orientation", [0, 0, 1]), "list of 4 finite numbers"),
        (put(*FIRST, "primitive_poses", 0, "orientation", [0] * 4), "zeros; give a rotation"),
        (put(*FIRST, "primitives", [{"type": "box", "dimensions": [1e5] * 3}]), "below 10000 m"),
        (put(*FIRST, "meshes", [{"vertices": []}]), "has 0 mesh_poses for 1 meshes; give each one"),
        (put(*FIRST, "primitives", []), "1 primitive_poses for 0 primitives"),
        (put(*FIRST, {"id": "nothing"}), "object 'nothing' .* no primitives, planes or meshes"),
        (put(*FIRST, "planes", [{"coef": [0, 0, 0, 1]}]), "0 plane_poses for 1 planes"),
        (put(*FIRST, "operation", "move"), "operation 'move'"),
        (put(*FIRST, "operation", 1), "operation 1"),
        (put(*FIRST, "header", {"frame_id": "hand"}), r"frame 'hand', and there are \['', 'world'"),
        (put(*FIRST, "hulls", [1]), r"a collision object .* has \['hulls'\]"),
        (put(*FIRST, "a string"), "a collision object of .* is 'a string'"),
        (put("world", "octomap", {"octomap": {"data": [0, 1]}}), "has binary = None; give true"),
        (put("world", "octomap", {"octomap": {"data": [0, 300]}}), "give bytes, -128 to 255"),
        (put("world", "collision_objects", 3), "collision_objects = 3; give a list"),
        (put("world", "voxels", 3), r"world of .* has \['voxels'\]"),
        (put("world", dict.pop), "has no world; give what stands there"),
        (put(*FIRST, "primitive_poses", 0, "position", [0, 1e39, 0]), "3 finite numbers"),
        (put("is_diff", True), "is a difference to another"),
        (put("link_padding", [{"link_name": "hand", "padding": 0.01}]), "link_padding 0.01"),
        (put("link_scale", [{"link_name": "hand", "scale": 1.0}]), None),
        (
            put("robot_state", "attached_collision_objects", [{}]),
            "object attached to '' in .* frame",
        ),
        (
            put("robot_state", "multi_dof_joint_state", "joint_names", ["a", "b"]),
            r"1 transforms for the joints \['a', 'b'\]",
        ),
        (
            put("fixed_frame_transforms", 0, "transform", "rotation", [0, 0, 0, 0]),
            "rotation of a transform of fixed_frame_transforms",
        ),
        (put("meshes", []), r"has \['meshes'\], which is not known here"),
    ],
)
def test_what_cannot_be_read_is_refused_in_a_sentence(tmp_path, message, change, fault):
    change(message)
    if fault is None:
        assert read(tmp_path, message).mask.sum() == 3
        return
    with pytest.raises(InputError, match=fault) as found:
        read(tmp_path, message)
    assert "scene.yaml" in str(found.value)
    assert "\n" not in str(found.value)


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("a: [1", "is no YAML"),
        ("name: a\nname: b", "'name' comes twice in one mapping"),
        ("world: {}\n---\nworld: {}\n", "holds 2 messages; give a file with one"),
        ("", "holds 0 messages"),
        ("- 1", r"is \[1\]; it should have fields"),
        ("name: !!python/object/apply:os.getcwd []", "is no YAML"),
    ],
)
def test_files_that_hold_no_message_are_refused(tmp_path, text, fault):
    with pytest.raises(InputError, match=fault):
        read(tmp_path, text)


def test_missing_files_are_named(tmp_path):
    with pytest.raises(InputError, match=r"no planning scene '.*none.yaml'; check the path"):
        scene_from_moveit(tmp_path / "none.yaml")
    with pytest.raises(InputError, match="is a folder"):
        scene_from_moveit(tmp_path)
    path = tmp_path / "latin.yaml"
    path.write_bytes(b"name: \xe9\xff")
    with pytest.raises(InputError, match="is no YAML"):
        read_message(path, "planning scene", ["name"])


@pytest.fixture(autouse=True)
def notes_are_new():
    """Each is logged once a process."""
    moveit._note.cache_clear()


def problem_of(folder, robot, request, scene=SCENE, **options):
    scene, request = written(folder, scene), written(folder, request, "request.yaml")
    return problem_from_moveit(scene, request, robot, **options)


@pytest.fixture
def request_message():
    return yaml.safe_load(REQUEST)


def test_joints_are_in_the_robots_order_whatever_the_files(tmp_path, tiny_path, caplog):
    problem = problem_of(tmp_path, load_robot(tiny_path), REQUEST)
    np.testing.assert_allclose(problem.start, [0.1, 0.2, 0.3], rtol=1e-6)
    np.testing.assert_allclose(problem.goal, [-0.1, -0.2, -0.3], rtol=1e-6)
    assert problem.scene.mask.sum() == 3
    assert problem.start.dtype == np.float32
    problem_of(tmp_path, load_robot(tiny_path), REQUEST)
    (record,) = caplog.records
    assert record.message == "requests have finger at 0.04, which tiny does not have as a joint"


def test_names_that_end_alike_are_the_same_joint(tmp_path, caplog):
    robot = load_robot("franka_panda")  # joint_1 to joint_7
    names = [f"panda_joint{i}" for i in range(1, 8)]
    fingers = ["panda_finger_joint1", "panda_finger_joint2"]  # held at 0.04
    start = {"name": [*names, *fingers], "position": [*(0.1 * i for i in range(7)), 0.04, 0.065]}
    goal = [{"joint_name": name, "position": 0.5 + i} for i, name in enumerate(names)]
    request = {
        "start_state": {"joint_state": start},
        "goal_constraints": [{"joint_constraints": goal[::-1]}],
    }
    problem = problem_of(tmp_path, robot, request)
    np.testing.assert_allclose(problem.start, 0.1 * np.arange(7), rtol=1e-6)
    np.testing.assert_allclose(problem.goal, 0.5 + np.arange(7))
    (record,) = caplog.records
    assert record.levelno == logging.WARNING
    assert record.message.startswith(
        "requests have panda_finger_joint2 at 0.065, which franka_panda holds at 0.04; load_robot("
    )


@pytest.mark.parametrize(
    ("joint", "other", "alike"),
    [
        ("joint_1", "panda_joint1", True),
        ("iiwa_joint_1", "joint_a1", False),
        ("left_joint1", "right_joint1", False),
        ("joint_1", "panda_joint11", False),
        ("", "a", False),
    ],
)
def test_which_names_end_alike(joint, other, alike):
    assert end_alike(joint, other) is alike
    assert end_alike(other, joint) is alike


def test_names_may_be_given(tmp_path, tiny_path, request_message):
    robot = load_robot(tiny_path)
    text = REQUEST.replace("joint_name: a", "joint_name: waist").replace("r, a", "r, waist")
    with pytest.raises(InputError, match=r"goal joints b, c, waist, none .* surely 'a' of tiny"):
        problem_of(tmp_path, robot, text)
    problem = problem_of(tmp_path, robot, text, names={"a": "waist"})
    np.testing.assert_allclose(problem.goal, [-0.1, -0.2, -0.3], rtol=1e-6)
    with pytest.raises(InputError, match=r"names has \['q'\], and the joints of tiny are"):
        problem_of(tmp_path, robot, text, names={"q": "waist"})
    with pytest.raises(InputError, match="none of them surely 'a'"):
        problem_of(tmp_path, robot, text, names={"a": "wrist"})
    with pytest.raises(InputError, match="none of them surely 'a'"):
        problem_of(tmp_path, robot, text, names={"a": "b"})


def test_joints_that_are_held_must_be_held_there(tmp_path, tiny_path, caplog, request_message):
    """The start is a matter for a note, a goal cannot be reached."""
    for held, value in ((-0.3, "0.3"), (0.3, None)):
        robot = load_robot(tiny_path, hold={"c": held})
        if value is None:
            with pytest.raises(InputError, match=r"wants c at -0.3 in .*tiny holds at 0.3; load"):
                problem_of(tmp_path, robot, request_message)
            continue
        caplog.clear()
        problem = problem_of(tmp_path, robot, request_message)
        np.testing.assert_allclose(problem.start, [0.1, 0.2], rtol=1e-6)
        np.testing.assert_allclose(problem.goal, [-0.1, -0.2], rtol=1e-6)
        expected = f"requests have c at {value}, which tiny holds at -0.3; load_robot(hold=...)"
        assert [r.message for r in caplog.records if expected in r.message]
    goal = request_message["goal_constraints"][0]["joint_constraints"]
    goal.append({"joint_name": "wing", "position": 1.0})
    with pytest.raises(InputError, match="wants wing at 1 in its goal, which tiny does not have"):
        problem_of(tmp_path, load_robot(tiny_path), request_message)


GOAL = ("goal_constraints", 0)


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        (put("goal_constraints", []), "has 0 goals"),
        (put("goal_constraints", [{}, {}]), "has 2 goals in goal_constraints; give one"),
        (put(*GOAL, "position_constraints", [{}]), r"\['position_constraints'\] in its goal"),
        (put(*GOAL, "joint_constraints", 0, "position", float("inf")), "position in .* finite"),
        (put(*GOAL, "joint_constraints", 0, "tolerance_above", -1), "must not be negative"),
        (put(*GOAL, "joint_constraints", 0, "joint_name", "a"), "constrains a twice"),
        (put("path_constraints", {"joint_constraints": [{}]}), "has path_constraints, which no"),
        (put("path_constraints", {"name": "x", "joint_constraints": []}), None),
        (put("start_state", "joint_state", dict.pop), "start_state of .* lacks a, b, c"),
        (put("start_state", "joint_state", "position", [1.0]), "has 1 positions for the joints"),
        (put("start_state", "joint_state", "name", ["a", "a", "b", "c"]), "4 positions for"),
        (
            put("start_state", "multi_dof_joint_state", "transforms", 0, "translation", [0, 0, 1]),
            r"has the robot at \[0.0, 0.0, 1.0\] .* place it once",
        ),
        (put("start_state", "multi_dof_joint_state", dict.pop), None),
        (put("goals", []), r"has \['goals'\], which is not known here"),
    ],
)
def test_requests_that_ask_for_something_else_are_refused(
    tmp_path, tiny_path, request_message, change, fault
):
    change(request_message)
    robot = load_robot(tiny_path)
    if fault is None:
        assert problem_of(tmp_path, robot, request_message).start.shape == (3,)
        return
    with pytest.raises(InputError, match=fault):
        problem_of(tmp_path, robot, request_message)


def test_a_base_that_only_the_request_places_counts(tmp_path, tiny_path, message, request_message):
    robot = load_robot(tiny_path)
    here = problem_of(tmp_path, robot, request_message, message).scene
    del message["robot_state"]
    placed = copy.deepcopy(request_message)
    place = placed["start_state"]["multi_dof_joint_state"]["transforms"][0]
    place["translation"] = [0, 0, 1]
    there = problem_of(tmp_path, robot, placed, message).scene
    np.testing.assert_allclose(there.centers[:3], here.centers[:3] - [0, 0, 1], atol=1e-6)


@pytest.mark.parametrize(
    ("own", "other", "prefix"),
    [
        ("link_7", "panda_link7", ("panda", "")),
        ("my_arm_hand", "Hand", ("", "myarm")),
        ("left_hand", "lefthand", ("", "")),
        ("hand", "forehand", None),
        ("hand", "hand_left", None),
        ("", "hand", None),
    ],
)
def test_what_stands_before_names(own, other, prefix):
    assert prefix_of(own, other) == prefix
    assert prefix_of(other, own) == (prefix and prefix[::-1])


def attached(**changes):
    """A moveit_msgs/AttachedCollisionObject, which MoveIt gives in the frame of its link."""
    pose = {"position": [0.3, 0, 0.02], "orientation": TURN}
    thing = {
        "id": "bottle",
        "header": {"frame_id": "arm_lower"},
        "pose": {"position": [0.01, 0, 0], "orientation": [0, 0, 0, 1]},
        "primitives": [{"type": "cylinder", "dimensions": [0.2, 0.03]}],
        "primitive_poses": [pose],
    }
    held = {
        "link_name": "arm_lower",
        "object": thing,
        "touch_links": ["arm_middle", "arm_lower", "arm_finger"],
        "detach_posture": {"joint_names": [], "points": []},
        "weight": 0.5,
    }
    return {**held, **changes}


def query_of(folder, robot, request, scene):
    scene, request = written(folder, scene), written(folder, request, "request.yaml")
    return query_from_moveit(scene, request, robot)


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
        ("", "arm_lower", ["arm_middle"], True),
        ("", "arm_lower", ["left_middle"], False),
        ("arm_", "arm_lower", ["armmiddle", "left_middle"], False),
        ("arm_", "lower", ["arm-middle"], True),
        ("arm_", "left_lower", [], None),
    ],
)
def test_what_is_held_touches_links_of_the_prefix_of_joints_or_of_the_holder_alone(
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
        with pytest.raises(InputError, match=r"attached to 'left_lower' .* has no such body"):
            query_of(tmp_path, robot, request_message, SCENE)
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


def test_an_arm_to_which_nothing_is_attached_is_as_it_was(tmp_path, tiny_path):
    robot = load_robot(tiny_path)
    assert query_of(tmp_path, robot, REQUEST, SCENE).robot is robot


MESH = {"vertices": [], "triangles": []}
THING = attached()["object"]


@pytest.mark.parametrize(
    ("changes", "fault"),
    [
        (
            {"link_name": "arm_wing"},
            "attached to 'arm_wing' in .* in the frame 'arm_lower'; give it",
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
        ({"object": {"header": {"frame_id": "arm_lower"}}}, "no primitives, planes or meshes"),
        ({"weight": -1}, "weight of object attached to 'arm_lower' .* is -1; it must not"),
        ({"weight": "much"}, "weight of .* finite"),
        ({"touch_links": "hand"}, "touch_links = 'hand'; give a list"),
        ({"weigth": 1}, r"has \['weigth'\]"),
        (
            {"link_name": "wing", "object": {**THING, "header": {"frame_id": "wing"}}},
            r"attached to 'wing' .* tiny has no such body, but \['upper', 'middle', 'lower'\]",
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
