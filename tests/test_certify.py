"""Certification against a fine scan with MuJoCo's C engine."""

import inspect

import jax
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnnjax.arm.robot import load_robot
from gnnjax.collision.bounds import Spheres, spheres_of
from gnnjax.collision.certify import certify_edges, certify_path, check_scene
from gnnjax.collision.clearances import clearances, configuration_clearance, path_clearance
from gnnjax.collision.gaps import gaps_of
from gnnjax.collision.margins import proven_clearance
from gnnjax.collision.obstacles import obstacles_of
from gnnjax.collision.travel import Moments, straight_motions
from gnnjax.errors import InputError
from gnnjax.planning.query import check_query
from gnnjax.scene.scene import make_scene
from tests.arms import ODD
from tests.fine_scan import collides_anywhere, random_scene


@pytest.fixture(scope="module")
def robots(tiny_path, tmp_path_factory):
    odd = tmp_path_factory.mktemp("robots") / "odd.xml"
    odd.write_text(ODD)
    return {
        "tiny": load_robot(tiny_path),
        "odd": load_robot(odd),
        "kuka_iiwa14": load_robot("kuka_iiwa14"),
    }


@pytest.mark.parametrize(
    ("name", "num_edges", "share"), [("tiny", 60, 0.95), ("odd", 60, 0.9), ("kuka_iiwa14", 16, 0.9)]
)
def test_certified_edges_are_free_in_a_fine_scan_and_most_free_edges_are_certified(
    robots, name, num_edges, share
):
    robot, rng = robots[name], np.random.default_rng(0)
    free = certified = refuted = 0
    for _ in range(num_edges):
        scene = random_scene(rng, num=5)
        edge = rng.uniform(robot.joint_lower, robot.joint_upper, (2, robot.num_dof))
        edge[1] = edge[0] + 0.3 * (edge[1] - edge[0])
        yes = certify_path(robot, scene, edge)
        hit = collides_anywhere(robot, scene, edge)
        assert not (yes and hit)
        free, certified, refuted = free + (not hit), certified + yes, refuted + hit
    assert certified >= share * free > 0
    assert refuted >= 3


def test_a_collision_between_the_samples_of_a_planner_is_found(robots):
    robot = robots["tiny"]
    data = mujoco.MjData(robot.mj_model)
    mujoco.mj_kinematics(robot.mj_model, data)
    tip, radius = data.geom_xpos[robot.sphere_geoms[-1]], robot.sphere_radii[-1]
    # The tip grazes a needle for 0.014 rad, in the middle between two configurations 0.05 apart.
    edge = np.array([[1.3, 0.0, 0.0], [1.8, 0.0, 0.0]])
    angle = np.arctan2(tip[1], tip[0]) + 1.525
    reach = np.hypot(tip[0], tip[1]) + radius - 2e-4
    center = [reach * np.cos(angle), reach * np.sin(angle), tip[2]]
    scene = make_scene([center], [[1e-5, 1e-5, 1e-5]])
    assert not collides_anywhere(robot, scene, edge, step=0.05)
    assert collides_anywhere(robot, scene, edge, step=0.002)
    assert not certify_path(robot, scene, edge)


def test_a_motion_outside_the_joint_limits_is_not_certified(robots):
    scene = make_scene([], [])
    edges = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0]]), np.array([[1.0, 0, 0], [3.5, 0, 0]])
    np.testing.assert_array_equal(certify_edges(robots["tiny"], scene, *edges), [True, False])


def test_curves_near_a_certified_line_are_free_in_a_fine_scan(robots):
    robot, rng = robots["tiny"], np.random.default_rng(3)
    certified = wider = 0
    for _ in range(60):
        scene = random_scene(rng, num=5)
        edge = rng.uniform(robot.joint_lower, robot.joint_upper, (2, robot.num_dof))
        edge[1] = edge[0] + 0.2 * (edge[1] - edge[0])
        slack = rng.uniform(0, 0.06, (1, robot.num_dof))
        yes = certify_edges(robot, scene, edge[:1], edge[1:], slack=slack)[0]
        certified, wider = certified + yes, wider + certify_path(robot, scene, edge)
        # Along the bounds of the slack, in every direction that there is.
        at = np.linspace(0, 1, 17)[:, None]
        signs = np.sign(rng.normal(size=(12, 1, robot.num_dof)))
        curves = edge[0] + at * (edge[1] - edge[0]) + signs * np.sin(np.pi * at) * slack
        curves = np.clip(curves, robot.joint_lower, robot.joint_upper)
        # Chords of these curves stay within the slack, too, which is convex.
        assert not (yes and collides_anywhere(robot, scene, *curves, step=0.01))
    assert 10 < certified < wider


def test_an_edge_without_slack_is_certified_as_one_with_none(robots):
    robot = robots["kuka_iiwa14"]
    _, batch, starts, ends, owner = scenes_and_edges(robot)
    plain = certify_edges(robot, batch, starts, ends, owner)
    none = certify_edges(robot, batch, starts, ends, owner, np.zeros_like(starts))
    np.testing.assert_array_equal(plain, none)
    wide = certify_edges(robot, batch, starts, ends, owner, np.full_like(starts, 0.5))
    assert not (wide & ~plain).any()
    assert wide.sum() < plain.sum()


@pytest.mark.parametrize(
    "slack", [np.zeros((2, 3)), *(np.full((1, 3), x) for x in (-0.1, np.nan, np.inf))]
)
def test_slack_is_a_row_of_lengths_an_edge(robots, slack):
    edge = np.zeros((1, 3)), np.ones((1, 3))
    with pytest.raises(InputError, match=r"slack .* for 1 edges; give lengths, a row each"):
        certify_edges(robots["tiny"], make_scene([], []), *edge, slack=slack)


def test_a_path_of_one_configuration_is_certified_by_its_clearance(robots):
    scene = make_scene([[0.6, 0.0, 0.0]], [[0.1, 0.1, 0.1]])
    assert not certify_path(robots["tiny"], scene, np.zeros((1, 3)))
    assert certify_path(robots["tiny"], scene, np.array([[2.0, 0.0, 0.0]]))


def test_the_clearance_of_a_path_is_the_least_along_it(robots):
    robot, rng = robots["tiny"], np.random.default_rng(1)
    path = rng.uniform(robot.joint_lower, robot.joint_upper, (3, robot.num_dof))
    scene = random_scene(rng, num=3)

    def along(at):
        """Clearances at 0 to 2, along both edges."""
        edge = np.minimum(at.astype(int), 1)
        q = path[edge] + (at - edge)[:, None] * (path[edge + 1] - path[edge])
        return clearances(robot, scene, q)

    # Some hundred steps, and as many between the neighbours of the nearest.
    coarse = np.linspace(0, 2, 401)
    nearest = coarse[along(coarse).argmin()]
    least = along(np.clip(nearest + np.linspace(-0.005, 0.005, 201), 0, 2)).min()
    # No point of the arm, 1 m long, moves by more than 0.03 m to the next sample.
    assert least - 1e-6 <= path_clearance(robot, scene, path, 0.02) <= least + 0.03
    assert path_clearance(robot, scene, path, 0.001) == pytest.approx(least, abs=2e-3)


def test_the_proven_clearance_of_a_path_is_its_least_distance_to_obstacles(robots):
    robot, rng, found = robots["tiny"], np.random.default_rng(2), 0
    nothing = make_scene([], [])
    while found < 4:
        path = rng.uniform(robot.joint_lower, robot.joint_upper, (3, robot.num_dof))
        path = path[0] + 0.3 * (path - path[0])  # most of the long ones touch something
        scene = random_scene(rng, num=10)
        if not certify_path(robot, scene, path):
            continue
        least, alone = (path_clearance(robot, x, path, 0.002) for x in (scene, nothing))
        if alone < least + 1e-3:  # the arm comes nearer to itself
            continue
        found += 1
        assert least - 2e-3 <= proven_clearance(robot, scene, path) <= least
        assert proven_clearance(robot, scene, path, most=least / 2) == least / 2
    assert proven_clearance(robot, nothing, path) == 0.25


def test_a_path_that_touches_has_no_clearance(robots):
    scene = make_scene([[0.6, 0.0, 0.0]], [[0.1, 0.1, 0.1]])
    with pytest.raises(InputError, match="the path is not certified, so that it has no clearance"):
        proven_clearance(robots["tiny"], scene, np.zeros((1, 3)))


def test_a_slide_joint_reaches_as_far_as_it_is_from_its_reference(tmp_path):
    # It travels 0.1 m, but carries the ball around a circle of 1 m.
    path = tmp_path / "crane.xml"
    path.write_text(
        '<mujoco><compiler angle="radian" autolimits="true"/><worldbody><body>'
        '<joint axis="0 0 1" range="-3 3"/><joint type="slide" axis="1 0 0" range="0.9 1"/>'
        '<geom type="sphere" size="0.05" mass="1"/></body></worldbody></mujoco>'
    )
    scene = make_scene([[0.94, 0.14, 0.0]], [[0.02, 0.02, 0.02]])
    edge = np.array([[-0.2, 0.95], [0.2, 0.95]])
    robot = load_robot(path)
    assert collides_anywhere(robot, scene, edge)
    assert not certify_path(robot, scene, edge)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"centers": np.nan},
            r"existing obstacle 0 of the scene has centers \[nan, .* must be finite",
        ),
        ({"centers": np.inf}, "centers .* must be finite"),
        ({"centers": 1e7}, "centers .* below 10000"),
        ({"half_extents": -0.1}, r"half_extents and radii \[-0.1.* must be positive"),
        ({"half_extents": 0.0}, "half_extents .* must be positive"),
        ({"half_extents": np.nan}, "half_extents .* must be positive"),
        ({"quats": 0.0}, r"quats \[0.0, 0.0, 0.0, 0.0\], which must be of length 1"),
        ({"quats": 1e20}, "quats .* must be of length 1"),
        ({"quats": 0.7}, "quats .* must be of length 1"),
        ({"quats": np.nan}, "quats .* must be of length 1"),
    ],
)
def test_nothing_is_certified_among_boxes_that_are_none(robots, change, message):
    good = make_scene([[2.0, 0.0, 0.0]], [[0.1] * 3])
    name, value = next(iter(change.items()))
    array = getattr(good, name).copy()
    array[0] = value
    bad, path = good._replace(**{name: array}), np.zeros((2, 3))
    assert certify_path(robots["tiny"], good, path)
    for certified in (
        lambda: certify_path(robots["tiny"], bad, path),
        lambda: certify_edges(robots["tiny"], bad, path[:1], path[1:]),
        lambda: configuration_clearance(robots["tiny"], bad, path[0]),
        lambda: check_query(robots["tiny"], bad, path[0], path[1]),
    ):
        with pytest.raises(InputError, match=message):
            certified()
    # Where no box is, anything may lie.
    assert certify_path(robots["tiny"], bad._replace(mask=np.zeros(10, bool)), path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"mask": np.ones(10, int)}, r"mask of the scene is int64 \(10,\)"),
        ({"mask": np.ones(3, bool)}, r"centers of the scene have shape \(10, 3\); give \[3, 3\]"),
        ({"quats": np.ones((10, 3))}, "quats of the scene have shape"),
    ],
)
def test_a_scene_of_other_arrays_is_refused(robots, change, message):
    scene = make_scene([[2.0, 0.0, 0.0]], [[0.1] * 3])._replace(**change)
    with pytest.raises(InputError, match=message):
        certify_path(robots["tiny"], scene, np.zeros((2, 3)))


@pytest.mark.parametrize(
    ("path", "message"),
    [
        (np.zeros((0, 3)), "holds no configuration"),
        ([], r"path has shape \(0,\); tiny needs \[N, 3\]"),
        (np.zeros((2, 4)), r"path has shape \(2, 4\); tiny needs \[N, 3\]"),
        (np.zeros(3), r"path has shape \(3,\)"),
        ([["a", "b", "c"]], "path is not an array of numbers"),
    ],
)
def test_a_path_of_another_shape_is_refused(robots, path, message):
    with pytest.raises(InputError, match=message):
        certify_path(robots["tiny"], make_scene([], []), path)


def test_what_is_not_a_number_is_not_certified(robots):
    path = np.array([[0.0, 0.0, 0.0], [0.0, np.nan, 0.0], [0.0, 0.0, 0.0]])
    assert not certify_path(robots["tiny"], make_scene([], []), path)
    with pytest.raises(InputError, match="2 starts and 1 ends"):
        certify_edges(robots["tiny"], make_scene([], []), np.zeros((2, 3)), np.zeros((1, 3)))


def scenes_and_edges(robot, num_scenes=4, num_edges=40):
    """Scenes of different numbers of boxes in one batch, and edges in them."""
    rng = np.random.default_rng(5)
    scenes = [random_scene(rng, num=3 * number) for number in range(num_scenes)]
    starts = rng.uniform(robot.joint_lower, robot.joint_upper, (num_edges, robot.num_dof))
    ends = rng.uniform(robot.joint_lower, robot.joint_upper, (num_edges, robot.num_dof))
    ends = starts + rng.uniform(0, 0.9, (num_edges, 1)) * (ends - starts)
    batch = jax.tree.map(lambda *x: np.stack(x), *scenes)
    return scenes, batch, starts, ends, rng.integers(num_scenes, size=num_edges)


@pytest.mark.parametrize("name", ["tiny", "odd", "kuka_iiwa14"])
def test_an_edge_is_certified_alike_alone_and_in_any_company(robots, name):
    robot = robots[name]
    scenes, batch, starts, ends, owner = scenes_and_edges(robot)
    alone = [
        certify_edges(robot, scenes[p], start[None], end[None])[0]
        for p, start, end in zip(owner, starts, ends, strict=True)
    ]
    assert 5 < sum(alone) < len(alone)
    np.testing.assert_array_equal(certify_edges(robot, batch, starts, ends, owner), alone)
    order = np.random.default_rng(6).permutation(len(starts))
    # More than are worked on at once, and some that are none among them.
    order = np.tile(order, 26)
    starts, ends, owner, alone = (np.array(x)[order] for x in (starts, ends, owner, alone))
    starts[3::7, -1], ends[5::7, 0] = np.nan, np.inf
    alone[3::7] = alone[5::7] = False
    np.testing.assert_array_equal(certify_edges(robot, batch, starts, ends, owner), alone)


@pytest.mark.parametrize("name", ["tiny", "odd", "kuka_iiwa14"])
def test_nothing_that_may_touch_is_left_out(robots, name):
    robot = robots[name]
    _, batch, starts, ends, owner = scenes_and_edges(robot, num_edges=200)
    everything = Spheres(robot)
    everything.ball_radii[:] = np.inf
    at = Moments((starts.T + ends.T) / 2, owner, np.arange(len(starts)), np.full(len(starts), 0.5))
    motions = straight_motions(everything, (ends - starts).T, None)
    found, wanted = (
        gaps_of(body, obstacles_of(batch), at, motions) for body in (spheres_of(robot), everything)
    )
    assert len(found.gap) < 0.7 * len(wanted.gap)
    wanted = type(wanted)(*(x[wanted.gap <= wanted.motion] for x in wanted))
    found = type(found)(*(x[found.gap <= found.motion] for x in found))
    assert len(wanted.gap) > 50
    for one, other in zip(found, wanted, strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_link_that_turns_about_itself_is_not_taken_for_the_base(tmp_path):
    # No joint moves the middle of the capsule's spheres, but it is no geom of the base either.
    path = tmp_path / "mast.xml"
    path.write_text(
        '<mujoco><compiler angle="radian" autolimits="true"/><worldbody><body>'
        '<joint axis="0 0 1" range="-3 3"/>'
        '<geom type="capsule" size="0.05" fromto="0 0 0 0 0 0.5" mass="1"/></body>'
        "</worldbody></mujoco>"
    )
    robot, edge = load_robot(path), np.array([[0.0], [1.0]])
    assert certify_path(robot, make_scene([[0.2, 0, 0.3]], [[0.1] * 3]), edge)
    assert not certify_path(robot, make_scene([[0.1, 0, 0.3]], [[0.1] * 3]), edge)


def test_clearances_are_those_of_single_configurations(robots):
    robot = robots["tiny"]
    scenes, batch, q, _, owner = scenes_and_edges(robot, num_edges=200)
    alone = [
        configuration_clearance(robot, scenes[p], row) for p, row in zip(owner, q, strict=True)
    ]
    found = clearances(robot, batch, q, owner)
    np.testing.assert_array_equal(found, alone)
    touching = clearances(robot, batch, q, owner, most=0.0)
    np.testing.assert_array_equal(touching[found <= 0], found[found <= 0])
    assert 2 < (found <= 0).sum() == (touching <= 0).sum() < 100
    assert np.isnan(configuration_clearance(robot, scenes[1], q[0] * np.nan))


@pytest.mark.parametrize(
    ("thing", "name"), [(None, "NoneType"), ("scene.json", "str"), ({}, "dict")]
)
def test_what_is_no_scene_is_refused(thing, name):
    with pytest.raises(InputError, match=f"the scene is a {name}; make one with make_scene"):
        inspect.unwrap(check_scene)(thing)


def test_a_scene_that_is_none_is_named_among_others(robots):
    _, batch, starts, ends, owner = scenes_and_edges(robots["tiny"])
    batch.half_extents[2, 1] = 0.0
    with pytest.raises(
        InputError, match="scene 2: existing obstacle 1 of the scene has half_extents"
    ):
        certify_edges(robots["tiny"], batch, starts, ends, owner)


@pytest.mark.parametrize(
    "owner", [None, np.zeros(3, int), np.zeros(40), np.full(40, -1), np.full(40, 4), "a"]
)
def test_every_edge_needs_a_scene_among_several(robots, owner):
    scenes, batch, starts, ends, _ = scenes_and_edges(robots["tiny"])
    with pytest.raises(InputError, match="for 40 edges and 4 scenes in a batch; give the number"):
        certify_edges(robots["tiny"], batch, starts, ends, owner)
    with pytest.raises(InputError, match="for 40 edges and 0 scenes in a batch"):
        certify_edges(robots["tiny"], scenes[0], starts, ends, np.zeros(40, int))


def test_a_quaternion_of_nearly_length_one_turns_a_box_as_if_it_were(robots):
    quat = Rotation.from_rotvec([0.3, -0.5, 0.9]).as_quat(scalar_first=True)
    scene = make_scene([[1.0, 0.3, 0.3]], [[0.05, 0.2, 0.1]], [quat])
    longer = scene._replace(quats=scene.quats * 1.00009)
    found = [configuration_clearance(robots["tiny"], s, np.zeros(3)) for s in (scene, longer)]
    assert found[0] == pytest.approx(found[1], abs=1e-6)
