"""Checks, certificates and plans among points, by brute force and against MuJoCo's C engine."""

import itertools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from gnnjax.arm.kinematics import forward_kinematics
from gnnjax.arm.robot import load_robot
from gnnjax.collision.certify import certify_edges, certify_path
from gnnjax.collision.checker import make_checker
from gnnjax.collision.clearances import base_clear, clearances
from gnnjax.collision.cloud import without_leaves
from gnnjax.collision.fused import obstacles_clear
from gnnjax.collision.levels import BLOCKED, CLOUD
from gnnjax.errors import InputError
from gnnjax.planning.load import load_planner
from gnnjax.problems.problem import Problem
from gnnjax.scene.batches import stack_scenes
from gnnjax.scene.cloud import NODES, point_cloud
from gnnjax.scene.mujoco_world import build_world, deepest_contact, place_obstacles
from gnnjax.scene.own_points import distances_to_hull
from gnnjax.scene.scene import inflated, scene_from_shapes, without_points
from gnnjax.scene.shapes import box
from gnnjax.scene.surfaces import scene_from_points
from tests.arms import CRANE
from tests.clouds import draw
from tests.draws import random_configurations


@pytest.fixture(scope="module")
def crane(tmp_path_factory):
    path = tmp_path_factory.mktemp("robots") / "crane.xml"
    path.write_text(CRANE)
    return load_robot(path)


def gaps(robot, scene, q):
    """m, of the parts that joints move to the balls of a scene's cloud; 1 where it is 0.05 or more
    along an axis of a part's body."""
    positions, rotations = (np.asarray(x, float) for x in forward_kinematics(robot, jnp.asarray(q)))
    points, ball = scene.cloud.points[: scene.cloud.num].astype(float), float(scene.cloud.radius)
    found = np.ones(len(q))
    for part in robot.parts:
        if not is_moved(robot, part.body):
            continue
        reach = part.radius + ball + 0.05
        low, high = part.vertices.min(axis=0) - reach, part.vertices.max(axis=0) + reach
        for i, (origin, turn) in enumerate(
            zip(positions[:, part.body], rotations[:, part.body], strict=True)
        ):
            seen = (points - origin) @ turn
            near = seen[((seen > low) & (seen < high)).all(axis=1)]
            if len(near):
                gap = distances_to_hull(part.vertices, near).min() - part.radius - ball
                found[i] = min(found[i], gap)
    return found


def is_moved(robot, body):
    while body >= 0:
        if robot.bodies[body].joints:
            return True
        body = robot.bodies[body].parent
    return False


def compiled(robot, backend):
    """`check_configurations`, `place`, `check_each` and `clearance`."""
    made = make_checker(robot, backend)
    return tuple(
        map(jax.jit, (made.check_configurations, made.place, made.check_each, made.clearance))
    )


@pytest.fixture(scope="module")
def kernels(crane):
    return compiled(crane, "fused")


@pytest.fixture(scope="module")
def mjx_kernels(tiny):
    return compiled(tiny, "mjx")


def verdicts(place, each, batch, q):
    """What `check_each` says of each of three scenes."""
    placed, groups = place(batch), q.reshape(-1, 8, q.shape[1])
    owners = (np.full(len(groups), i, np.int32) for i in range(3))
    return [np.asarray(each(placed, owner, groups)).ravel() for owner in owners]


@pytest.mark.parametrize("arm", ["crane", "tiny"])
def test_kernels_accept_nothing_that_touches_and_refuse_nothing_that_is_free_by_millimetres(
    arm, request
):
    crane = request.getfixturevalue(arm)
    kernels = request.getfixturevalue("kernels" if arm == "crane" else "mjx_kernels")
    rng = np.random.default_rng(1)
    check, place, each, clearance_of = kernels
    scenes = [
        scene_from_points(draw(rng, "blob")[:200] + np.array([0.5, 0, 0.3]), 0.02, None),
        scene_from_points(draw(rng, "wall")[:, [2, 0, 1]], 0.01, None),
        scene_from_shapes([]),
    ]
    q, batch = random_configurations(rng, crane, 400), stack_scenes(scenes)
    *found, free_alone = verdicts(place, each, batch, q)
    grown = verdicts(place, each, inflated(batch, 0.01), q)
    assert 0.2 < free_alone.mean()
    touched = 0
    # Halfway between points far apart, look-ups, which are all that MJX has, are short by more than
    # before a wall.
    look_ups = np.linalg.norm(scenes[0].cloud.cells), 0.01
    enough = look_ups if arm == "tiny" else (0.003, 0.003)
    for scene, free, more, some in zip(scenes, found, grown, enough, strict=False):
        gap = gaps(crane, scene, q)
        assert not (free & (gap < 0)).any()
        assert (free == free_alone)[gap > some].all()
        assert not (more & (gap < 0.01 - 1e-6)).any()
        touched += int((free_alone & ~free).sum())
    np.testing.assert_array_equal(grown[2], free_alone)
    if arm == "tiny":
        lean = jax.tree.map(jnp.asarray, without_points(scenes[0]))
        np.testing.assert_array_equal(check(lean, q), found[0])
        clearance = np.asarray(clearance_of(lean, q))
        assert (clearance <= gaps(crane, scenes[0], q) + 1e-4).all()
        np.testing.assert_array_equal(clearance > 0, found[0])
    assert touched > 30


def test_what_look_ups_leave_open_is_decided_by_points_and_blocked_without_them(crane, kernels):
    rng = np.random.default_rng(2)
    scene = scene_from_points(draw(rng, "wall")[:, [2, 0, 1]] - [0.2, 0, 0], 0.01, None)
    first, second = make_checker(crane).levels
    q = random_configurations(rng, crane, 400)
    _, place, each, _ = kernels
    batch = stack_scenes([scene, scene, scene_from_shapes([])])
    placed, owner = place(batch), np.zeros(len(q), np.int32)
    level = jax.jit(first)
    words, itself = (np.asarray(level(placed, owner[:1] + i, q[None]))[0] for i in (0, 2))
    is_open = words & CLOUD > 0
    gap, alone = gaps(crane, scene, q), words & ~CLOUD == 0
    assert (is_open | (words >= BLOCKED))[gap < 0].all()
    # What is deep in the cloud needs no second look.
    deep = (words >= BLOCKED) & (itself < BLOCKED)
    assert deep.sum() > 10
    assert (gap[deep] < 0).all()
    clear = np.asarray(jax.jit(second.clear_of_cloud)(placed, owner, q, is_open))
    assert clear[~is_open].all()
    assert 2 < (clear & is_open).sum() < is_open.sum() - 30
    np.testing.assert_array_equal(verdicts(place, each, batch, q)[0][alone], clear[alone])
    blind = jax.jit(second.clear_of_cloud)(without_leaves(placed), owner, q, is_open)
    np.testing.assert_array_equal(blind, ~is_open)


def test_the_c_engine_finds_no_contact_in_what_is_accepted_and_one_in_what_is_not(crane, kernels):
    rng = np.random.default_rng(3)
    wall = draw(rng, "wall")[:, [2, 0, 1]] - [0.2, 0, 0]
    scene, dense = (scene_from_points(some, 0.02, None) for some in (wall[::3], wall))
    model = build_world(crane, len(scene.mask), scene.cloud)
    data = mujoco.MjData(model)
    place_obstacles(model, data, scene)
    model.geom_margin[:] = 0.01
    of_cloud = model.geom_bodyid == model.body("cloud of points").id

    def distances(q):
        """m, to the balls and of the arm to itself, as far as they are within the margin."""
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        with_cloud = of_cloud[data.contact.geom[: data.ncon]].any(axis=1)
        found = data.contact.dist[: data.ncon]
        return [found[x].min(initial=0.01) for x in (with_cloud, ~with_cloud)]

    q = random_configurations(rng, crane, 1200)
    q = q[np.argsort(np.abs(gaps(crane, scene, q)))[:400]]  # the nearest to touching
    # Beside a cloud of as many points as in the other tests, for which the kernel is compiled.
    batch = stack_scenes([scene, dense, scene_from_shapes([])])
    found, _, alone = verdicts(*kernels[1:3], batch, q)
    away, itself = np.transpose([distances(at) for at in q])
    collides = np.minimum(away, itself) < -1e-5
    assert not (found & collides).any()
    assert found[alone & (away > 0.003)].all()
    assert (alone & (away > 0.003) & (away < 0.01)).sum() > 5
    assert found.sum() > 30
    assert collides.sum() > 30
    with pytest.raises(InputError, match=r"cloud of \d+ points, and the MuJoCo world one of 0"):
        place_obstacles(build_world(crane, len(scene.mask)), data, scene)
    exact = clearances(crane, scene, q, most=0.0) > 0
    assert not (exact & collides).any()
    assert not (found & ~exact).any()
    touching = (away < -1e-3) & (itself > 0.001)
    deepest = int(np.where(touching, away, 0).argmin())
    contact = deepest_contact(crane, scene, q[deepest])
    assert contact.second == "the cloud"
    assert contact.depth == pytest.approx(-gaps(crane, scene, q)[deepest], abs=1e-5)
    # Edges that graze.
    near = np.flatnonzero(found & (away < 0.01))
    starts = np.repeat(q[near].astype(float), 10, axis=0)
    ends = starts + rng.uniform(-0.03, 0.03, starts.shape)
    certified = certify_edges(crane, scene, starts, ends)
    assert certified.sum() > 20
    assert (~certified).sum() > 5
    least = [
        min(min(distances(a + t * (b - a))) for t in np.linspace(0, 1, 20))
        for a, b in zip(starts[certified], ends[certified], strict=True)
    ]
    assert min(least) > -1e-5
    assert min(least) < 0.002


def test_certificates_are_of_the_points_and_do_not_believe_the_grid(tiny):
    rng = np.random.default_rng(4)
    scene = scene_from_points(draw(rng, "blob")[:60] + np.array([0.5, 0, 0.2]), 0.02, None)
    lying = scene._replace(cloud=scene.cloud._replace(squared=np.full(NODES**3, 9.0, np.float32)))
    num = 0
    for start, end in itertools.pairwise(random_configurations(rng, tiny, 80)):
        path = np.stack([start, end])
        proven = certify_path(tiny, scene, path)
        assert proven == certify_path(tiny, lying, path)
        along = (start + np.linspace(0, 1, 200)[:, None] * (end - start)).astype(np.float32)
        least = gaps(tiny, scene, along).min()
        assert not (proven and least < 0)
        if least > 1e-3:
            assert proven == certify_path(tiny, scene_from_shapes([]), path)
        num += proven
    assert 5 < num < 75


def test_a_scene_without_its_points_is_not_certified(tiny):
    scene = scene_from_points([[1.0, 0, 0]])
    with pytest.raises(InputError, match="has 1 points, of which 0 are there"):
        certify_path(tiny, without_points(scene), np.zeros((2, 3)))
    broken = scene.cloud._replace(points=scene.cloud.points * np.nan)
    with pytest.raises(InputError, match="points that are not finite"):
        certify_path(tiny, scene._replace(cloud=broken), np.zeros((2, 3)))


def test_obstacles_clear_and_base_clear_tell_of_the_cloud_last(tiny):
    for height, clear in ((0.5, True), (0.1, False)):
        scene = scene_from_shapes(
            [box([2, 0, 0], [0.1] * 3)], clouds=[point_cloud([[0, 0, height]], 0.02)]
        )
        found = obstacles_clear(
            tiny, jax.tree.map(jnp.asarray, scene), jnp.zeros(3), base_only=True
        )
        np.testing.assert_array_equal(found, [True] * 10 + [clear])
        np.testing.assert_array_equal(base_clear(tiny, scene), found)
        np.testing.assert_array_equal(base_clear(tiny, stack_scenes([scene] * 2)), [found] * 2)


def test_queries_say_what_the_cloud_touches(tiny):
    planner = load_planner(tiny.path)
    inside = scene_from_points([[0.2, 0, 0]], 0.02)
    with pytest.raises(InputError, match=r"start .* and the cloud overlap by"):
        planner.plan(inside, [0, 0, 0], [2, 0, 0])
    in_base = scene_from_points([[0, 0, 0.05]], 0.02)
    with pytest.raises(InputError, match="the cloud of the scene reaches 50 mm into the base"):
        planner.plan(in_base, [0, 0, 0], [2, 0, 0])


def test_a_path_leads_around_what_a_camera_saw(tiny):
    wall = np.stack(np.meshgrid([0.0], np.arange(0.56, 1, 0.01), np.arange(-0.2, 0.1, 0.01)), -1)
    scene = scene_from_points(wall.reshape(-1, 3), 0.01)
    planner = load_planner(tiny.path)
    start, goal = [0.6, 0, 0], [2.5, 0, 0]
    assert not certify_path(tiny, scene, [start, goal])
    plan = planner.plan(scene, start, goal)
    assert plan.success
    assert plan.certified
    dense = np.concatenate(
        [a + np.linspace(0, 1, 100)[:, None] * (b - a) for a, b in itertools.pairwise(plan.path)]
    )
    assert gaps(tiny, scene, dense.astype(np.float32)).min() > 0
    both = Problem(
        np.array([start] * 2, np.float32),
        np.array([goal] * 2, np.float32),
        stack_scenes([scene, scene_from_shapes([])]),
    )
    plans = planner.plan_batch(both)
    np.testing.assert_array_equal(plans[0].path, plan.path)
    assert len(plans[1].path) == 2


def test_points_are_no_trouble_to_an_arm_whose_base_has_no_geometry(tiny_path, tmp_path):
    ball = '<geom type="sphere" size="0.1" contype="1" conaffinity="1"/>'
    path = tmp_path / "bare.xml"
    path.write_text(tiny_path.read_text().replace(ball, ""))
    assert base_clear(load_robot(path), scene_from_points([[0.0, 0.0, 0.0]])).all()
