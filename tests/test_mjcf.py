"""Arms as MJCF files have them: wherever their base is, whatever their contacts say, or refused."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from gnnjax.arm.kinematics import forward_kinematics
from gnnjax.arm.robot import load_robot
from gnnjax.collision.certify import certify_edges
from gnnjax.collision.checker import make_checker
from gnnjax.collision.clearances import configuration_clearance
from gnnjax.collision.fused import obstacles_clear
from gnnjax.errors import InputError
from gnnjax.guide.view import choose_points
from gnnjax.problems.family_problem import arm_reach, tip_positions
from gnnjax.scene.cloud import point_cloud
from gnnjax.scene.mujoco_world import build_world, obstacles, place_obstacles
from gnnjax.scene.scene import make_scene, scene_from_shapes
from gnnjax.scene.shapes import box

# A turned and lifted base, geoms in the world beside it, and a body in a frame.
BASE = 'pos="0.3 -0.2 0.5" quat="0.8 0.1 -0.5 0.3"'
ARM = """
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <default><geom contype="1" conaffinity="1" mass="1"/></default>
  <worldbody>
    <light pos="0 0 3"/>
    <geom type="sphere" size="0.05" pos="-0.4 0.3 0.2"/>
    <frame pos="0.5 0.5 0">
      <body name="box_0"><geom name="box_1" type="sphere" size="0.04"/></body>
    </frame>
    <body name="base" BASE>
      <geom type="sphere" size="0.1"/>
      <body name="upper" pos="0 0 0.1">
        <joint axis="0 0 1" range="-3 3"/>
        <geom name="shoulder" type="sphere" size="0.08" pos="0.15 0 0"/>
        <body name="middle" pos="0.35 0 0">
          <joint axis="0 1 0" range="-2.5 2.5" pos="0.02 0 0"/>
          <geom name="elbow" type="capsule" size="0.06" fromto="0 0 0 0.2 0 0.05"/>
          <body name="lower" pos="0.3 0 0" quat="1 0 0 1">
            <joint axis="0 0.6 0.8" range="-2 2"/>
            <geom name="tool" type="sphere" size="0.07" pos="0.15 0 0.02"/>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  CONTACT
</mujoco>
"""


def written(folder, change=lambda text: text, base=BASE, contact=""):
    path = folder / "arm.xml"
    path.write_text(change(ARM.replace("BASE", base).replace("CONTACT", contact)))
    return path


@pytest.fixture(scope="module")
def turned(tmp_path_factory):
    return load_robot(written(tmp_path_factory.mktemp("turned")))


@pytest.fixture(scope="module")
def configurations(turned):
    rng = np.random.default_rng(0)
    q = rng.uniform(turned.joint_lower, turned.joint_upper, (400, 3)).astype(np.float32)
    return np.clip(q, turned.joint_lower, turned.joint_upper)


def boxes_on_the_base(num=4):
    """Boxes seen from the base, as numbers and as a scene."""
    rng = np.random.default_rng(1)
    centers = rng.uniform(-0.7, 0.7, (num, 3))
    centers *= np.maximum(1, 0.45 / np.linalg.norm(centers, axis=1))[:, None]
    sizes, quats = rng.uniform(0.03, 0.15, (num, 3)), rng.normal(size=(num, 4))
    return (centers, sizes, quats), make_scene(centers, sizes, quats)


def engine_on_the_base(path, boxes):
    """The MJCF as it is, with boxes whose bodies MuJoCo itself puts on the arm's base."""
    spec = mujoco.MjSpec.from_file(str(path))
    for i, (center, size, quat) in enumerate(zip(*boxes, strict=True)):
        body = spec.body("base").add_body(name=f"on_base_{i}", pos=center, quat=quat)
        body.add_geom(
            name=f"obstacle_{i}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=size,
            contype=1,
            conaffinity=1,
        )
    model = spec.compile()
    return model, mujoco.MjData(model)


def least_distance(model, data, q, num_boxes):
    """Least distance [m] of moving geoms to the boxes on the base and to each other, by pairs."""
    data.qpos[:] = q
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    names = ["shoulder", "elbow", "tool"]
    others = [model.geom(f"obstacle_{i}").id for i in range(num_boxes)]
    pairs = [(model.geom(name).id, other) for name in names for other in others]
    fixed = [g for g in range(model.ngeom) if not model.body_weldid[model.geom_bodyid[g]]]
    own = [g for g in fixed if g not in others]
    # The shoulder's parent is the base, which counts as the world: MuJoCo pairs them.
    pairs += [(model.geom(name).id, g) for name in names for g in own]
    pairs += [(model.geom("shoulder").id, model.geom("tool").id)]
    return min(mujoco.mj_geomDistance(model, data, a, b, 9.0, None) for a, b in pairs)


@pytest.mark.parametrize("backend", ["kernel", "certificate", "mjx", "engine"])
def test_boxes_are_seen_from_the_base_wherever_it_stands(turned, configurations, backend):
    boxes, scene = boxes_on_the_base()
    model, data = engine_on_the_base(turned.path, boxes)
    q = configurations
    truth = np.array([least_distance(model, data, row, 4) for row in q])
    sure = np.abs(truth) > 1e-4
    assert 10 < (truth[sure] < 0).sum() < len(q) - 10
    if backend == "certificate":
        found = np.array([configuration_clearance(turned, scene, row) for row in q])
        free = truth > 0.02
        # Capsules are chains of spheres there, up to 8 mm thicker.
        assert (found[free] > 0).all()
        assert (found[truth < 0] <= 0).all()
        return
    if backend == "engine":
        world = build_world(turned, len(scene.mask))
        state = mujoco.MjData(world)
        place_obstacles(world, state, scene)
        found = []
        for state.qpos[:] in q:
            mujoco.mj_fwdPosition(world, state)
            found.append(not (state.contact.dist[: state.ncon] < 0).any())
        np.testing.assert_array_equal(np.array(found)[sure], truth[sure] > 0)
        return
    name = "fused" if backend == "kernel" else "mjx"
    checker = make_checker(turned, name)
    scene = jax.tree.map(jnp.asarray, scene)
    valid = np.asarray(jax.jit(checker.check_configurations)(scene, jnp.asarray(q)))
    if backend == "mjx":  # of the same chains of spheres
        sure &= (truth < 0) | (truth > 0.02)
    np.testing.assert_array_equal(valid[sure], truth[sure] > 0)


def test_edges_that_are_certified_are_free_where_the_base_is_turned(turned, configurations):
    boxes, scene = boxes_on_the_base()
    model, data = engine_on_the_base(turned.path, boxes)
    starts = configurations[:60]
    ends = np.clip(starts + 0.4, turned.joint_lower, turned.joint_upper)
    certified = certify_edges(turned, scene, starts, ends)
    assert 5 < certified.sum() < 55
    for start, end in zip(starts[certified], ends[certified], strict=True):
        along = start + np.linspace(0, 1, 100)[:, None] * (end - start)
        assert min(least_distance(model, data, row, 4) for row in along) > 0


def test_poses_pictures_and_the_reach_are_those_of_the_arm_on_the_floor(
    turned, configurations, tmp_path
):
    plain = load_robot(
        written(tmp_path, lambda text: text.replace('pos="-0.4 0.3 0.2"', 'pos="9 9 9"'), base="")
    )
    q = jnp.asarray(configurations[:5])
    for here, there in zip(
        forward_kinematics(turned, q), forward_kinematics(plain, q), strict=True
    ):
        # The first body stands in the world, which the base sees elsewhere.
        np.testing.assert_allclose(here[:, 1:], there[:, 1:], atol=1e-6)
    np.testing.assert_allclose(tip_positions(turned, q), tip_positions(plain, q), atol=1e-6)
    np.testing.assert_allclose(arm_reach(turned).center, arm_reach(plain).center, atol=1e-9)
    assert choose_points(turned, 3) == choose_points(plain, 3)
    np.testing.assert_allclose(
        turned.mj_model.opt.gravity, np.linalg.inv(rotation(turned)) @ [0, 0, -9.81], atol=1e-9
    )


def rotation(robot):
    model = mujoco.MjModel.from_xml_path(str(robot.path))
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, model.body("base").quat)
    return matrix.reshape(3, 3)


def test_geoms_of_the_world_are_seen_from_the_base(turned):
    # A box on the sphere that stands beside the base, given in the base's frame.
    place = rotation(turned).T @ (np.array([-0.4, 0.3, 0.2]) - [0.3, -0.2, 0.5])
    scene = jax.tree.map(jnp.asarray, make_scene([place, place + 1], [[0.02] * 3] * 2))
    home = jnp.asarray(turned.home)
    clear = obstacles_clear(turned, scene, home, base_only=True)
    np.testing.assert_array_equal(clear[:2], [False, True])


def test_a_base_that_a_joint_moves_or_two_arms_leave_the_world_as_it_is(tmp_path):
    lifted = load_robot(
        written(
            tmp_path,
            lambda t: t.replace(
                '<geom type="sphere" size="0.1"/>',
                '<joint axis="1 0 0" range="-1 1"/><geom type="sphere" size="0.1"/>',
            ),
        )
    )
    np.testing.assert_allclose(lifted.bodies[1].position, [0.3, -0.2, 0.5])


def test_names_that_obstacles_have_elsewhere_do_not_disturb_them(turned):
    scene = boxes_on_the_base()[1]
    world = build_world(turned, 10)
    data = mujoco.MjData(world)
    place_obstacles(world, data, scene)
    mujoco.mj_kinematics(world, data)
    found = obstacles(world, 10)
    np.testing.assert_allclose(data.geom_xpos[found.geoms[:4]], scene.centers[:4], atol=1e-6)


@pytest.mark.parametrize("place", ['pos="0 0 0.3" euler="0 0 70"', 'fromto="0 0 0 0 0 1"'])
def test_what_a_file_has_its_own_geoms_be_by_default_does_not_move_others(tmp_path, place):
    path = tmp_path / "defaults.xml"
    default = f'{place} group="3" margin="0.05" gap="0.05"'
    arm = '<body name="arm"><joint range="-1 1"/><geom size="0.1 0.1" type="capsule"/></body>'
    path.write_text(
        f"<mujoco><default><geom {default}/></default><worldbody>{arm}</worldbody></mujoco>"
    )
    held = load_robot(path).attach("arm", [box([0.2, 0.0, 1.0], [0.3, 0.05, 0.05])])
    ends = [[-0.1, -0.05, 0.95], [0.5, 0.05, 1.05]]
    spanned = [f(held.parts[-1].vertices, axis=0) for f in (np.min, np.max)]
    np.testing.assert_allclose(spanned, ends, atol=1e-6)
    cloud = point_cloud([[0.5, 0.0, 0.0]], 0.02)
    scene = scene_from_shapes([box([0.4, 0.0, 0.0], [0.1, 0.1, 0.1])], clouds=[cloud])
    world = build_world(load_robot(path), len(scene.mask), scene.cloud)
    data = mujoco.MjData(world)
    place_obstacles(world, data, scene)
    mujoco.mj_kinematics(world, data)
    first = obstacles(world, len(scene.mask)).geoms[0]
    np.testing.assert_allclose(data.geom_xpos[first], [0.4, 0, 0], atol=1e-6)
    of_cloud = slice(first - int(scene.cloud.num), first)
    points = scene.cloud.points[: int(scene.cloud.num)]
    np.testing.assert_allclose(data.geom_xpos[of_cloud], points, atol=1e-6)
    added = slice(of_cloud.start, None)
    np.testing.assert_allclose(
        data.geom_xmat[added],
        np.tile(np.eye(3).ravel(), (len(points) + len(scene.mask), 1)),
        atol=1e-12,
    )
    assert not world.geom_group[added].any()
    assert not world.geom_margin[added].any()


PAIRS = (
    '<contact><pair geom1="shoulder" geom2="elbow" margin="0.01"/>'
    '<exclude body1="upper" body2="lower"/><pair geom1="shoulder" geom2="tool"/></contact>'
)


@pytest.mark.parametrize("bits", [True, False])
def test_contact_pairs_count_whatever_bits_and_exclusions_say(tmp_path, configurations, bits):
    def without(text):
        return (
            text
            if bits
            else text.replace('contype="1" conaffinity="1"', 'contype="0" conaffinity="0"', 1)
        )

    # Farther apart than neighbours in the arm above, so that both outcomes occur.
    path = written(
        tmp_path,
        lambda t: without(t).replace('pos="0.15 0 0"/>', 'pos="0.2 0.1 0.06"/>'),
        contact=PAIRS,
    )
    robot = load_robot(path)
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    truth = []
    for data.qpos[:] in configurations:
        mujoco.mj_fwdPosition(model, data)
        truth.append(min(data.contact.dist[: data.ncon], default=1.0))
    truth = np.array(truth)
    sure = np.abs(truth) > 1e-4
    assert 20 < (truth < 0).sum() < 380
    scene = jax.tree.map(jnp.asarray, make_scene([], []))
    check = jax.jit(make_checker(robot).check_configurations)
    valid = np.asarray(check(scene, jnp.asarray(configurations)))
    np.testing.assert_array_equal(valid[sure], truth[sure] > 0)
    for q in configurations[truth <= 0]:
        assert configuration_clearance(robot, scene, q) <= 0
    # They meet obstacles, too, in the C engine's world as in the kernel.
    tip = np.asarray(tip_positions(robot, jnp.asarray(configurations[:1])))[0]
    scene = make_scene([tip], [[0.05] * 3])
    world = build_world(robot, 10)
    state = mujoco.MjData(world)
    place_obstacles(world, state, scene)
    state.qpos[:] = configurations[0]
    mujoco.mj_fwdPosition(world, state)
    boxes = obstacles(world, 10).geoms
    assert np.isin(state.contact.geom[: state.ncon], boxes).any()
    scene = jax.tree.map(jnp.asarray, scene)
    assert not check(scene, jnp.asarray(configurations))[0]


def contacts_with_a_box_at_the_tip(robot):
    """How many contacts the C engine finds, at zero."""
    tip = np.asarray(tip_positions(robot, jnp.zeros((1, 3))))[0]
    world = build_world(robot, 1)
    data = mujoco.MjData(world)
    place_obstacles(world, data, make_scene([tip], [[0.05] * 3], max_obstacles=1))
    mujoco.mj_fwdPosition(world, data)
    return data.ncon


def test_flags_that_hide_contacts_do_not_hide_them_from_the_c_engine(tmp_path):
    option = '<option><flag contact="disable"/></option>'
    path = written(tmp_path, lambda t: t.replace("<default>", option + "<default>"))
    robot = load_robot(path)
    assert contacts_with_a_box_at_the_tip(robot)


def test_a_geom_with_the_last_bit_alone_meets_obstacles(tmp_path):
    bits = 'contype="-2147483648" conaffinity="-2147483648"'
    robot = load_robot(written(tmp_path, lambda t: t.replace('contype="1" conaffinity="1"', bits)))
    assert contacts_with_a_box_at_the_tip(robot)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('range="-3 3"', 'range="-inf inf"', r"joint number 0 .* has the range -inf to inf"),
        ('range="-3 3"', 'range="-3 1e30"', r"has the range -3 to 1e\+30"),
        ('range="-3 3"', 'range="1 1.00000001"', r"has the range 1 to 1; the second must be"),
        ('axis="0 1 0"', 'axis="0 nan 0"', "jnt_axis of .* holds nan"),
        ('pos="0.35 0 0"', 'pos="0.35 nan 0"', "body_pos of .* holds nan"),
        ('pos="0.35 0 0"', 'pos="0.35 1e7 0"', "body_pos of .* holds 10000000.0; all of an arm's"),
        (BASE, 'pos="inf 0 0"', "body_pos of .* holds inf"),
        ('range="-2 2"', 'range="-2 2" ref="nan"', "qpos0 of .* holds nan"),
        ('"0.15 0 0.02"', '"0.15 nan 0.02"', "geom_pos of .* holds nan"),
    ],
)
def test_numbers_that_nothing_can_be_computed_with_are_refused(
    tmp_path, monkeypatch, capfd, old, new, message
):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=message):
        load_robot(written(tmp_path, lambda text: text.replace(old, new, 1)))
    # Nothing of MuJoCo's own, neither in the terminal nor in the folder.
    assert capfd.readouterr().err == ""
    assert [file.name for file in tmp_path.iterdir()] == ["arm.xml"]


@pytest.mark.parametrize(
    ("home", "message"),
    [
        ("0 nan 0", "keyframe home of .* has nan for joint number 1; it must lie between -2.5 and"),
        ("3.2 0 0", "has 3.2.* for joint number 0"),
        ("0 0 -inf", "has -inf for joint number 2"),
    ],
)
def test_a_home_that_is_no_configuration_is_refused(tmp_path, home, message):
    key = f'<keyframe><key name="home" qpos="{home}"/></keyframe>'
    with pytest.raises(InputError, match=message):
        load_robot(written(tmp_path, contact=key))
