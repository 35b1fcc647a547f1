"""Arms of all kinds: parts of any shape, joints that are held, pairs that always touch."""

import ast
import inspect
import logging
import re

import mujoco
import numpy as np
import pytest

from gnnjax.arm.robot import load_robot
from gnnjax.arm.shipped import assets_dir
from gnnjax.errors import InputError
from gnnjax.scene.from_mjcf import scene_from_mjcf
from gnnjax.scene.own_points import distances_to_hull
from gnnjax.scene.shapes import box
from tests.gripper import EQUALITY, same_poses, written


def test_what_is_attached_from_a_file_with_other_units_is_held_where_it_stands(tmp_path):
    written(tmp_path, change=lambda text: text.replace('"radian"', '"radian" eulerseq="zyx"'))
    path = tmp_path / "whole.xml"
    path.write_text(
        '<mujoco><compiler angle="degree"/><asset><model name="other" file="gripper.xml"/></asset>'
        '<worldbody><body name="stand">'
        '<attach model="other" body="base" prefix="its_"/></body></worldbody></mujoco>'
    )
    held = {"its_bend": -1.0, "its_slip": 0.05, "its_left": 0.01, "its_right": 0.02}
    robot = load_robot(path, hold=held)
    assert same_poses(robot, robot.held, "its_")
    np.testing.assert_allclose([robot.joint_lower, robot.joint_upper], [[-2 * np.pi], [2 * np.pi]])


def test_joints_are_asked_for_by_name_and_the_same_arguments_give_the_same_arm(tmp_path):
    path = written(tmp_path)
    first = load_robot(path, joints=["turn", "bend"], hold={"slip": 0.0}, allow=[("arm", "left")])
    again = load_robot(
        str(path), joints=("turn", "bend"), hold={"slip": 0.0}, allow=(("arm", "left"),)
    )
    assert first is again
    assert first is not load_robot(path)
    # In a notebook, say, while the file is worked on.
    path.write_text(path.read_text().replace('"-2 2"', '"-2.5 2"'))
    edited = load_robot(path, joints=["turn", "bend"], hold={"slip": 0.0}, allow=[("arm", "left")])
    assert (edited.joint_lower != first.joint_lower).any()


WEDGE = "v 0 0 0\nv .1 0 0\nv 0 .1 0\nv 0 0 .1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4"
MESHED = """<mujoco><compiler meshdir="meshes"/><asset><mesh name="wedge" file="wedge.obj"/></asset>
<worldbody><body name="base"><body name="arm"><joint range="-90 90"/>
<geom type="mesh" mesh="wedge"/></body></body></worldbody></mujoco>"""


def meshed(folder, how):
    """The file of an arm with a mesh, which itself, a file that it includes, or one that is
    attached names, and that of the mesh."""
    (folder / "inner" / "meshes").mkdir(parents=True)
    inner = folder / "inner" / "arm.xml"
    path = {"file": inner}.get(how, folder / "arm.xml")
    inner.write_text(MESHED)
    if how == "include":
        path.write_text('<mujoco><include file="inner/arm.xml"/></mujoco>')
        bare = MESHED.replace('<compiler meshdir="meshes"/>', "")
        inner.write_text(bare.replace("wedge.obj", "meshes/wedge.obj"))
    if how == "model":
        model = '<asset><model name="other" file="inner/arm.xml"/></asset>'
        attached = '<attach model="other" body="base" prefix="its_"/>'
        path.write_text(f"<mujoco>{model}<worldbody>{attached}</worldbody></mujoco>")
    mesh = folder / "inner" / "meshes" / "wedge.obj"
    mesh.write_text(WEDGE)
    return path, mesh


@pytest.mark.parametrize("how", ["file", "include", "model"])
def test_meshes_of_an_mjcf_are_whole_and_read_anew_once_edited(tmp_path, how):
    path, mesh = meshed(tmp_path, how)
    first = load_robot(path)
    assert load_robot(path) is first
    mesh.write_text(WEDGE.replace("v .1 0 0", "v .25 0 0"))
    assert load_robot(path).parts[0].vertices.max() == pytest.approx(0.25)
    inner = tmp_path / "inner" / "arm.xml"
    inner.write_text(inner.read_text().replace("-90 90", "-60 90"))
    assert load_robot(path).joint_lower[0] == pytest.approx(-np.pi / 3)
    mesh.write_text(WEDGE[:-2])
    for read in (load_robot, scene_from_mjcf):
        with pytest.raises(InputError, match=r"wedge.obj' of .*arm.xml' ends too early; export it"):
            read(path)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"joints": ["turn", "elbow"]}, "no joint 'elbow' in .*; there are .*'turn', 'bend'"),
        ({"hold": {"elbow": 0.0}}, "no joint 'elbow'"),
        ({"joints": ["bend", "turn"]}, r"name each once, in the order \['turn', 'bend'\]"),
        ({"joints": ["turn", "turn"]}, "name each once"),
        ({"joints": []}, "joints is .*; name those to plan for, of"),
        ({"joints": ["turn"], "hold": {"turn": 0.0}}, "'turn' is to be planned for and held"),
        ({"hold": {"left": 0.05}}, "'left' is to be held at 0.05; it must lie between 0 and 0.04"),
        ({"hold": {"left": float("nan")}}, "is to be held at nan"),
        ({"joints": ["left", "right"]}, "'right' of .* follows 'left'; plan for one of them"),
        ({"joints": ["turn", "left"]}, "'left' of .* is coupled to 'right', which planning would"),
        ({"hold": {"turn": 0.0, "bend": 0.0, "slip": 0.0}}, "all joints of .* are held or coupled"),
        ({"joints": "turn"}, "joints is 'turn'; give a list of names"),
        ({"hold": {"left": "0.01"}}, "hold is .*'0.01'.*; give numbers by names"),
        ({"allow": ("arm", "hand")}, "allow is .*; give pairs of names of bodies"),
        ({"allow": [("arm", "elbow")]}, "no body 'elbow' in .* to allow; there are .*'hand'"),
    ],
)
def test_joints_and_bodies_that_do_not_fit_are_refused(tmp_path, settings, message):
    with pytest.raises(InputError, match=message):
        load_robot(written(tmp_path), **settings)


def test_a_joint_without_limits_gets_a_turn_either_way(tmp_path, caplog):
    path = written(tmp_path, change=lambda text: text.replace("0.1 0.5 0.02", "3.5 0.5 0.02"))
    robot = load_robot(path)
    np.testing.assert_allclose(
        [robot.joint_lower[0], robot.joint_upper[0]], [-2 * np.pi, 2 * np.pi]
    )
    np.testing.assert_allclose([robot.drawn_lower[0], robot.drawn_upper[0]], [-np.pi, np.pi])
    np.testing.assert_allclose(robot.home[0], 3.5 - 2 * np.pi, atol=1e-6)
    assert "start and goal, which may be a turn away: turn" in caplog.text
    degrees = written(
        tmp_path, change=lambda text: text.replace("radian", "degree").replace("0.1 0.5", "0 0")
    )
    again = load_robot(degrees.rename(tmp_path / "degrees.xml"))
    np.testing.assert_allclose(
        [again.joint_lower[0], again.joint_upper[0]], [-2 * np.pi, 2 * np.pi]
    )


def test_a_slide_without_limits_is_held_and_that_is_said(tmp_path):
    slide = '<body name="cart"><joint name="drive" type="slide" axis="1 0 0"/><geom size="0.01"/>'
    turn = '<body><joint name="turn" axis="0 0 1" range="-90 90"/><geom size="0.1"/></body>'
    for name, links in (("cart", slide + turn), ("alone", slide)):
        text = f"<mujoco><worldbody>{links}</body></worldbody></mujoco>"
        (tmp_path / f"{name}.xml").write_text(text)
    robot = load_robot(tmp_path / "cart.xml")
    assert robot.joint_names == ("turn",)
    assert robot.held == {"drive": 0.0}
    assert "slides without limits are held where they are: drive" in robot.notes
    further = load_robot(tmp_path / "cart.xml", hold={"drive": 2.0})
    assert further.held == {"drive": 2.0}
    assert not [note for note in further.notes if "without limits" in note]
    endless = r"joint drive of .* has no limits; give it range=.*, or hold it"
    with pytest.raises(InputError, match=endless):
        load_robot(tmp_path / "cart.xml", joints=["drive", "turn"])
    with pytest.raises(InputError, match=endless):
        load_robot(tmp_path / "alone.xml")


def test_a_floor_is_no_part_of_the_arm_and_that_is_said(tmp_path, caplog):
    robot = load_robot(written(tmp_path))
    assert "no part of the arm, and left out: plane floor; put it into the scene" in caplog.text
    assert all(note in caplog.text for note in robot.notes)
    assert not (robot.mj_model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE).any()


def test_torque_and_acceleration_limits_are_those_of_the_file(tmp_path):
    numeric = '<custom><numeric name="acceleration_limit" data="DATA"/></custom>'
    robot = load_robot(written(tmp_path, EQUALITY + numeric.replace("DATA", "1 2 3 4 5")))
    np.testing.assert_allclose(robot.torque_limit, [50, 30, 7])
    np.testing.assert_allclose(robot.acceleration_limit, [1, 2, 3])
    assert robot.velocity_limit is None
    few = written(tmp_path, EQUALITY + numeric.replace("DATA", "1 2"))
    with pytest.raises(
        InputError, match=r"acceleration_limit in .* is .*; it needs 5 or 3 positive"
    ):
        load_robot(few.rename(tmp_path / "few.xml"))
    weak = written(tmp_path, change=lambda text: text.replace(' forcerange="-7 7"', ""))
    assert load_robot(weak.rename(tmp_path / "weak.xml")).torque_limit is None


def test_limits_of_the_joints_that_are_planned_by_default_are_those_of_a_choice_too(tmp_path):
    numeric = '<custom><numeric name="velocity_limit" data="1 2 3"/></custom>'
    path = written(tmp_path, EQUALITY + numeric)
    for choice, expected in (
        ({}, [1, 2, 3]),
        ({"hold": {"bend": 0.0}}, [1, 3]),
        ({"joints": ["bend"]}, [2]),
        ({"hold": {"turn": 0.0}, "joints": ["bend", "slip"]}, [2, 3]),
    ):
        np.testing.assert_allclose(load_robot(path, **choice).velocity_limit, expected)
    # A finger is not among those.
    chosen = {"joints": ["turn", "left"], "hold": {"right": 0.01}}
    assert load_robot(path, **chosen).velocity_limit is None
    with pytest.raises(InputError, match="it needs 5 or 3 or 1 positive numbers"):
        load_robot(written(tmp_path, EQUALITY + numeric.replace("1 2 3", "1 2")), joints=["turn"])


@pytest.mark.parametrize(
    "choice", [{"hold": {"joint_2": 0}}, {"joints": ["joint_1", "joint_3", "joint_7"]}]
)
def test_joints_of_a_shipped_arm_can_be_chosen(choice):
    robot, whole = load_robot("franka_panda", **choice), load_robot("franka_panda")
    rows = [whole.joint_names.index(name) for name in robot.joint_names]
    np.testing.assert_array_equal(robot.velocity_limit, whole.velocity_limit[rows])
    np.testing.assert_array_equal(robot.acceleration_limit, whole.acceleration_limit[rows])


def test_an_arm_on_a_free_base_is_planned_for_by_its_named_joints(tmp_path):
    path = written(
        tmp_path,
        change=lambda text: (
            text.replace('<body name="base">', '<body name="base"><freejoint/>')
            .replace("<keyframe>", "<!--")
            .replace("</keyframe>", "-->")
        ),
    )
    with pytest.raises(InputError, match=r"free or ball joint; .* joints=\[\.\.\.\]"):
        load_robot(path)
    robot = load_robot(path, joints=["turn", "bend"])
    assert robot.num_dof == robot.mj_model.nq == 2


def supports(vertices, radius, normals):
    return (normals @ vertices.T).max(axis=1) + radius


@pytest.mark.parametrize(
    "geom",
    [
        'type="sphere" size="0.07"',
        'type="capsule" size="0.03 0.1"',
        'type="box" size="0.03 0.1 0.06"',
        'type="cylinder" size="0.06 0.1"',
        'type="cylinder" size="0.3 0.1"',
        'type="ellipsoid" size="0.06 0.1 0.02"',
    ],
)
def test_parts_enclose_their_geoms_and_stand_out_by_less_than_half_a_millimetre(tmp_path, geom):
    path = tmp_path / "arm.xml"
    path.write_text(
        '<mujoco><worldbody><body pos="1 2 3"><joint range="-9 9" limited="true"/>'
        f'<geom {geom} pos="0.1 0.2 0.3" euler="10 20 30"/></body></worldbody></mujoco>'
    )
    robot = load_robot(path)
    (part,), model = robot.parts, robot.mj_model
    normals = np.random.default_rng(0).normal(size=(4000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    found = supports(part.vertices - model.geom_pos[0], part.radius, normals)
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, model.geom_quat[0])
    x, y, z = (normals @ matrix.reshape(3, 3)).T
    a, b, c = model.geom_size[0]
    truth = {
        mujoco.mjtGeom.mjGEOM_SPHERE: a + 0 * x,
        mujoco.mjtGeom.mjGEOM_CAPSULE: a + b * np.abs(z),
        mujoco.mjtGeom.mjGEOM_BOX: np.abs([a * x, b * y, c * z]).sum(axis=0),
        mujoco.mjtGeom.mjGEOM_CYLINDER: a * np.hypot(x, y) + b * np.abs(z),
        mujoco.mjtGeom.mjGEOM_ELLIPSOID: np.sqrt((a * x) ** 2 + (b * y) ** 2 + (c * z) ** 2),
    }[mujoco.mjtGeom(model.geom_type[0])]
    assert (found > truth - 1e-9).all()
    assert (found < truth + 5e-4).all()


@pytest.mark.parametrize("num", [8, 40])
def test_parts_of_meshes_enclose_what_mujoco_collides(tmp_path, num):
    # With fewer vertices in its hull than the mesh has; MuJoCo leaves them out of large ones alone.
    corners = np.random.default_rng(num).normal(size=(num, 3)) / 10
    path = tmp_path / f"mesh_{num}.xml"
    path.write_text(
        f"<mujoco><asset><mesh name='m' maxhullvert='5' vertex='{' '.join(map(str, corners.flat))}'"
        "/></asset><worldbody><body><joint range='-9 9' limited='true'/>"
        "<geom type='mesh' mesh='m' pos='0.1 0 0'/></body>"
        "<body name='ball' mocap='true'><geom size='0.01' contype='0' conaffinity='0'/></body>"
        "</worldbody></mujoco>"
    )
    (part,) = (robot := load_robot(path)).parts
    model, data = robot.mj_model, mujoco.MjData(robot.mj_model)
    for place in np.random.default_rng(0).normal(size=(50, 3)):
        data.mocap_pos[0] = place
        mujoco.mj_kinematics(model, data)
        line = np.zeros(6)
        away = mujoco.mj_geomDistance(model, data, 0, 1, 9.0, line)
        nearest = distances_to_hull(part.vertices, line[None, :3])[0]
        assert away > 0
        assert nearest < 1e-6


BRICKS = """
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <default><geom mass="1" BITS/></default>
  <worldbody>
    <body name="base"><geom name="foot" type="box" size="0.1 0.1 0.05"/>
      <body name="upper" pos="0 0 GAP"><joint axis="0 0 1" range="-3 3"/>
        <geom name="beam" type="box" size="0.05 0.05 0.2" pos="0 0 0.2"/>
        <body name="middle" pos="0 0 0.42"><joint axis="0 1 0" range="-2 2"/>
          <geom name="cuff" type="box" size="0.03 0.03 0.03"/>
          <body name="lower" pos="0 0 LOW"><joint axis="0 0 1" range="-3 3"/>
            <geom name="tip" type="box" size="0.03 0.03 0.1"/>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


def bricks(folder, gap=0.052, low=0.15, bits="", more=""):
    path = folder / "bricks.xml"
    text = BRICKS.replace("GAP", str(gap)).replace("LOW", str(low)).replace("BITS", bits)
    path.write_text(text.replace("</mujoco>", f"{more}</mujoco>"))
    return path


def paired(robot):
    return {frozenset(robot.parts[p].name for p in pair) for pair in robot.part_pairs.tolist()}


def test_links_that_always_touch_may_and_that_is_said(tmp_path, caplog):
    robot = load_robot(bricks(tmp_path, gap=0.03, low=0.0))
    assert robot.allowed_pairs == (("foot", "beam"), ("beam", "tip"))
    assert "parts that always touch, or do at home, may: foot and beam, beam and tip" in caplog.text
    assert paired(robot) == {frozenset(x) for x in (("foot", "cuff"), ("foot", "tip"))}
    # MuJoCo's engine judges likewise.
    data = mujoco.MjData(robot.mj_model)
    mujoco.mj_forward(robot.mj_model, data)
    assert data.ncon == 0


def test_the_first_link_need_not_keep_clear_of_the_base_that_it_never_reaches(tmp_path):
    robot = load_robot(bricks(tmp_path))
    assert robot.allowed_pairs == ()
    assert paired(robot) == {
        frozenset(x) for x in (("foot", "cuff"), ("foot", "tip"), ("beam", "tip"))
    }
    # It does reach it where it may tilt.
    path = bricks(tmp_path, gap=0.08)
    path.write_text(
        path.read_text().replace('axis="0 0 1" range="-3 3"', 'axis="1 0 0" range="-3 3"', 1)
    )
    assert frozenset(("foot", "beam")) in paired(load_robot(path.rename(tmp_path / "tilts.xml")))


def test_links_between_which_a_joint_is_held_are_kept_apart_as_before(tmp_path):
    path = bricks(tmp_path)
    assert frozenset(("beam", "tip")) in paired(load_robot(path))
    robot = load_robot(path, hold={"number 2": 0.0})  # by which the tip is one with the cuff
    assert paired(robot) == {
        frozenset(x) for x in (("foot", "cuff"), ("foot", "tip"), ("beam", "tip"))
    }
    # Where these always touch, they may, and MuJoCo's engine judges likewise.
    robot = load_robot(bricks(tmp_path, low=0.0), hold={"number 2": 0.0})
    assert robot.allowed_pairs == (("beam", "tip"),)
    data = mujoco.MjData(robot.mj_model)
    mujoco.mj_forward(robot.mj_model, data)
    assert data.ncon == 0


def test_links_that_touch_at_the_home_of_the_file_may(tmp_path):
    home = '<keyframe><key name="home" qpos="0 2 0"/></keyframe>'
    shape = {"low": 0.12, "more": home}
    path = bricks(tmp_path, **shape)
    path.write_text(
        path.read_text().replace('range="-2 2"', 'range="-2.8 2.8"').replace("0 2 0", "0 2.7 0")
    )
    assert ("beam", "tip") in load_robot(path).allowed_pairs


def test_bodies_may_be_allowed_to_touch(tmp_path):
    robot = load_robot(bricks(tmp_path), allow=[("lower", "upper"), ("base", "middle")])
    assert paired(robot) == {frozenset(("foot", "tip"))}
    rows = {frozenset(robot.sphere_parts[pair].tolist()) for pair in robot.sphere_pairs}
    assert rows == {frozenset(pair) for pair in robot.part_pairs.tolist()}


def test_bits_that_pair_no_links_do_not_hide_the_arm_from_itself(tmp_path, caplog):
    robot = load_robot(bricks(tmp_path, bits='contype="0" conaffinity="1"'))
    assert len(paired(robot)) == 3
    assert "contype and conaffinity let no two links meet" in caplog.text
    assert (robot.mj_model.geom_contype == 1).all()


def test_an_arm_that_can_but_collide_with_itself_is_refused_with_the_remedy(tmp_path):
    # Of seven links some two always meet, and hardly ever the same.
    path = tmp_path / "tangle.xml"
    link = (
        '<body name="NAME"><joint type="slide" axis="1 0 0" range="-1 1"/>'
        '<geom type="box" size="0.9 0.1 0.1" mass="1"/></body>'
    )
    links = "".join(link.replace("NAME", name) for name in ("a", "b", "c", "d", "e", "f", "g"))
    base = '<body name="base"><geom size="0.1"/></body>'
    path.write_text(f"<mujoco><worldbody>{base}{links}</worldbody></mujoco>")
    with pytest.raises(InputError, match="collides with itself in all of 2000") as refused:
        load_robot(path)
    # The bodies that meet most, to be given as they are.
    (often,) = re.findall(r"allow=(\[.*\]), or exclude them", str(refused.value))
    assert all(set(two) < set("abcdefg") for two in ast.literal_eval(often))


def test_shipped_arms_have_the_spheres_that_are_shipped(caplog):
    for name in ("kuka_iiwa14", "franka_panda", "kinova_gen3"):
        robot = load_robot(name)
        fingers = ["finger_joint_1", "finger_joint_2"] if name == "franka_panda" else []
        assert list(robot.held) == fingers
        assert len(robot.notes) == bool(fingers)
        assert robot.allowed_pairs == ()
        with np.load(assets_dir() / f"{name}_cover.npz") as kept:
            radii = np.concatenate([kept[part.name][:, 3] for part in robot.parts])
        np.testing.assert_allclose(robot.sphere_radii, radii, atol=2e-6)
        inner, outer = robot.sphere_inner_radii, robot.sphere_radii
        assert 0.8 < (inner < outer).mean()  # one sphere is a point inside
    assert not [record for record in caplog.records if record.levelno >= logging.WARNING]


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"joints": [1, 2]}, r"joints is \[1, 2\]; give a list of names"),
        ({"joints": 5}, "joints is 5; give a list of names"),
        ({"hold": {1: 0.1, "a": 0.2}}, "hold is .*; give numbers by names"),
        ({"hold": {"joint_1": 10**400}}, "hold is .*; give numbers by names"),
        ({"allow": 5}, "allow is 5; give pairs of names"),
    ],
)
def test_what_is_no_choice_of_joints_is_refused(given, message):
    with pytest.raises(InputError, match=message):
        inspect.unwrap(load_robot)("kuka_iiwa14", **given)  # whatever the types are


@pytest.mark.filterwarnings("ignore:compiler attribute")  # MuJoCo is about to drop it
def test_masses_that_the_file_scales_to_a_total_stay_where_things_are_added(tmp_path):
    path = tmp_path / "heavy.xml"
    path.write_text(
        '<mujoco><compiler settotalmass="6"/><worldbody><body><joint range="-90 90"/>'
        '<inertial mass="1" pos="0 0 0" fullinertia="1 1 1 0.1 0 0"/>'
        '<geom size="0.1"/><body name="hand" pos="0.5 0 0"><joint range="-90 90"/>'
        '<geom size="0.1"/></body></body></worldbody></mujoco>'
    )
    robot = load_robot(path)
    held = robot.attach("hand", [box([0.2, 0, 0], [0.05, 0.05, 0.05])], mass=2.0)
    ball = 4000 / 3 * np.pi * 0.1**3  # kg, as the second link has none of its own
    masses = 6 / (1 + ball) * np.array([0, 1, ball])
    np.testing.assert_allclose(robot.mj_model.body_mass, masses)
    np.testing.assert_allclose(held.mj_model.body_mass, [*masses, 2])
