"""Clouds of points, the grids that look them up and their files, against brute force."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gnnjax.collision.points import leaves_of
from gnnjax.errors import InputError
from gnnjax.problems.file import load_file, save_problems
from gnnjax.problems.problem import Problem, ProblemSet
from gnnjax.scene.batches import stack_scenes
from gnnjax.scene.cloud import BUCKETS, NODES, REACH, make_cloud, point_cloud, with_room
from gnnjax.scene.field import distance_field, make_grid
from gnnjax.scene.lookup import corners_around, lookup, squared_distance_to
from gnnjax.scene.scene import scene_from_shapes
from gnnjax.scene.shapes import box
from gnnjax.scene.surfaces import scene_from_points
from tests.clouds import KINDS, brute_force, draw


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


def test_too_many_points_are_refused_and_those_in_millimetres_warned_of():
    rng = np.random.default_rng(11)
    with pytest.raises(InputError, match="clouds of 262145 points; at most 262144"):
        scene_from_points(rng.random((BUCKETS[-1] + 1, 3)), 0.01, None)
    with pytest.warns(UserWarning, match="out of its reach; are they in millimetres"):
        scene_from_points(1000 * rng.random((10, 3)) + 100)
