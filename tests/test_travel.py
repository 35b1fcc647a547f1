"""Bounds on how far the arm travels, before MuJoCo's kinematics."""

import mujoco
import numpy as np
import pytest

from gnnjax.arm.robot import load_robot
from gnnjax.collision.bounds import spheres_of
from gnnjax.collision.link_frames import joint_frames, link_twists
from gnnjax.collision.travel import Moments, Motions, Travel, straight_motions
from tests.arms import ODD

NUM = 12


@pytest.fixture(scope="module")
def robots(tiny_path, tmp_path_factory):
    odd = tmp_path_factory.mktemp("robots") / "odd.xml"
    odd.write_text(ODD)
    named = {name: load_robot(name) for name in ("kuka_iiwa14", "franka_panda")}
    return {"tiny": load_robot(tiny_path), "odd": load_robot(odd), **named}


def draw(robot, share, rng):
    """Motions of all lengths, and their middles, of which a share is looked at."""
    q = rng.uniform(robot.joint_lower, robot.joint_upper, (NUM, robot.num_dof)).T
    way = rng.normal(size=q.shape) * rng.uniform(0.1, 1.5, NUM)
    at = Moments(q, np.zeros(NUM, int), np.arange(NUM), np.full(NUM, share))
    return at, way


def placed(robot, q):
    """Centers of spheres `[S, 3]`, and vertices of parts, where MuJoCo has them."""
    data = mujoco.MjData(robot.mj_model)
    data.qpos[:] = q
    mujoco.mj_kinematics(robot.mj_model, data)
    body = spheres_of(robot)

    def at(number, points):
        return data.xpos[number + 1] + points @ data.xmat[number + 1].reshape(3, 3).T

    centers = [at(b, c) for b, c in zip(body.bodies, body.centers.T, strict=True)]
    return np.array(centers), [at(part.body, part.vertices) for part in robot.parts]


@pytest.mark.parametrize("name", ["tiny", "odd", "kuka_iiwa14", "franka_panda"])
@pytest.mark.parametrize(("share", "slack"), [(0.02, 0.0), (0.5, 0.0), (0.2, 0.01)])
def test_nothing_travels_farther_than_its_bound(robots, name, share, slack):
    robot, rng = robots[name], np.random.default_rng(3)
    body = spheres_of(robot)
    at, way = draw(robot, share, rng)
    around = np.full(way.shape, slack)
    travel = Travel(body, at, straight_motions(body, way, around if slack else None))
    used, used_by_parts, used_by_links = [], [], []
    for b in range(NUM):
        middles, vertices = placed(robot, at.q[:, b])
        far, far_parts = np.zeros(len(middles)), np.zeros(len(vertices))
        for t in np.linspace(-share, share, 9):
            stray = around[:, b] * rng.choice([-1, 1], robot.num_dof)
            there, vertices_there = placed(robot, at.q[:, b] + t * way[:, b] + stray)
            far = np.maximum(far, np.linalg.norm(there - middles, axis=1))
            of_parts = zip(vertices_there, vertices, strict=True)
            moved = [np.linalg.norm(x - y, axis=1).max() for x, y in of_parts]
            far_parts = np.maximum(far_parts, moved)
        moment = np.full(len(far), b)
        used.append(far / travel.spheres(np.arange(len(far)), moment, middles.T))
        parts = np.arange(len(robot.parts))
        used_by_parts.append(far_parts / travel.parts(parts, np.full(len(parts), b)))
        most = travel.reach[:, b] - body.ball_radii
        used_by_links.append(np.maximum.reduceat(far, body.first) / most)
    found = [np.array(x) for x in (used, used_by_parts, used_by_links)]
    assert all((x <= 1).all() for x in found)
    moving = found[0] > 0.01  # what turns about its own center hardly does
    if share == 0.02 and not slack:  # short motions are known nearly to the millimetre
        assert np.median(found[0][moving]) > 0.9
        assert np.median(found[1][found[1] > 0.01]) > 0.5


@pytest.mark.parametrize("name", ["tiny", "odd", "kuka_iiwa14", "franka_panda"])
def test_no_joint_changes_a_distance_by_more_than_its_bound(robots, name):
    robot, rng = robots[name], np.random.default_rng(6)
    body, (first, second) = spheres_of(robot), spheres_of(robot).pairs.T
    one, other = robot.part_pairs.T
    used, used_by_parts = [], []

    def distances(q):
        centers, vertices = placed(robot, q)
        corners = np.array(
            [(vertices[a][0], vertices[b][-1]) for a, b in zip(one, other, strict=True)]
        )
        apart = np.linalg.norm(corners[:, 0] - corners[:, 1], axis=-1)
        return np.linalg.norm(centers[first] - centers[second], axis=1), apart

    for joint in np.tile(np.arange(robot.num_dof), 30):
        q = rng.uniform(robot.joint_lower, robot.joint_upper)
        moved, by = q.copy(), rng.choice([1e-3, 0.3])
        moved[joint] += by
        between, apart = (
            np.abs(x - y) for x, y in zip(distances(q), distances(moved), strict=True)
        )
        bounds = body.pair_reach[:, joint], body.part_pair_reach[:, joint]
        used.append(between / (by * bounds[0] + 1e-9))
        used_by_parts.append(apart / (by * bounds[1] + 1e-9))
    assert max(np.max(used), np.max(used_by_parts)) <= 1
    # Bounds of the joints that move a pair are not far from what is seen.
    assert np.median(np.max(used, axis=0)) > 0.5


@pytest.mark.parametrize("name", ["tiny", "odd", "kuka_iiwa14"])
def test_twists_are_those_of_mujocos_jacobian(robots, name):
    robot, rng = robots[name], np.random.default_rng(4)
    body = spheres_of(robot)
    at, way = draw(robot, 1.0, rng)
    turning, moving = link_twists(body, joint_frames(body, at.q), way)
    model, data = robot.mj_model, mujoco.MjData(robot.mj_model)
    by_point, by_turn = np.zeros((2, 3, model.nv))
    for b in range(NUM):
        data.qpos[:] = at.q[:, b]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        for number, link in enumerate(body.links.tolist()):
            mujoco.mj_jac(model, data, by_point, by_turn, np.zeros(3), link + 1)
            np.testing.assert_allclose(turning[:, number, b], by_turn @ way[:, b], atol=1e-12)
            np.testing.assert_allclose(moving[:, number, b], by_point @ way[:, b], atol=1e-12)


def test_what_stays_travels_as_far_as_it_is_said_to(robots):
    body = spheres_of(robots["tiny"])
    at, _ = draw(robots["tiny"], 1.0, np.random.default_rng(5))
    travel = Travel(
        body, at._replace(motion=np.zeros(NUM, int)), Motions(None, body.same_rates(0.3))
    )
    most = travel.reach - body.ball_radii[:, None]
    np.testing.assert_allclose(most, 0.3, atol=1e-8)
    assert (most > 0.3).all()


STRETCHED = """
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <worldbody>
    <body>
      <joint axis="0 0 1" range="-3 3"/>
      <geom type="sphere" size="0.05" mass="1"/>
      <body pos="1 0 0">
        <joint axis="0 0 1" range="-3 3"/>
        <geom type="sphere" size="0.05" mass="1"/>
        <body pos="0.5 0 0">
          <joint type="slide" axis="0 1 0" range="-0.1 0.1"/>
          <geom type="sphere" size="0.05" mass="1"/>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.mark.parametrize("way", [(1, 0, 0), (1, 1, 0), (1, -1, 0), (0.1, 0, 2), (0, 0.1, 2)])
def test_bends_are_no_less_than_second_derivatives_and_hardly_more(tmp_path, way):
    path = tmp_path / "stretched.xml"
    path.write_text(STRETCHED)
    robot, way = load_robot(path), np.array(way, float)
    body, step = spheres_of(robot), 1e-4
    places = [placed(robot, t * way)[0] for t in (-step, 0, step)]
    second = np.linalg.norm(places[0] - 2 * places[1] + places[2], axis=1) / step**2
    bends = body.bends(way[:, None]).spheres[:, 0]
    assert (second <= bends + 1e-6).all()
    # Of joints that turn the same way, what there is; but for what the slide adds to reach.
    if way[1] >= 0:
        assert bends[-1] < 1.2 * second[-1] + 0.11
