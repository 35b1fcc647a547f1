"""Arms from URDF files, with meshes in packages and formats that MuJoCo does not take."""

import itertools
import struct
import sys

import mujoco
import numpy as np
import pytest
from scipy.spatial import ConvexHull

from gnnjax.arm.robot import load_robot
from gnnjax.errors import InputError
from gnnjax.planning.load import make_planner
from gnnjax.planning.options import PlannerOptions
from gnnjax.scene.mujoco_world import deepest_contact
from gnnjax.scene.scene import make_scene
from gnnjax.trajectory.limits import limits_of

ARM = """<?xml version="1.0"?>
<robot name="arm">
  <link name="world"/>
  <link name="base"><visual><geometry><mesh filename="package://nowhere/base.dae"/></geometry></visual>
    <collision><geometry><cylinder radius="0.08" length="0.1"/></geometry></collision></link>
  <link name="upper"><collision><origin xyz="0 0 0.2" rpy="0.1 0.2 0.3"/>
    <geometry><mesh filename="MESH" scale="0.001 0.001 0.002"/></geometry></collision>
    <inertial><mass value="2"/><origin xyz="0 0 0.2"/>
      <inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="lower"><collision><geometry><sphere radius="0.06"/></geometry></collision></link>
  <link name="left"><collision><geometry><box size="0.01 0.02 0.05"/></geometry></collision></link>
  <link name="right"><collision><geometry><box size="0.01 0.02 0.05"/></geometry></collision></link>
  <link name="tool"/>
  <joint name="mount" type="fixed"><parent link="world"/><child link="base"/>
    <origin xyz="0.1 0.2 0.3" rpy="0 0 1"/></joint>
  <joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/>
    <origin xyz="0 0 0.1"/><axis xyz="0 0 1"/>
    <limit lower="-2" upper="2.5" effort="40" velocity="1.5"/></joint>
  <joint name="elbow" type="continuous"><parent link="upper"/><child link="lower"/>
    <origin xyz="0.1 0 0.5"/><axis xyz="0 1 0"/><limit effort="30" velocity="2"/></joint>
  <joint name="grip" type="prismatic"><parent link="lower"/><child link="left"/>
    <origin xyz="0 0.02 0.1"/><axis xyz="0 1 0"/>
    <limit lower="0.0" upper="0.04" effort="10" velocity="0.1"/></joint>
  <joint name="follow" type="prismatic"><parent link="lower"/><child link="right"/>
    <origin xyz="0 -0.02 0.1"/><axis xyz="0 -1 0"/><mimic joint="grip" multiplier="0.5"/>
    <limit lower="0.0" upper="0.04" effort="10" velocity="0.1"/></joint>
  <joint name="flange" type="fixed"><parent link="lower"/><child link="tool"/></joint>
</robot>
"""
# A tetrahedron and a face with a corner that is no number.
HOLED = (
    b"ply\nformat ascii 1.0\nelement vertex 5\nproperty float x\nproperty float y\n"
    b"property float z\nelement face 2\nproperty list uchar int vertex_indices\nend_header\n"
    b"0 0 0\n1 0 0\n0 1 0\n0 0 1\nnan 0 9\n3 0 1 2\n3 2 3 4\n"
)
# Millimetres, of a box of 100 x 60 x 80 with a corner at the origin.
CORNERS = np.array([(x, y, z) for x in (0, 100) for y in (0, 60) for z in (0, 80)], float)


def triangles(points):
    hull = ConvexHull(points)
    faces = points[hull.simplices]
    a, b, c = faces.swapaxes(0, 1)
    turned = np.einsum("fk,fk->f", np.cross(b - a, c - a), hull.equations[:, :3]) < 0
    faces[turned] = faces[turned, ::-1]
    return faces


def stl(faces):
    rows = np.zeros(len(faces), [("n", "<f4", 3), ("v", "<f4", (3, 3)), ("c", "<u2")])
    rows["v"] = faces
    return bytes(80) + struct.pack("<I", len(rows)) + rows.tobytes()


def text_stl(faces):
    lines = ["solid box"]
    for face in faces:
        lines += ["facet normal 0 0 0", "outer loop"]
        lines += [f"vertex {x} {y} {z}" for x, y, z in face]
        lines += ["endloop", "endfacet"]
    return "\n".join([*lines, "endsolid"]).encode()


def obj(faces):
    points = faces.reshape(-1, 3)
    lines = [f"v {x} {y} {z}" for x, y, z in points]
    lines += [f"f {i + 1} {i + 2} {i + 3}" for i in range(0, len(points), 3)]
    return "\n".join(lines).encode()


def many_faces(faces):
    """The same box, of more faces than MuJoCo's reader takes."""
    return stl(np.concatenate([np.tile(faces, (17_000, 1, 1))]))


def package(folder, data=None, name="box.stl", mesh="package://my_arm/meshes/box.stl", text=ARM):
    """A package as on any disk: my_arm/urdf/arm.urdf and my_arm/meshes."""
    for inside in ("urdf", "meshes"):
        (folder / "my_arm" / inside).mkdir(parents=True, exist_ok=True)
    data = stl(triangles(CORNERS)) if data is None else data
    (folder / "my_arm" / "meshes" / name).write_bytes(data)
    path = folder / "my_arm" / "urdf" / "arm.urdf"
    path.write_text(text.replace("MESH", mesh))
    return path


def test_a_urdf_is_read_with_its_limits_and_its_mimicking_finger_is_held(tmp_path, caplog):
    robot = load_robot(package(tmp_path))
    assert robot.joint_names == ("shoulder", "elbow")
    assert robot.held == {"grip": 0.0, "follow": 0.0}
    np.testing.assert_allclose(robot.joint_lower, [-2, -2 * np.pi])
    np.testing.assert_allclose(robot.joint_upper, [2.5, 2 * np.pi])
    np.testing.assert_allclose(robot.velocity_limit, [1.5, 2])
    np.testing.assert_allclose(robot.torque_limit, [40, 30])
    assert robot.acceleration_limit is None
    assert "start and goal, which may be a turn away: elbow" in caplog.text
    assert [body.name for body in robot.bodies] == [
        "base",
        "upper",
        "lower",
        "left",
        "right",
        "tool",
    ]
    # The world is the base, wherever the URDF mounts it.
    np.testing.assert_allclose(robot.bodies[0].position, 0, atol=1e-12)
    held = load_robot(robot.path, hold={"grip": 0.03})
    assert held.held == pytest.approx({"grip": 0.03, "follow": 0.015})


def test_the_mesh_is_where_and_as_large_as_the_urdf_has_it(tmp_path):
    robot = load_robot(package(tmp_path))
    (part,) = (part for part in robot.parts if robot.bodies[part.body].name == "upper")
    turn = np.zeros(4)
    mujoco.mju_euler2Quat(turn, [0.1, 0.2, 0.3], "XYZ")  # about fixed axes
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, turn)
    expected = CORNERS * [0.001, 0.001, 0.002] @ matrix.reshape(3, 3).T + [0, 0, 0.2]
    assert len(part.vertices) == 8
    gaps = np.linalg.norm(part.vertices[:, None] - expected, axis=2)
    assert gaps.min(axis=1).max() < 1e-6


@pytest.mark.parametrize(
    ("write", "name"),
    [(stl, "box.STL"), (text_stl, "box.stl"), (obj, "box.obj"), (many_faces, "box.stl")],
)
def test_meshes_of_all_formats_give_the_same_part(tmp_path, write, name):
    path = package(tmp_path, write(triangles(CORNERS)), name, f"package://my_arm/meshes/{name}")
    expected = load_robot(package(tmp_path / "plain"))
    part, plain = (
        next(part for part in robot.parts if robot.bodies[part.body].name == "upper")
        for robot in (load_robot(path), expected)
    )
    gaps = np.linalg.norm(part.vertices[:, None] - plain.vertices, axis=2)
    assert max(gaps.min(axis=0).max(), gaps.min(axis=1).max()) < 1e-6


@pytest.mark.parametrize(
    "mesh",
    [
        "package://my_arm/meshes/box.stl",
        "package://other_name/meshes/box.stl",
        "model://my_arm/meshes/box.stl",
        "../meshes/box.stl",
        "file://../meshes/box.stl",
    ],
)
def test_meshes_are_found_however_they_are_named(tmp_path, mesh):
    path = package(tmp_path, mesh=mesh)
    robot = load_robot(path)
    assert robot.num_dof == 2
    assert load_robot(path) is robot
    package(tmp_path, stl(triangles(1.5 * CORNERS)), mesh=mesh)  # of the same size, in bytes
    extents = [np.ptp(x.parts[1].vertices, axis=0).max() for x in (robot, load_robot(path))]
    assert extents[1] == pytest.approx(1.5 * extents[0])


def test_a_mesh_folder_of_the_urdf_counts(tmp_path):
    text = ARM.replace(
        '<robot name="arm">', '<robot name="arm"><mujoco><compiler meshdir="../meshes"/></mujoco>'
    )
    assert load_robot(package(tmp_path, mesh="box.stl", text=text)).num_dof == 2


@pytest.mark.parametrize("word", ["", 'velocity="0"', 'velocity="-1"', 'velocity="inf"'])
def test_velocity_limits_are_there_for_all_joints_or_for_none(tmp_path, word):
    robot = load_robot(package(tmp_path, text=ARM.replace('velocity="2"', word)))
    assert robot.velocity_limit is None
    np.testing.assert_allclose(robot.torque_limit, [40, 30])
    weak = package(tmp_path / "weak", text=ARM.replace('effort="30"', 'effort="0"'))
    assert load_robot(weak).torque_limit is None


def test_a_limit_that_is_left_out_beside_another_is_zero(tmp_path):
    text = ARM.replace('lower="-2" upper="2.5"', 'lower="-2"')
    robot = load_robot(package(tmp_path, text=text))
    assert (robot.joint_lower[0], robot.joint_upper[0]) == (-2, 0)


def test_prefixes_that_nothing_explains_are_no_obstacle(tmp_path):
    words = 'velocity="2" drake:acceleration="2.5"'
    text = ARM.replace('velocity="2"', words).replace("</robot>", "<drake:joint/></robot>")
    assert load_robot(package(tmp_path, text=text)).acceleration_limit is None
    text = text.replace('velocity="1.5"', 'velocity="1.5" acceleration="3"')
    robot = load_robot(package(tmp_path / "all", text=text))
    np.testing.assert_allclose(robot.acceleration_limit, [3, 2.5])
    np.testing.assert_allclose(robot.velocity_limit, [1.5, 2])


def test_an_arm_that_others_publish_is_planned_for():
    published = pytest.importorskip("airo_models", reason="its meshes are those of the extra dev")
    # The wrist is held, which halves what is compiled.
    moving = ["shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint"]
    robot = load_robot(
        published.get_urdf_path("ur3e"),
        joints=moving,
        hold={"wrist_1_joint": -1.6, "wrist_2_joint": -1.5},
    )
    np.testing.assert_allclose(robot.acceleration_limit, 2.5)
    assert sum(len(part.vertices) > 30 for part in robot.parts) > 8  # meshes
    scene = make_scene([[-0.4, 0.0, 0.15]], [[0.2, 0.03, 0.15]])
    start, goal = np.array([[np.pi - 0.9, -1.2, 1.3], [np.pi + 0.9, -1.2, 1.3]])
    planner = make_planner(robot, PlannerOptions(num_nodes=50, shorten=False))
    plan = planner.plan(scene, start, goal)
    assert plan.certified
    pieces = itertools.pairwise(plan.path)
    along = np.concatenate([np.linspace(a, b, 20) for a, b in pieces])
    assert all(deepest_contact(robot, scene, q) is None for q in along)
    straight = np.linspace(start, goal, 20)
    assert any(deepest_contact(robot, scene, q) for q in straight)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"mesh": "package://my_arm/meshes/no.stl"}, r"mesh 'package://my_arm/meshes/no.stl' of"),
        ({"mesh": "https://somewhere.org/box.stl"}, "is on no disk; save it beside the URDF"),
        ({"data": b""}, "ends too early for an STL"),
        (
            {"data": b"v 0 0", "mesh": "package://my_arm/meshes/a.obj", "name": "a.obj"},
            "a.obj' ends too early; export it again",
        ),
        ({"data": bytes(84)}, "box.stl' is empty; export it again"),
        ({"data": b"solid x\nvertex 1 two 3\n"}, "is no STL"),
        ({"data": b"solid x\nvertex nan 1 1\nvertex 1 1 1\nvertex 1 1 2\n"}, "flat or not finite"),
        ({"data": b"solid x\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\n"}, "is flat or not finite"),
        (
            {"text": ARM.replace('lower="-2" upper="2.5"', 'lower="2.5" upper="-2"')},
            "joint shoulder of .* has the range 2.5 to -2; the second must be larger",
        ),
        (
            {"text": ARM.replace('lower="-2" upper="2.5"', 'lower="0" upper="0"')},
            "joint shoulder of .* has the range 0 to 0; the second must be larger",
        ),
        (
            {"text": ARM.replace('<mimic joint="grip"', '<mimic joint="gripp"')},
            "mimics 'gripp', which is not there; name one of its joints",
        ),
        ({"data": HOLED, "mesh": "package://my_arm/meshes/a.ply", "name": "a.ply"}, "not finite"),
        ({"text": "<robot"}, "is no XML"),
        ({"text": "<mujoco/>"}, "begins with <mujoco>; a URDF begins with <robot>"),
        (
            {"text": '<robot xmlns:xacro="http://x"><xacro:include filename="a"/></robot>'},
            "xacro macros; expand them first",
        ),
        (
            {"text": ARM.replace('"grip" type="prismatic"', '"grip" type="fixed"')},
            "joint follow .* mimics 'grip', which is fixed and moves nothing",
        ),
        ({"text": ARM.replace('"elbow"', '"shoulder"')}, "has two joints 'shoulder'; rename"),
    ],
)
def test_what_cannot_be_read_is_refused_in_one_sentence(tmp_path, settings, message):
    with pytest.raises(InputError, match=message) as raised:
        load_robot(package(tmp_path, **settings))
    assert "\n" not in str(raised.value)


def test_a_mesh_that_is_not_closed_collides_as_its_hull(tmp_path):
    robot = load_robot(package(tmp_path, stl(triangles(CORNERS)[:-2])))
    (part,) = (part for part in robot.parts if robot.bodies[part.body].name == "upper")
    assert len(part.vertices) == 8


def test_remedies_are_those_of_a_urdf(tmp_path):
    robot = load_robot(package(tmp_path))
    with pytest.raises(InputError, match=r'put acceleration="..." into each <limit> of its URDF$'):
        limits_of(robot)
    text = ARM.replace('effort="40"', "").replace("collision>", "visual>")
    robot = load_robot(package(tmp_path, text=text.replace("package://nowhere/base.dae", "MESH")))
    with pytest.raises(InputError, match=r'or put <limit effort="T"/> into its URDF$'):
        robot.at_rest_within(0.5)


def test_other_formats_need_trimesh_and_that_is_said(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "trimesh", None)
    path = package(tmp_path, b"", "box.dae", "package://my_arm/meshes/box.dae")
    with pytest.raises(
        InputError, match=r"neither STL nor OBJ; convert it, or .*pip install trimesh"
    ):
        load_robot(path)


def test_a_file_that_is_not_there_is_said_so(tmp_path):
    with pytest.raises(InputError, match=r"no URDF file at .*; check the path"):
        load_robot(tmp_path / "arm.urdf")


def test_links_without_collision_geometry_collide_as_they_look(tmp_path, caplog):
    text = ARM.replace("collision>", "visual>").replace("package://nowhere/base.dae", "MESH")
    robot = load_robot(package(tmp_path, text=text))
    assert len(robot.parts) == 6
    assert "what they look like is taken for it" in caplog.text


def test_an_inertia_that_no_body_can_have_is_no_obstacle(tmp_path):
    text = ARM.replace('izz="0.01" ixy="0"', 'izz="0.01" ixy="0.5"')
    robot = load_robot(package(tmp_path, text=text))
    np.testing.assert_allclose(robot.mj_model.body("upper").inertia, 0.01)


def test_macros_in_comments_and_limits_without_a_number_are_none(tmp_path):
    text = ARM.replace('<link name="world"/>', '<link name="world"/><!-- <xacro:x/> -->')
    robot = load_robot(package(tmp_path, text=text.replace('lower="-2"', 'lower=""')))
    assert [robot.joint_lower[0], robot.joint_upper[0]] == [0, 2.5]


@pytest.mark.parametrize("change", [bytes.upper, lambda data: b"  " + data])
def test_text_stls_are_read_however_they_are_written(tmp_path, change):
    data = change(text_stl(triangles(CORNERS)))
    plain = load_robot(package(tmp_path / "plain", text_stl(triangles(CORNERS))))
    part, other = (r.parts[1] for r in (plain, load_robot(package(tmp_path / "other", data))))
    np.testing.assert_allclose(np.sort(part.vertices, 0), np.sort(other.vertices, 0), atol=1e-6)
