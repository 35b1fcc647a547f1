"""Points on the arm itself, against MuJoCo's distances."""

import mujoco
import numpy as np
import pytest

from gnnjax.arm.robot import load_robot
from gnnjax.errors import InputError
from gnnjax.scene.own_points import distances_to_hull, without_robot
from gnnjax.scene.scene_file import scene_from_json
from gnnjax.scene.shapes import box
from tests.arms import CRANE


@pytest.fixture(scope="module")
def crane(tmp_path_factory):
    path = tmp_path_factory.mktemp("robots") / "crane.xml"
    path.write_text(CRANE)
    return load_robot(path)


def mujoco_distances(robot, q, points):
    """m, of points to the nearest geom of the arm: from outside to the surface, 0 inside."""
    spec = robot.mj_spec.copy()
    body = spec.worldbody.add_body(name="probe", mocap=True)
    body.add_geom(name="probe", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[1e-6, 0, 0])
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[:] = q
    geoms, probe, found = robot.part_geoms.tolist(), model.geom("probe").id, []
    for point in points:
        data.mocap_pos[0] = point
        mujoco.mj_kinematics(model, data)
        found.append(
            min(mujoco.mj_geomDistance(model, data, g, probe, 10.0, None) for g in geoms) + 1e-6
        )
    return np.maximum(found, 0)


# Below its excess, polytopes around cylinders and their true form differ.
@pytest.mark.parametrize("margin", [0.0, 0.02, 0.1])
def test_points_near_the_arm_go_and_no_others(crane, margin):
    rng = np.random.default_rng(0)
    for turn in range(2):
        q = rng.uniform(crane.joint_lower, crane.joint_upper)
        arm = crane.attach("tip", [box([0.25, 0, 0], [0.05, 0.02, 0.03])]) if turn else crane
        points = rng.uniform(-1, 1, (3000, 3)) * [0.9, 0.9, 0.9] + [0, 0, 0.3]
        away = mujoco_distances(arm, q, points)
        kept = {tuple(p) for p in without_robot(points, arm, q, margin).tolist()}
        is_kept = np.array([tuple(p) in kept for p in points.tolist()])
        assert 0 < (~is_kept).sum() < len(points) / 2
        assert away[is_kept].min() > margin - 1e-6
        assert away[~is_kept].max() <= margin + 6e-4


def test_distances_to_needles_and_corners_are_those_to_the_nearest_point():
    rng = np.random.default_rng(1)
    for corners in (
        np.array([[0, 0, 0], [1, 0.01, 0], [1, -0.01, 0], [1, 0, 0.01]]),
        rng.random((9, 3)),
    ):
        weights = rng.dirichlet(np.full(len(corners), 0.3), 20_000)
        inside = np.concatenate([corners, weights @ corners])
        points = rng.uniform(-0.5, 1.5, (200, 3))
        nearest = np.sqrt(((points[:, None] - inside) ** 2).sum(axis=2).min(axis=1))
        found = distances_to_hull(corners, points)
        outside = found > 0
        assert (found <= nearest + 1e-12)[outside].all()
        assert (nearest - found)[outside].max() < 0.05
        assert nearest[~outside].max(initial=0) < 0.1
    spheres = distances_to_hull(np.zeros((1, 3)), points)
    np.testing.assert_allclose(spheres, np.linalg.norm(points, axis=1))


def test_scene_files_leave_out_what_is_on_the_arm(crane, tmp_path):
    q = crane.home.tolist()
    tip = [0.36, 0.0, 0.45]
    file = tmp_path / "scene.json"
    for text, number in (
        (f'[{{"points": [{tip}, [0.9, 0, 0]], "without_robot_at": {q}}}]', 1),
        (f'[{{"points": [{tip}, [0.9, 0, 0]], "without_robot_at": {q}, "margin": 1}}]', None),
        (f'[{{"points": [{tip}, [0.9, 0, 0]]}}]', 2),
    ):
        file.write_text(f'{{"clouds": {text}}}')
        scene = scene_from_json(file, crane)
        assert (None if scene.cloud is None else scene.cloud.num) == number


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ('"without_robot_at": [0, 0, 0, 0]', "say which arm was there, scene_from_json"),
        ('"without_robot_at": 3', "has without_robot_at = 3; give a list of numbers"),
        ('"margin": 0.1', "has a margin, which is one to the robot; add without_robot_at"),
    ],
)
def test_broken_entries_are_refused_in_a_sentence(entry, message, tmp_path):
    (tmp_path / "scene.json").write_text(f'{{"clouds": [{{"points": [[1, 0, 0]], {entry}}}]}}')
    with pytest.raises(InputError, match=message):
        scene_from_json(tmp_path / "scene.json")


@pytest.mark.parametrize(
    ("q", "margin", "message"),
    [
        ([0, 0], 0.1, r"the cloud was seen with crane at \[0, 0\]; give 4 finite joint values"),
        ([0, 0, 0, "x"], 0.1, "give 4 finite joint values"),
        ([0, 0, 0, np.inf], 0.1, "give 4 finite joint values"),
        ([0, 0, 0, 0], -0.1, "margin of the cloud to the arm is -0.1; give 0 or more"),
    ],
)
def test_bad_input_is_refused_in_a_sentence(crane, q, margin, message):
    with pytest.raises(InputError, match=message):
        without_robot([[1, 0, 0]], crane, q, margin)
