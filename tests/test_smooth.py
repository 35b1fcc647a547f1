"""Rounded corners against the definition of the curve and a fine scan with MuJoCo's C engine."""

import mujoco
import numpy as np
import pytest

from gnnjax.collision.certify import certify_path
from gnnjax.collision.margins import proven_clearance
from gnnjax.errors import InputError
from gnnjax.scene.batches import stack_scenes
from gnnjax.scene.scene import make_scene
from gnnjax.trajectory.curve import (
    blend_chords,
    edges_of,
    make_curve,
    places,
    size_of,
    stray,
)
from gnnjax.trajectory.smooth import smooth_paths
from gnnjax.trajectory.trajectory import time_path
from tests.fine_scan import collides_anywhere, random_scene

NOTHING = make_scene([], [])


def certified_paths(robot, number, obstacles=5, seed=0):
    """Certified paths of three to five configurations, each in a scene of its own."""
    rng, found = np.random.default_rng(seed), []
    while len(found) < number:
        scene = random_scene(rng, num=obstacles)
        steps = rng.normal(scale=0.5, size=(rng.integers(3, 6), robot.num_dof))
        path = np.clip(np.cumsum(steps, axis=0), 0.95 * robot.joint_lower, 0.95 * robot.joint_upper)
        if certify_path(robot, scene, path):
            found.append((scene, path))
    return found


def curve_of(smooth):
    return make_curve(smooth.path, smooth.blends, size_of(smooth.path))


def test_certified_curves_are_free_in_a_fine_scan_and_corners_are_rounded(tiny):
    for scene, path in certified_paths(tiny, 40, obstacles=12):
        (smooth,) = smooth_paths(tiny, scene, [path], blend=1.0)
        assert smooth.certified
        curve = curve_of(smooth)
        fine = places(curve, np.linspace(0, len(curve.grid) - 1, 1500)).q
        assert not collides_anywhere(tiny, scene, fine, step=0.01)
        assert (smooth.blends > 0).all()


def test_a_corner_is_rounded_less_the_nearer_an_obstacle_is_inside(tiny):
    path = np.array([[-1.5, 1.2, 0.0], [0.0, -0.6, 0.0], [1.5, 1.2, 0.0]])
    curve = make_curve(path, np.array([1.0]), 2)
    middle = places(curve, np.array([(curve.entries[0] + curve.exits[0]) / 2])).q[0]
    corner, inside = (tip(tiny, q) for q in (path[1], middle))
    widths = []
    for far in (4.0, 2.0, 1.5, 1.2):  # of the way from the corner to where the blend takes the tip
        scene = make_scene([corner + far * (inside - corner)], [[0.01] * 3])
        (smooth,) = smooth_paths(tiny, scene, [path], blend=1.0)
        assert smooth.certified
        widths.append(smooth.blends[0])
        fine = curve_of(smooth)
        q = places(fine, np.linspace(0, len(fine.grid) - 1, 1500)).q
        assert not collides_anywhere(tiny, scene, q)
    assert widths[0] == 1.0
    assert (np.diff(widths) < 0).all()


def tip(robot, q):
    """Where the last ball of the arm is."""
    data = mujoco.MjData(robot.mj_model)
    data.qpos[:] = q
    mujoco.mj_kinematics(robot.mj_model, data)
    return data.geom_xpos[-1].copy()


def test_where_no_blend_is_certified_the_motion_stops(tiny, monkeypatch):
    path = np.array([[-1.5, 1.2, 0.0], [0.0, -0.6, 0.0], [1.5, 1.2, 0.0]])
    corner, lower = tip(tiny, path[1]), tip(tiny, path[1] + [0, 0.01, 0])
    inside = (lower - corner) / np.linalg.norm(lower - corner)
    scene = make_scene([corner + 0.13 * inside], [[0.01] * 3])
    (smooth,) = smooth_paths(tiny, scene, [path], blend=1.0)
    assert 0 < smooth.blends[0] < 1
    monkeypatch.setattr("gnnjax.trajectory.smooth._HALVINGS", 0)
    found = time_path(tiny, scene, path, velocity=1.0, acceleration=1.0)
    assert found.success
    assert found.certified
    assert found.stops == 1
    corner = np.flatnonzero(found.curve.stops)[1]
    np.testing.assert_array_equal(found.timing.x[[corner, corner + 1]], 0)
    np.testing.assert_allclose(places(found.curve, np.array([float(corner)])).q[0], path[1])


def test_the_curve_is_as_smooth_as_it_says():
    rng = np.random.default_rng(0)
    path = rng.normal(size=(5, 3))
    half = edges_of(path)[0] / 2
    blends = np.minimum(half[:-1], half[1:])
    curve = make_curve(path, blends, size_of(path))
    at = np.linspace(0, len(curve.grid) - 1, 40_001)
    s = np.interp(at, np.arange(len(curve.grid)), curve.grid)
    place = places(curve, at)
    steps = np.diff(s)[:, None]
    for value, slope in ((place.q, place.slope), (place.slope, place.bend)):
        middle = (slope[1:] + slope[:-1]) / 2
        np.testing.assert_allclose(np.diff(value, axis=0), middle * steps, atol=1e-6)
    # No second derivative leaps.
    assert np.abs(np.diff(place.bend, axis=0)).max() < 0.02 * np.abs(place.bend).max()
    apart = np.linalg.norm(place.q[:, None] - path[1:-1], axis=2).min(axis=0)
    np.testing.assert_allclose(apart, stray(path, blends), rtol=1e-4)


def test_the_curve_is_as_near_to_its_chords_as_they_say():
    rng = np.random.default_rng(1)
    tightest = 0.0
    for _ in range(50):
        path = rng.normal(size=(3, 4))
        blend = edges_of(path)[0].min() / 2
        points, slack = blend_chords(path, np.array([1]), np.array([blend]), 8)
        curve = make_curve(path, np.array([blend]), 2)
        at = np.linspace(curve.entries[0], curve.exits[0], 8 * 50 + 1)
        q = places(curve, at).q
        np.testing.assert_allclose(points[0], q[::50], atol=1e-12)
        w = np.linspace(0, 1, 51)[:, None]
        for k in range(8):
            chord = (1 - w) * points[0, k] + w * points[0, k + 1]
            off = np.abs(q[50 * k : 50 * k + 51] - chord).max(axis=0)
            assert (off <= slack[0, k] + 1e-12).all()
            tightest = max(tightest, (off / slack[0, k]).max())
    assert tightest > 0.8


def test_paths_in_scenes_of_their_own_are_rounded_as_alone(tiny):
    scenes, paths = zip(*certified_paths(tiny, 12, obstacles=9, seed=3), strict=True)
    together = smooth_paths(tiny, stack_scenes(scenes), list(paths), blend=0.5)
    for scene, path, found in zip(scenes, paths, together, strict=True):
        (alone,) = smooth_paths(tiny, scene, [path], blend=0.5)
        np.testing.assert_array_equal(found.blends, alone.blends)
        assert found.certified == alone.certified


def test_blends_of_paths_that_are_certified_already_are_the_same(tiny):
    for scene, path in certified_paths(tiny, 6, obstacles=9, seed=3):
        found, again = (
            smooth_paths(tiny, scene, [path], blend=0.5, proven=proven)[0]
            for proven in (False, True)
        )
        np.testing.assert_array_equal(found.blends, again.blends)
        assert again.certified


def test_a_path_that_collides_is_not_timed(tiny):
    scene = make_scene([[0.6, 0.0, 0.0]], [[0.1, 0.1, 0.1]])
    path = [[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.5, 0.0, 0.0]]
    found = time_path(tiny, scene, path, velocity=1.0, acceleration=1.0)
    assert not found.success
    assert not found.certified
    assert found.reason == "the path is not certified free of collisions; plan another one"


def test_a_path_beyond_joint_limits_is_not_timed_and_says_which(tiny):
    path = [[0.0, 0.0, 0.0], [1.0, 0.0, 3.5]]
    found = time_path(tiny, make_scene([], []), path, velocity=1.0, acceleration=1.0)
    assert not found.certified
    said = "the path has joint c at 3.5, beyond its limits -2 to 2"
    assert found.reason == f"{said}; plan another one"
    with pytest.raises(InputError, match=f"{said}, so that it has no clearance"):
        proven_clearance(tiny, make_scene([], []), path)


def test_the_curve_keeps_the_margin_too(tiny):
    scene, path = certified_paths(tiny, 1, seed=4)[0]
    wide = time_path(tiny, scene, path, velocity=1.0, acceleration=1.0)
    assert wide.success
    assert wide.cost <= wide.cost_before
    far = time_path(tiny, scene, path, velocity=1.0, acceleration=1.0, margin=2.0)
    assert not far.certified
