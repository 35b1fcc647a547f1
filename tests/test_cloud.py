"""Points, meshes and height fields as obstacles, against brute force and MuJoCo's C engine."""

import itertools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import trimesh
from scipy.spatial.distance import cdist

from gnnjax.arm.kinematics import forward_kinematics
from gnnjax.arm.robot import load_robot
from gnnjax.collision.certify import certify_edges, certify_path
from gnnjax.collision.checker import make_checker
from gnnjax.collision.clearances import base_clear, clearances
from gnnjax.collision.cloud import without_leaves
from gnnjax.collision.fused import boxes_clear
from gnnjax.collision.points import leaves_of
from gnnjax.collision.spheres import BLOCKED, CLOUD
from gnnjax.errors import InputError
from gnnjax.planning.load import load_planner
from gnnjax.problems.file import load_file, save_problems
from gnnjax.problems.problem import Problem, ProblemSet
from gnnjax.scene.batches import stack_scenes
from gnnjax.scene.cloud import BUCKETS, NODES, REACH, make_cloud, point_cloud, with_room
from gnnjax.scene.field import distance_field, make_grid
from gnnjax.scene.lookup import corners_around, lookup, squared_distance_to
from gnnjax.scene.mujoco_world import build_world, deepest_contact, place_boxes
from gnnjax.scene.own_points import distances_to_hull
from gnnjax.scene.point_files import points_from_file
from gnnjax.scene.scene import inflated, scene_from_shapes, without_points
from gnnjax.scene.scene_file import scene_from_json, scene_to_json
from gnnjax.scene.shapes import box
from gnnjax.scene.surfaces import (
    INSIDE,
    enclosed,
    height_field,
    mesh,
    scene_from_height_field,
    scene_from_mesh,
    scene_from_points,
)
from tests.draws import random_configurations
from tests.test_hulls import ARM

# Blobs, a wall without thickness, and points so far away that the grid does not hold them.
KINDS = ("blob", "wall", "one", "far", "around")


@pytest.fixture(scope="module")
def crane(tmp_path_factory):
    path = tmp_path_factory.mktemp("robots") / "crane.xml"
    path.write_text(ARM)
    return load_robot(path)


def draw(rng, kind):
    if kind == "blob":
        return rng.normal(0, 0.25, (400, 3)) + rng.normal(0, 0.4, 3)
    if kind == "wall":
        side = np.arange(-1, 1, 0.03) + rng.uniform(0, 0.03)
        return np.stack(np.meshgrid(side, side, [0.5]), axis=-1).reshape(-1, 3)
    if kind == "one":
        return rng.uniform(-0.5, 0.5, (1, 3))
    if kind == "far":
        return rng.uniform(3.5, 4.0, (50, 3)) * [1, -1, 1]
    return rng.normal(0, 4.0, (2000, 3))


def brute_force(points, at):
    """Distances [m] of places `[N, 3]` to the nearest of points."""
    return cdist(at, points).min(axis=1)


def looked_up(cloud, at):
    found = squared_distance_to(lookup(cloud), list(jnp.asarray(at, jnp.float32).T))
    return np.asarray(found, float)


@pytest.mark.filterwarnings("ignore:all points")
@pytest.mark.parametrize("kind", KINDS)
def test_a_look_up_never_exceeds_the_distance_and_is_hardly_less(kind):
    rng = np.random.default_rng(KINDS.index(kind))
    for _ in range(3):
        cloud = make_cloud([point_cloud(draw(rng, kind), 0.01, None)])
        points = cloud.points[: cloud.num].astype(float)
        near = points[rng.integers(len(points), size=500)] + rng.normal(0, 0.05, (500, 3))
        at = np.concatenate([rng.uniform(-REACH, REACH, (1000, 3)), near])
        at = at[(np.abs(at) < REACH).all(axis=1)]
        exact, found = brute_force(points, at) ** 2, looked_up(cloud, at)
        assert (found <= exact * (1 + 1e-5) + 1e-6).all()
        held = ((at >= cloud.lower) & (at <= cloud.lower + (NODES - 1) * cloud.cells)).all(axis=1)
        diagonal = np.linalg.norm(cloud.cells.astype(float))
        assert (exact - found <= (np.sqrt(exact) + diagonal / 4) * diagonal + 1e-5)[held].all()
        if kind == "one":
            np.testing.assert_allclose(found[held], exact[held], rtol=1e-4, atol=1e-5)
        if kind == "wall":  # as far away as the middles of an arm's spheres are that nearly touch
            close = held & (exact > 0.05**2) & (exact < 0.2**2)
            away = np.sqrt(exact) - np.sqrt(np.maximum(found, 0))
            assert away[close].mean() < 0.1 * diagonal
        assert (looked_up(cloud, [[REACH + 0.01, 0, 0]]) < 0).all()
        # An upper bound, too: it goes to a node, half a diagonal away at most, and on from there.
        corners = corners_around(lookup(cloud), list(jnp.asarray(at, jnp.float32).T))
        for reach in (0.02, 0.05, 0.3):
            within = np.asarray(corners.are_within(jnp.float32(reach)))
            assert (np.sqrt(exact) < reach + 1e-5)[within].all()
            assert within[held & (np.sqrt(exact) + diagonal < reach)].all()


def test_voxels_enclose_what_is_in_them_and_stand_out_by_no_more_than_they_say():
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.3, 0.3, (5000, 3))
    balls = point_cloud(points, 0.02, 0.05)
    assert len(balls.points) < 1900
    away = brute_force(balls.points, points)
    assert (away + 0.02 <= balls.radius + 1e-12).all()
    assert balls.radius <= 0.02 + 0.05 * np.sqrt(3) / 2
    # No ball stands elsewhere than among its points.
    assert (brute_force(points, balls.points) <= balls.radius - 0.02 + 1e-12).all()
    lone = np.stack(np.meshgrid(*[[0.0, 0.1, 0.2]] * 3), axis=-1).reshape(-1, 3)
    kept = point_cloud(lone, 0.02, 0.05)
    assert kept.radius == 0.02
    assert sorted(kept.points.tolist()) == sorted(lone.tolist())


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


def test_leaves_and_groups_hold_every_point_and_no_other_in_boxes_around_them():
    rng = np.random.default_rng(9)
    balls = [point_cloud(rng.normal(0, 0.25, (5000, 3)), 0.02, None)]
    balls += [point_cloud(draw(rng, kind), 0.02, None) for kind in ("blob", "one")]
    clouds = [make_cloud([each]) for each in balls]
    room = len(clouds[0].points)
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *(with_room(cloud, room) for cloud in clouds))
    leaves = jax.tree.map(np.asarray, leaves_of(stacked))
    assert leaves.points.shape == (3, room // 32, 3, 32)
    num_groups = room // 32 // 64
    by_group = leaves.points.reshape(3, num_groups, 64, 3, 32)
    there = np.abs(by_group[..., :1, :1]) < 1e3
    for middles, halves in (
        (x.swapaxes(2, 3)[..., None] for x in leaves.boxes),
        (x.swapaxes(1, 2)[:, :, None, :, None] for x in leaves.groups),
    ):
        assert ((np.abs(by_group - middles) <= halves) | ~there).all()
    assert (leaves.boxes.middles.swapaxes(2, 3)[~there[..., 0, 0]] > 1e3).all()
    assert (leaves.groups.middles.swapaxes(1, 2)[~there.any(axis=2)[..., 0, 0]] > 1e3).all()
    for cloud, points in zip(clouds, leaves.points.swapaxes(2, 3).reshape(3, -1, 3), strict=True):
        held = np.unique(points[np.abs(points[:, 0]) < 1e3], axis=0)
        np.testing.assert_array_equal(held, np.unique(cloud.points[: cloud.num], axis=0))
    sizes = leaves.boxes.halves.swapaxes(2, 3)[there[..., 0, 0]]
    assert np.median(sizes) < 0.2  # of clouds that reach 0.75 m from their middles


def test_the_c_engine_finds_no_contact_in_what_is_accepted_and_one_in_what_is_not(crane, kernels):
    rng = np.random.default_rng(3)
    scene = scene_from_points(draw(rng, "wall")[::3, [2, 0, 1]] - [0.2, 0, 0], 0.02, None)
    model = build_world(crane, len(scene.mask), scene.cloud)
    data = mujoco.MjData(model)
    place_boxes(model, data, scene)
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

    q = random_configurations(rng, crane, 2400)
    q = q[np.argsort(np.abs(gaps(crane, scene, q)))[:400]]  # the nearest to touching
    found, _, alone = verdicts(
        *kernels[1:3], stack_scenes([scene, scene, scene_from_shapes([])]), q
    )
    away, itself = np.transpose([distances(at) for at in q])
    collides = np.minimum(away, itself) < -1e-5
    assert not (found & collides).any()
    assert found[alone & (away > 0.003)].all()
    assert (alone & (away > 0.003) & (away < 0.01)).sum() > 5
    assert found.sum() > 30
    assert collides.sum() > 30
    with pytest.raises(InputError, match=r"cloud of \d+ points, and the MuJoCo world one of 0"):
        place_boxes(build_world(crane, len(scene.mask)), data, scene)
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


def test_boxes_clear_and_base_clear_tell_of_the_cloud_last(tiny):
    for height, clear in ((0.5, True), (0.1, False)):
        scene = scene_from_shapes(
            [box([2, 0, 0], [0.1] * 3)], clouds=[point_cloud([[0, 0, height]], 0.02)]
        )
        found = boxes_clear(tiny, jax.tree.map(jnp.asarray, scene), jnp.zeros(3), base_only=True)
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


def test_fields_hold_no_more_than_the_distance_to_a_cloud():
    rng = np.random.default_rng(5)
    scene = scene_from_points(draw(rng, "blob"), 0.01, None)
    grid = make_grid(np.full(3, -1.0), np.full(3, 1.0), 12)
    found = np.asarray(jax.jit(distance_field(grid))(scene)).reshape(grid.shape)
    side = [low + (np.arange(12) + 0.5) * grid.cell for low in grid.lower]
    at = np.stack(np.meshgrid(*side, indexing="ij"), axis=-1).reshape(-1, 3)
    exact = brute_force(scene.cloud.points[: scene.cloud.num].astype(float), at) - 0.01
    assert (found.ravel() <= exact + 1e-4).all()
    assert (exact - found.ravel())[exact < 0.1].max() < 0.03
    boxed = scene_from_shapes([box([0, 0, 0], [0.5] * 3)])._replace(cloud=scene.cloud)
    assert (np.asarray(jax.jit(distance_field(grid))(boxed)) <= found.ravel() + 1e-6).all()


def boxy(file, size=(0.4, 0.3, 0.2), flaw=None):
    made = trimesh.creation.box(size)
    if flaw == "open":
        made.update_faces(np.arange(len(made.faces)) > 1)
    made.export(file)
    return file


@pytest.mark.parametrize("form", ["stl", "obj", "ply"])
def test_a_closed_mesh_is_enclosed_and_filled(form, tmp_path):
    rng = np.random.default_rng(6)
    quat = [np.cos(0.3), 0, 0, np.sin(0.3)]
    turn = np.array([[np.cos(0.6), -np.sin(0.6), 0], [np.sin(0.6), np.cos(0.6), 0], [0, 0, 1]])
    file = boxy(tmp_path / f"box.{form}", np.array((0.4, 0.3, 0.2)) * 1000)
    balls = mesh(file, [0.5, 0, 0.2], quat, scale=0.001, voxel=0.01, solid=True)
    half = np.array([0.2, 0.15, 0.1])
    surface = rng.uniform(-1, 1, (300, 3))
    axis = rng.integers(3, size=300)
    surface[np.arange(300), axis] = np.sign(surface[np.arange(300), axis])
    placed = surface * half @ turn.T + [0.5, 0, 0.2]
    assert brute_force(balls.points, placed).max() <= balls.radius
    inside = rng.uniform(-1, 1, (300, 3)) * half @ turn.T + [0.5, 0, 0.2]
    assert brute_force(balls.points, inside).max() <= balls.radius + INSIDE
    own = np.abs((balls.points - [0.5, 0, 0.2]) @ turn) - half
    assert own.max() < 1e-9
    assert balls.radius <= 0.01 * 1.2
    hollow = mesh(file, [0.5, 0, 0.2], quat, scale=0.001, voxel=0.01, solid=False)
    assert brute_force(hollow.points, np.array([[0.5, 0, 0.2]]))[0] > 0.09


def test_an_open_mesh_is_its_surface_and_refused_as_a_solid(tmp_path):
    file = boxy(tmp_path / "open.stl", flaw="open")
    balls = mesh(file, voxel=0.01)
    assert brute_force(balls.points, np.zeros((1, 3)))[0] > 0.09
    with pytest.raises(InputError, match="is not closed, so that it has no inside"):
        mesh(file, solid=True)


def test_a_height_field_is_filled_down_to_its_depth():
    rng = np.random.default_rng(7)
    x = np.linspace(-0.5, 0.5, 21)
    heights = 0.1 * np.sin(6 * x)[None, :] + 0.05 * x[:11, None]
    balls = height_field(heights, (1.0, 0.4), [0, 0, 1], depth=0.2, voxel=0.01)
    across, along = rng.uniform(-0.5, 0.5, 200), rng.uniform(-0.2, 0.2, 200)
    row, column = (along + 0.2) / 0.04, (across + 0.5) / 0.05
    lattice = np.stack(np.meshgrid(np.arange(11), np.arange(21), indexing="ij"), -1).reshape(-1, 2)
    at = np.stack([x[lattice[:, 1]], -0.2 + 0.04 * lattice[:, 0]], axis=1)
    nodes = np.c_[at, 1 + heights.reshape(-1)]
    assert brute_force(balls.points, nodes).max() <= balls.radius
    below = 1 + heights[np.round(row).astype(int), np.round(column).astype(int)] - 0.08
    under = np.stack([across, along, below], axis=1)
    assert brute_force(balls.points, under).max() <= balls.radius + INSIDE
    assert balls.points[:, 2].min() == pytest.approx(1 + heights.min() - 0.2, abs=0.01)
    assert balls.points[:, 2].max() <= 1 + heights.max() + 1e-9


def test_many_triangles_take_no_longer_than_their_surface(tmp_path):
    ball = trimesh.creation.icosphere(subdivisions=7, radius=0.2)  # 327,680 faces
    balls = enclosed(ball.vertices, ball.faces, 0.01)
    assert len(balls.points) < BUCKETS[3]
    outside = np.linalg.norm(balls.points, axis=1) + balls.radius
    assert 0.2 <= outside.max() <= 0.2 + 0.02


@pytest.mark.parametrize("ending", ["npy", "npz", "ply", "pcd", "pcd.binary"])
def test_points_are_read_from_files(ending, tmp_path):
    points = np.random.default_rng(8).normal(size=(50, 3)).astype(np.float32)
    file = tmp_path / f"points.{ending.split('.')[0]}"
    if ending == "npy":
        np.save(file, np.concatenate([points, [[np.nan] * 3]]))
    elif ending == "npz":
        np.savez(file, points=points, colors=points)
    elif ending == "ply":
        trimesh.PointCloud(points).export(file)
    else:
        form = "binary" if "binary" in ending else "ascii"
        header = (
            "# .PCD v0.7\nVERSION 0.7\nFIELDS rgb x y z\nSIZE 4 4 4 4\nTYPE U F F F\n"
            "COUNT 1 1 1 1\nWIDTH 50\nHEIGHT 1\nVIEWPOINT 1 2 3 0 1 0 0\nPOINTS 50\n"
            f"DATA {form}\n"
        ).encode()
        rows = np.zeros(50, [("rgb", "<u4"), ("p", "<f4", 3)])
        rows["p"] = points
        text = "\n".join(" ".join(map(repr, [0, *p])) for p in points.tolist()).encode()
        file.write_bytes(header + (rows.tobytes() if form == "binary" else text))
    np.testing.assert_allclose(points_from_file(file), points, rtol=1e-6)
    scene = scene_from_points(file, 0.01, None)
    assert scene.cloud.num == 50
    if "pcd" in ending:  # cut off, as by a disk that was full
        file.write_bytes(file.read_bytes()[:-100])
        with pytest.raises(InputError, match=r"is no PCD file .*; save it anew"):
            points_from_file(file)


def test_scene_files_hold_clouds_meshes_and_height_fields(tmp_path):
    np.save(tmp_path / "seen.npy", np.random.default_rng(9).uniform(0.3, 0.6, (100, 3)))
    boxy(tmp_path / "box.stl")
    (tmp_path / "scene.json").write_text(
        '{"boxes": [{"center": [1, 0, 0], "half_extents": [0.1, 0.1, 0.1]}],'
        ' "clouds": [{"points": "seen.npy", "radius": 0.02, "voxel": 0.01},'
        '            {"points": [[0.9, 0.9, 0.9]]}],'
        ' "meshes": [{"file": "box.stl", "center": [1, 0, 1], "voxel": 0.02}],'
        ' "height_fields": [{"heights": [[0, 0.1], [0, 0.1]], "size": [0.2, 0.2],'
        ' "center": [-1, 0, 0], "voxel": 0.02}]}'
    )
    scene = scene_from_json(tmp_path / "scene.json")
    points = scene.cloud.points[: scene.cloud.num]
    for wanted in ([0.9, 0.9, 0.9], [1.2, 0.15, 1.1], [-1, 0, 0.05]):
        assert brute_force(points, np.array([wanted]))[0] <= scene.cloud.radius
    assert scene.mask.sum() == 1
    scene_to_json(scene, tmp_path / "again.json")
    jax.tree.map(np.testing.assert_array_equal, scene, scene_from_json(tmp_path / "again.json"))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"clouds": [{"radius": 1}]}', r"clouds 0 of .* has \['radius'\]; give points"),
        ('{"clouds": [{"points": "no.npy"}]}', "no file of points .*no.npy"),
        ('{"clouds": [{"points": [[1, 2]]}]}', r"shape \(1, 2\); give \[K, 3\]"),
        ('{"clouds": [{"points": [[1, 2, "x"]]}]}', "are not numbers"),
        ('{"clouds": [{"points": [[1, 2, 3]], "radius": "1"}]}', "radius = '1'; give a number"),
        ('{"clouds": [{"points": [[1, 2, 3]], "radus": 1}]}', "radus"),
        ('{"meshes": [{"file": 3}]}', "has file = 3; give the name of a file"),
        ('{"meshes": [{"file": "no.stl"}]}', "no mesh .*no.stl"),
        ('{"meshes": [{"file": "no.stl", "solid": 3}]}', "solid = 3; give true or false"),
        ('{"height_fields": [{"heights": "no.npy", "size": [1, 1]}]}', "which is no .npy file"),
        ('{"height_fields": [{"heights": [[1, 2]], "size": [1, 1]}]}', r"give \[R, C\], 2 x 2"),
    ],
)
def test_broken_scene_files_are_refused_in_a_sentence(text, message, tmp_path):
    (tmp_path / "scene.json").write_text(text)
    with pytest.raises(InputError, match=message):
        scene_from_json(tmp_path / "scene.json")


def test_problem_files_keep_clouds(tiny, tmp_path):
    rng = np.random.default_rng(10)
    scenes = stack_scenes([scene_from_points(draw(rng, "blob"), 0.02, None), scene_from_shapes([])])
    ends = np.zeros((2, 3), np.float32)
    problems = ProblemSet("tiny", Problem(ends, ends, scenes))
    save_problems(tmp_path / "set.npz", problems)
    loaded = load_file(tmp_path / "set.npz", tiny).problems.scene
    jax.tree.map(np.testing.assert_array_equal, scenes, loaded)
    with np.load(tmp_path / "set.npz") as file:
        arrays = dict(file)
    for name, value, message in (
        ("cloud_radii", None, "lacks \\['cloud_radii'\\]"),
        ("cloud_points", arrays["cloud_points"] * np.nan, "must be finite"),
        ("cloud_radii", -arrays["cloud_radii"] - 1, "must be positive"),
        ("num_cloud_points", arrays["num_cloud_points"] + 9999, "has room for 0 to"),
    ):
        changed = {**arrays, name: value}
        np.savez(tmp_path / "bad.npz", **{k: v for k, v in changed.items() if v is not None})
        with pytest.raises(InputError, match=message):
            load_file(tmp_path / "bad.npz", tiny)


@pytest.mark.parametrize(
    ("points", "options", "message"),
    [
        ([[0, 0, np.nan]], {}, r"point 0 of the cloud is .*, one of 1 that are not finite"),
        ([[0, 0, 1e5]], {}, "beyond 10000 m; remove these"),
        ([[0, 0]], {}, r"have shape \(1, 2\); give \[K, 3\]"),
        (np.zeros((0, 3)), {}, r"have shape \(0, 3\); give \[K, 3\], one point or more"),
        ([["x", 0, 0]], {}, "are not numbers"),
        ([[0, 0, 1]], {"radius": 0.0}, "radius of the cloud is 0.0; it must be positive"),
        ([[0, 0, 1]], {"voxel": -1.0}, "voxel of the cloud is -1.0; it must be positive"),
        ([[0, 0, 0], [9e3, 9e3, 9e3]], {"voxel": 1e-9}, "too small for points so far apart"),
    ],
)
def test_bad_points_are_refused_in_a_sentence(points, options, message):
    with pytest.raises(InputError, match=message):
        point_cloud(points, **options)


@pytest.mark.parametrize(
    ("name", "form"), [("a.ply", {"encoding": "ascii"}), ("a.off", {}), ("a.stl", {})]
)
def test_meshes_of_text_that_end_too_early_are_refused(tmp_path, name, form):
    kind = {"a.stl": "stl_ascii"}.get(name, name[2:])
    made = trimesh.creation.box((0.1, 0.1, 0.1)).export(file_type=kind, **form)
    text = made if isinstance(made, bytes) else made.encode()
    (tmp_path / name).write_bytes(text)
    assert scene_from_mesh(tmp_path / name).cloud is not None
    cut = text.rstrip()[: -len(text.rstrip().split(b"\n")[-1])]  # without the last line
    (tmp_path / name).write_bytes(cut)
    with pytest.raises(InputError, match=f"{name}' ends too early; export it again"):
        scene_from_mesh(tmp_path / name)


TETRAHEDRON = "v 0 0 0\nv .1 0 0\nv 0 1e-1 0\nv 0 0 0.1\nf 1 2 3\nf 1/1 2/1 4/1\nf 1//1 3//1 4//1\n"


@pytest.mark.parametrize(
    ("ends", "message"),
    [
        ("f 2 3 4", None),
        ("f 2/1/1 3/1/1 4/1/1 \r\n# made by hand", None),
        ("v 0.3 0 0", None),
        ("o nothing", None),
        ("f 2 3", "ends too early; export it again"),
        ("f", "ends too early"),
        ("f 2/1 3/1 4/", "ends too early"),
        ("v 0.3 0", "ends too early"),
        ("v 0.3 0 -", "ends too early"),
        ("f 2 3 9", "cannot be read"),
        ("f 2 3 0", "numbers below 1, which are misread"),
        ("f -3 -2 -1", "numbers below 1, which are misread"),
        ("f 2 3 -1\nv 0 0 1", "numbers below 1, which are misread"),
    ],
)
def test_what_is_told_of_an_obj_that_is_not_whole(tmp_path, ends, message):
    file = tmp_path / "a.obj"
    file.write_text(TETRAHEDRON + ends, newline="")
    if message is None:
        assert scene_from_mesh(file, solid=False).cloud is not None
        return
    with pytest.raises(InputError, match=message):
        scene_from_mesh(file)


def test_other_bad_input_is_refused_or_warned_of(tmp_path):
    rng = np.random.default_rng(11)
    with pytest.raises(InputError, match="clouds of 262145 points; at most 262144"):
        scene_from_points(rng.random((BUCKETS[-1] + 1, 3)), 0.01, None)
    with pytest.warns(UserWarning, match="out of its reach; are they in millimetres"):
        scene_from_points(1000 * rng.random((10, 3)) + 100)
    for content in (b"", b"solid nothing\nendsolid nothing\n"):
        (tmp_path / "bad.stl").write_bytes(content)
        with pytest.raises(InputError, match=r"mesh .*bad.stl' (cannot be read|has no faces)"):
            scene_from_mesh(tmp_path / "bad.stl")
    with pytest.raises(InputError, match="no mesh"):
        scene_from_mesh(tmp_path / "none.stl")
    with pytest.raises(InputError, match=r"scale of .* is 0"):
        scene_from_mesh(boxy(tmp_path / "box.stl"), scale=0.0)
    with pytest.raises(InputError, match=r"quat of .* is .*; give a rotation"):
        scene_from_mesh(tmp_path / "box.stl", quat=[0, 0, 0, 0])
    with pytest.raises(InputError, match="choose a larger voxel, or check its unit"):
        scene_from_mesh(tmp_path / "box.stl", scale=1000.0)
    with pytest.raises(InputError, match="must be finite"):
        scene_from_height_field([[0, np.nan], [0, 0]], (1, 1))
    (tmp_path / "a.pcd").write_bytes(b"FIELDS x y z\nPOINTS 1\nDATA binary_compressed\n")
    with pytest.raises(InputError, match="is binary_compressed; save it as ascii or binary"):
        points_from_file(tmp_path / "a.pcd")
    trimesh.creation.box().export(tmp_path / "box.ply")
    with pytest.raises(
        InputError, match=r"box.ply' has 12 faces, which points leave open; give it"
    ):
        points_from_file(tmp_path / "box.ply")
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 nan 0\nf 1 2 3\nf 2 3 4\n")
    with pytest.raises(InputError, match=r"a.obj' has vertices that are not finite"):
        scene_from_mesh(tmp_path / "a.obj")
    (tmp_path / "a.npz").write_bytes(b"PK")
    with pytest.raises(InputError, match=r"a.npz' cannot be read as points .*; save it anew by"):
        points_from_file(tmp_path / "a.npz")
    (tmp_path / "a.txt").write_text("0 0 0")
    with pytest.raises(InputError, match="is none of"):
        points_from_file(tmp_path / "a.txt")


def test_points_are_no_trouble_to_an_arm_whose_base_has_no_geometry(tiny_path, tmp_path):
    ball = '<geom type="sphere" size="0.1" contype="1" conaffinity="1"/>'
    path = tmp_path / "bare.xml"
    path.write_text(tiny_path.read_text().replace(ball, ""))
    assert base_clear(load_robot(path), scene_from_points([[0.0, 0.0, 0.0]])).all()
