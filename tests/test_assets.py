"""The arms in assets/ have the published figures, and kinematics done again in NumPy."""

import mujoco
import numpy as np
import pytest

from gnnjax.arm.robot import load_robot
from tests.published_arms import (
    ARMS,
    OPENINGS,
    QUARTER,
    ROOT,
    TOOLS,
    hull_distance,
    kept_pairs,
    place,
    rotation,
)


@pytest.fixture(scope="module", params=list(ARMS))
def arm(request):
    return request.param


@pytest.fixture(scope="module")
def links(arm):
    return ARMS[arm]


@pytest.fixture(scope="module")
def model(arm):
    return mujoco.MjModel.from_xml_path(str(ROOT / "assets" / f"{arm}.xml"))


@pytest.fixture(scope="module")
def robot(arm):
    return load_robot(arm)


def test_bodies_and_inertias_are_the_published_ones(model, links):
    assert [model.body(b).name for b in range(1, model.nbody)] == [link.name for link in links]
    for link in links:
        body = model.body(link.name)
        np.testing.assert_allclose(body.mass, link.mass, err_msg=link.name)
        np.testing.assert_allclose(body.ipos, link.com, atol=1e-9, err_msg=link.name)
        turn = rotation(body.iquat)  # MuJoCo may sort the principal axes
        inertia = turn @ np.diag(body.inertia) @ turn.T
        xx, yy, zz, xy, xz, yz = (*link.inertia, 0, 0, 0)[:6]
        expected = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        np.testing.assert_allclose(inertia, expected, atol=1e-9, err_msg=link.name)


def test_joints_have_the_published_limits(model, links):
    moving = [link for link in links if link.limit or link.opens]
    turning = [link for link in links if link.limit]
    assert model.njnt == len(moving)
    limits = [
        link.opens or (link.limit if isinstance(link.limit, tuple) else (-link.limit, link.limit))
        for link in moving
    ]
    np.testing.assert_allclose(model.jnt_range, limits, atol=1e-6)
    assert model.jnt_limited.all()
    slides = model.jnt_type == mujoco.mjtJoint.mjJNT_SLIDE
    assert slides.tolist() == [link.opens is not None for link in moving]
    assert (slides | (model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE)).all()
    np.testing.assert_array_equal(model.jnt_axis, np.where(slides[:, None], [0, 1, 0], [0, 0, 1]))
    np.testing.assert_allclose(
        model.numeric("velocity_limit").data, [link.velocity for link in turning]
    )
    torque = np.array([link.torque for link in turning])
    ranges = np.stack([-torque, torque], 1)
    np.testing.assert_allclose(model.actuator_forcerange[: len(turning)], ranges)
    # One motor drives both fingers.
    assert model.nu == len(turning) + any(slides)
    np.testing.assert_array_equal(model.actuator_trnid[:, 0], np.arange(model.nu))


def test_forward_kinematics_agree_with_numpy(arm, model, links):
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    for q in rng.uniform(*model.jnt_range.T, size=(200, model.njnt)):
        place(model, data, q)
        frames, before, angles = {"": (np.zeros(3), np.eye(3))}, "", iter(q)
        for link in links:
            position, turn = frames[link.parent or before]
            position = position + turn @ np.asarray(link.pos)
            turn = turn @ rotation(link.turn)
            if link.limit:
                turn = turn @ rotation((0, 0, next(angles)))
            if link.opens:
                position = position + turn @ (0, next(angles), 0)
            frames[link.name], before = (position, turn), link.name
            body = data.body(link.name)
            np.testing.assert_allclose(body.xpos, position, atol=1e-5, err_msg=link.name)
            np.testing.assert_allclose(body.xmat.reshape(3, 3), turn, atol=1e-5)
        last, offset, tool_turn = TOOLS[arm]
        position, turn = frames[last]
        np.testing.assert_allclose(data.site("tool").xpos, position + turn @ offset, atol=1e-5)
        np.testing.assert_allclose(
            data.site("tool").xmat.reshape(3, 3), turn @ rotation(tool_turn), atol=1e-5
        )


def test_flange_of_the_panda_agrees_with_its_dh_parameters():
    """Modified (Craig's) parameters a, d and alpha, as in the manufacturer's documentation."""
    table = (
        (0, 0.333, 0),
        (0, 0, -QUARTER),
        (0, 0.316, QUARTER),
        (0.0825, 0, QUARTER),
        (-0.0825, 0.384, -QUARTER),
        (0, 0, QUARTER),
        (0.088, 0, QUARTER),
        (0, 0.107, 0),
    )
    model = mujoco.MjModel.from_xml_path(str(ROOT / "assets" / "franka_panda.xml"))
    data, rng = mujoco.MjData(model), np.random.default_rng(2)
    samples = rng.uniform(*model.jnt_range.T, size=(50, model.njnt))
    for q in (model.key("home").qpos, *samples):
        pose = np.eye(4)
        for (a, d, alpha), theta in zip(table, (*q[:7], 0.0), strict=True):
            (c, s), (ca, sa) = (np.cos(theta), np.sin(theta)), (np.cos(alpha), np.sin(alpha))
            pose = pose @ [
                [c, -s, 0, a],
                [s * ca, c * ca, -sa, -d * sa],
                [s * sa, c * sa, ca, d * ca],
                [0, 0, 0, 1],
            ]
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        flange = data.site("flange")
        np.testing.assert_allclose(flange.xpos, pose[:3, 3], atol=1e-9)
        np.testing.assert_allclose(flange.xmat.reshape(3, 3), pose[:3, :3], atol=1e-9)
        hand = pose[:3, :3] @ rotation((0, 0, -np.pi / 4))
        np.testing.assert_allclose(data.body("hand").xmat.reshape(3, 3), hand, atol=1e-9)
        np.testing.assert_allclose(
            data.site("tool").xpos, pose[:3, 3] + 0.1034 * pose[:3, 2], atol=1e-9
        )


def test_home_is_free_and_within_limits(model, robot, links):
    home = model.key("home").qpos
    assert (home >= model.jnt_range[:, 0]).all()
    assert (home <= model.jnt_range[:, 1]).all()
    np.testing.assert_allclose(model.key("home").ctrl, home[model.actuator_trnid[:, 0]])
    np.testing.assert_allclose(robot.home, home[: robot.num_dof], atol=1e-6)
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("home").id)
    mujoco.mj_forward(model, data)
    assert data.ncon == 0
    for pair in kept_pairs(model, links):
        assert hull_distance(model, data, pair) > 0.05, pair


@pytest.mark.parametrize(
    "q",
    [
        (0, 0, 0, -1.5708, 0, 1.5708, -0.7853),  # upright, forearm level
        (0, 0.6, 0, -1.2, 0, 1.8, 0.785),  # reaching forward
        (1.57, -0.4, 0, -2.4, 0, 2.0, 0.785),  # turned to the side
        (0, 0.3, 0, -2.0, 0, 2.3, 0.785),  # the hand down at a table
        (0.5, -0.5, 1.2, -2, 0.4, 1.6, -1),  # the elbow out
    ],
)
def test_ordinary_poses_of_the_panda_are_free(q):
    model = mujoco.MjModel.from_xml_path(str(ROOT / "assets" / "franka_panda.xml"))
    data = mujoco.MjData(model)
    for opening in OPENINGS[1:]:
        data.qpos[:] = *q, opening, opening
        mujoco.mj_forward(model, data)
        assert data.ncon == 0
