"""Motions in time: their limits on a fine scan, their durations against closed forms and a dense
search in the phase plane."""

import jax
import numpy as np
import pytest

from experiments.by_toppra import duration_by_toppra
from gnnjax.arm.robot import load_robot
from gnnjax.arm.torques import inverse_dynamics_by_mujoco
from gnnjax.clock import Clock
from gnnjax.collision.clearances import clearances
from gnnjax.collision.margins import proven_clearance
from gnnjax.errors import InputError
from gnnjax.scene.scene import make_scene
from gnnjax.scene.shapes import sphere
from gnnjax.trajectory import moves
from gnnjax.trajectory.batches import over_curves
from gnnjax.trajectory.curve import distinct, edges_of, make_curve, places, size_of
from gnnjax.trajectory.jerk import Profile
from gnnjax.trajectory.limits import limits_of
from gnnjax.trajectory.smooth import Smoothed
from gnnjax.trajectory.states import largest_use, movement, sample_trajectory
from gnnjax.trajectory.timing import Timing
from gnnjax.trajectory.trajectory import time_path, time_paths
from tests.conftest import TINY

NOTHING = make_scene([], [])
# Of the tiny arm, which weighs about 3 kg and needs up to 8 N m to be held.
SPEEDS, PUSHES, TORQUES = [2.0, 1.5, 3.0], [6.0, 4.0, 9.0], [20.0, 14.0, 6.0]


@pytest.fixture(scope="module")
def free(tmp_path_factory):
    """The tiny arm, whose links may touch, so that all paths are certified."""
    path = tmp_path_factory.mktemp("robots") / "free.xml"
    path.write_text(
        TINY.replace('contype="1" conaffinity="1"', 'contype="0" conaffinity="0"', 1).replace(
            "<worldbody>",
            '<contact><exclude body1="upper" body2="lower"/></contact><worldbody>',
            1,
        )
    )
    return load_robot(path)


def random_paths(robot, number, seed=0):
    rng = np.random.default_rng(seed)
    span = 0.9 * robot.joint_lower, 0.9 * robot.joint_upper
    return [rng.uniform(*span, (rng.integers(2, 7), robot.num_dof)) for _ in range(number)]


@pytest.mark.parametrize("torque", [None, TORQUES])
@pytest.mark.parametrize("blend", [0.0, 0.4])
def test_limits_hold_between_grid_points_and_one_is_always_reached(free, torque, blend):
    limits = limits_of(free, velocity=SPEEDS, acceleration=PUSHES, torque=torque)
    paths = random_paths(free, 100)
    found = time_paths(free, NOTHING, paths, **limits._asdict(), blend=blend)
    assert all(x.success and x.certified for x in found), [x.reason for x in found]
    shares = [largest_use(free, limits, x) for x in found]
    assert max(shares) < 1.001
    assert min(shares) > 0.98
    assert [x.stops for x in found] == [0 if blend else len(path) - 2 for path in paths]


@pytest.mark.parametrize(("blend", "jerk"), [(0.0, [60, 40, 90]), (0.4, [60, 40, 90]), (0.4, 900)])
def test_jerk_is_limited_and_all_else_too(free, blend, jerk):
    limits = limits_of(free, velocity=SPEEDS, acceleration=PUSHES, torque=TORQUES, jerk=jerk)
    paths = [path[:4] for path in random_paths(free, 4)]
    found = time_paths(free, NOTHING, paths, **limits._asdict(), blend=blend)
    assert all(x.success for x in found), [x.reason for x in found]
    shares = [largest_use(free, limits, x) for x in found]
    assert max(shares) < 1.001
    assert min(shares) > 0.95
    if not blend:  # however near to a stop, the arm is on its side of the corner
        _, _, pushes = movement(found[0], np.arange(0, found[0].duration, 1e-5))
        assert (np.abs(np.diff(pushes, axis=0)) < 1.001e-5 * limits.jerk).all()
    longer = [x.duration / x.timing.times[-1] for x in found]
    assert 1 < min(longer)
    assert max(longer) < (1.6 if jerk != 900 else 1.05)


def test_a_straight_line_with_jerk_takes_as_long_as_the_closed_form(tiny):
    way = 2.5
    direction = np.array([0.6, 0.5, -0.3])
    path, jerk = np.array([[0.0, 0.0, 0.0], way * direction]), np.array(PUSHES) * 10
    limits = {"velocity": SPEEDS, "acceleration": PUSHES, "jerk": jerk}
    found = time_path(tiny, NOTHING, path, **limits)
    speed, push, leap = (np.min(x / np.abs(direction)) for x in (SPEEDS, PUSHES, jerk))
    assert found.duration == pytest.approx(trapezoid(way, speed, push) + push / leap, rel=3e-3)
    points = sample_trajectory(tiny, found, 0.01)
    np.testing.assert_allclose(points.positions[[0, -1]], path, atol=1e-9)
    np.testing.assert_allclose(points.accelerations[[0, -1]], 0, atol=1e-6)


def test_an_arm_that_only_swings_past_a_place_is_too_weak_for_little_jerk(tiny):
    path = np.array([[0.0, 0.7, 0.0], [0.0, -0.7, 0.0]])
    needed = np.abs(inverse_dynamics_by_mujoco(tiny, np.zeros((1, 3)), *np.zeros((2, 1, 3))))[0, 1]
    limits = {"velocity": 9.0, "acceleration": 40.0, "torque": [50, 0.97 * needed, 50]}
    assert time_path(tiny, NOTHING, path, **limits).success
    found = time_path(tiny, NOTHING, path, **limits, jerk=1.0)
    assert not found.success
    assert found.duration == np.inf
    assert found.reason.startswith("slow enough for the limits of jerk, joint b needs")


def test_limits_hold_for_a_shipped_arm():
    robot = load_robot("kuka_iiwa14")
    limits = limits_of(robot, acceleration=8.0, torque=robot.torque_limit * 0.45)
    rng = np.random.default_rng(1)
    paths = [
        robot.home + np.cumsum(rng.normal(scale=0.3, size=(5, robot.num_dof)), 0) for _ in range(16)
    ]
    found = [x for x in time_paths(robot, NOTHING, paths, **limits._asdict()) if x.certified]
    assert len(found) > 5
    assert all(x.success for x in found)
    assert max(largest_use(robot, limits, x) for x in found) < 1.001


def trapezoid(way, speed, push):
    """Seconds of a motion from rest to rest."""
    return 2 * np.sqrt(way / push) if way < speed**2 / push else way / speed + speed / push


@pytest.mark.parametrize("way", [0.05, 0.7, 2.5])
def test_a_straight_line_takes_as_long_as_the_closed_form(tiny, way):
    direction = np.array([0.6, 0.5, -0.3])
    path = np.array([[0.0, 0.0, 0.0], way * direction])
    limits = limits_of(tiny, velocity=SPEEDS, acceleration=PUSHES)
    speed, push = (np.min(x / np.abs(direction)) for x in limits[:2])
    found = time_path(tiny, NOTHING, path, velocity=SPEEDS, acceleration=PUSHES)
    assert found.duration == pytest.approx(trapezoid(way, speed, push), rel=2e-3)
    assert found.duration >= trapezoid(way, speed, push) * (1 - 1e-9)


def test_a_motion_stops_at_corners_that_are_not_rounded(free):
    path = random_paths(free, 5, seed=3)[-1]
    limits = limits_of(free, velocity=SPEEDS, acceleration=PUSHES)
    whole = time_path(free, NOTHING, path, **limits._asdict(), blend=0.0)
    lengths, directions = edges_of(path)
    apart = [
        trapezoid(way, *(np.min(x / np.abs(to)) for x in limits[:2]))
        for way, to in zip(lengths, directions, strict=True)
    ]
    assert whole.stops == len(path) - 2
    assert whole.duration == pytest.approx(sum(apart), rel=5e-3)
    assert whole.duration > time_path(free, NOTHING, path, **limits._asdict()).duration


def searched(robot, limits, curve, fine=1500):
    """Duration by integration in the phase plane: the largest speeds from which the end can be
    reached on a dense grid, by bisection of x, with u from the limits at both ends of a step."""
    number = len(curve.grid) - 1
    at = np.linspace(0, number, fine + 1)
    place = places(curve, at)
    s = np.interp(at, np.arange(number + 1), curve.grid)
    still = np.zeros_like(place.q)

    def torques(v, a):
        return inverse_dynamics_by_mujoco(robot, place.q, v, a)

    rest = torques(still, still)
    inertia = torques(still, place.slope) - rest
    speed = torques(place.slope, place.bend) - rest  # the tiny arm has no damping
    a = np.concatenate([place.slope, inertia], 1)
    b = np.concatenate([place.bend, speed], 1)
    top = np.concatenate([np.tile(limits.acceleration, (fine + 1, 1)), limits.torque - rest], 1)
    low = np.concatenate([np.tile(-limits.acceleration, (fine + 1, 1)), -limits.torque - rest], 1)
    ceiling = ((limits.velocity / np.maximum(np.abs(place.slope), 1e-9)) ** 2).min(1)

    def least_and_most(i, x):
        """u at point i for many x `[X]`."""
        safe = np.where(np.abs(a[i]) < 1e-9, 1e-9, a[i])
        one, two = (top[i] - b[i] * x[:, None]) / safe, (low[i] - b[i] * x[:, None]) / safe
        return np.minimum(one, two).max(1), np.maximum(one, two).min(1)

    reach = np.zeros(fine + 1)
    for i in reversed(range(fine)):
        x, step = np.linspace(0, 1, 801), s[i + 1] - s[i]
        lower, upper = 0.0, min(ceiling[i], 1e4)
        for _ in range(2):  # finer about the largest that leads on
            tried = lower + x * (upper - lower)
            least, most = least_and_most(i, tried)
            good = (least <= most) & (tried + 2 * step * least <= reach[i + 1])
            k = np.flatnonzero(good)[-1]
            lower, upper = tried[k], tried[min(k + 1, 800)]
        reach[i] = lower
    speeds = np.zeros(fine + 1)
    for i in range(fine):
        _, most = least_and_most(i, speeds[i : i + 1])
        speeds[i + 1] = min(speeds[i] + 2 * (s[i + 1] - s[i]) * most[0], reach[i + 1])
    return float((2 * np.diff(s) / (np.sqrt(speeds[1:]) + np.sqrt(speeds[:-1]))).sum())


@pytest.mark.parametrize("number", [0, 3])
def test_durations_are_those_of_a_dense_search(free, number):
    limits = limits_of(free, velocity=SPEEDS, acceleration=PUSHES, torque=TORQUES)
    path = random_paths(free, 8, seed=5)[number]
    found = time_path(free, NOTHING, path, **limits._asdict())
    assert found.stops == 0
    assert found.duration == pytest.approx(searched(free, limits, found.curve), rel=0.01)


def test_durations_are_those_of_toppra(free):
    limits = limits_of(free, velocity=SPEEDS, acceleration=PUSHES)
    found = time_paths(free, NOTHING, random_paths(free, 100), **limits._asdict(), blend=0.4)
    for motion in found[:20]:
        theirs = duration_by_toppra(motion.curve, limits)
        assert theirs is not None
        assert motion.duration == pytest.approx(theirs, rel=0.01)
    weaker = limits._replace(acceleration=limits.acceleration / 2)
    assert duration_by_toppra(found[0].curve, weaker) > 1.1 * found[0].duration


@pytest.mark.parametrize("backend", ["cpu", "gpu"])  # which computes many curves at once
def test_a_batch_is_what_its_paths_are_alone(free, monkeypatch, backend):
    limits = limits_of(free, velocity=SPEEDS, acceleration=PUSHES, torque=TORQUES, jerk=60)
    limits = limits._asdict()
    paths = random_paths(free, 6)
    assert {size_of(path) for path in paths} == {2, 4}
    if backend == "gpu":  # each size of which is compiled for seconds
        paths = [path for path in paths if size_of(path) == 2]
    alone = [time_path(free, NOTHING, path, **limits) for path in paths]
    monkeypatch.setattr("gnnjax.trajectory.batches.platform", lambda: backend)
    together = time_paths(free, NOTHING, paths, **limits)
    for one, other in zip(together, alone, strict=True):
        np.testing.assert_allclose(one.timing.times, other.timing.times, rtol=1e-9)
        np.testing.assert_allclose(one.profile.times, other.profile.times, rtol=1e-9)
        assert (one.cost, one.stops) == (other.cost, other.stops)


def test_curves_of_each_size_are_stacked_and_come_back_in_order(monkeypatch):
    asked = []

    @jax.jit
    def together(factor, row):
        asked.append(row["a"].shape)
        return {"sum": factor * row["a"].sum(axis=1)}

    sizes = [2, 4, 2, 2, 4, 8]
    rows = [{"a": np.arange(size) + 10.0 * i} for i, size in enumerate(sizes)]
    monkeypatch.setattr("gnnjax.trajectory.batches.platform", lambda: "gpu")
    found = over_curves(together, together, np.array(3.0), rows, sizes, Clock())
    assert [x["sum"] for x in found] == [3 * row["a"].sum() for row in rows]
    assert sorted(asked) == [(1, 8), (2, 4), (4, 2)]  # padded to powers of two


def test_states_are_those_of_one_smooth_motion(free):
    limits = limits_of(free, velocity=SPEEDS, acceleration=PUSHES, torque=TORQUES)
    path = random_paths(free, 8, seed=5)[3]
    found = time_path(free, NOTHING, path, **limits._asdict())
    points = sample_trajectory(free, found, 1e-4)
    np.testing.assert_allclose(points.positions[[0, -1]], path[[0, -1]], atol=1e-9)
    np.testing.assert_allclose(points.velocities[[0, -1]], 0, atol=1e-6)
    assert points.times[-1] == found.duration
    steps = np.diff(points.times)[:-1, None]  # the last one is shorter
    gone = np.diff(points.positions, axis=0)[:-1] / steps
    mean = (points.velocities[1:] + points.velocities[:-1])[:-1] / 2
    np.testing.assert_allclose(gone, mean, atol=2e-3)
    faster = np.abs(np.diff(points.velocities, axis=0)[:-1] / steps)
    assert (faster <= limits.acceleration * 1.001).all()


def test_the_clearance_of_a_curve_is_that_of_a_scan(free):
    limits = limits_of(free, velocity=SPEEDS, acceleration=PUSHES, torque=TORQUES)._asdict()
    scene = make_scene([[0.7, 0.0, -0.4]], [[0.05] * 3])
    paths = [
        [[-1.0, 0, 0], [0.0, 0.2, 0.5], [1.0, 0, 0]],
        [[-1.0, 0, 0], [0.0, 0.5, 0], [1.0, 0, 0]],
    ]
    for path, found in zip(
        paths, time_paths(free, scene, paths, **limits, clearance=True), strict=True
    ):
        q = places(found.curve, np.linspace(0, len(found.curve.grid) - 1, 1000)).q
        least = min(clearances(free, scene, q).min(), 0.25)
        assert least - 3e-3 <= found.clearance <= least + 1e-5
        assert found.clearance_before == proven_clearance(free, scene, path)
        assert abs(found.clearance - found.clearance_before) > 5e-3


@pytest.mark.parametrize("path", [np.zeros((1, 3)), np.zeros((4, 3))])
def test_a_path_that_stays_takes_no_time(tiny, path):
    limits = {"velocity": 1.0, "acceleration": 1.0, "torque": 50.0}
    assert time_path(tiny, NOTHING, path, **limits, jerk=9.0).duration == 0
    found = time_path(tiny, NOTHING, path, **limits)
    assert found.success
    assert found.duration == 0
    points = sample_trajectory(tiny, found, 0.01)
    np.testing.assert_array_equal(points.positions, np.zeros((1, 3)))
    weak = time_path(tiny, NOTHING, path, **limits | {"torque": 0.1})
    assert not weak.success
    assert "to hold the arm at the start and has 0.1" in weak.reason


def test_repeated_points_do_not_stop_a_motion(free):
    limits = limits_of(free, velocity=SPEEDS, acceleration=PUSHES)._asdict()
    path = random_paths(free, 5, seed=3)[-1]
    twice = np.repeat(path, 3, axis=0)
    np.testing.assert_array_equal(distinct(twice), path)
    alone, many = (time_path(free, NOTHING, p, **limits) for p in (path, twice))
    assert many.duration == alone.duration


@pytest.mark.parametrize("apart", [1e-13, 1e-9])
def test_points_that_are_almost_the_same_do_not_hinder_a_motion(free, apart):
    start, corner, goal = np.array([[0.3, -0.5, 0.2], [-0.8, 0.6, 0.4], [0.5, 0.7, -0.6]])
    limits = limits_of(free, velocity=SPEEDS, acceleration=PUSHES, torque=TORQUES)._asdict()
    twice = [start, corner, corner + apart, goal]
    for jerk in (None, 80.0):
        options = limits | {"jerk": jerk}
        stopping = time_path(free, NOTHING, [start, corner, goal], **options, blend=0.0)
        for blend in (0.0, 1.0):
            found = time_path(free, NOTHING, twice, **options, blend=blend)
            assert found.success, found.reason
            assert found.duration < stopping.duration + 0.02


def test_a_motion_of_little_jerk_stops_where_that_is_faster_than_a_narrow_corner(free):
    path = random_paths(free, 5, seed=3)[-1]
    given = {"velocity": SPEEDS, "acceleration": PUSHES, "torque": TORQUES, "jerk": 80.0}
    narrow, stopping = (time_path(free, NOTHING, path, **given, blend=x) for x in (1e-3, 0.0))
    assert narrow.duration == pytest.approx(stopping.duration)
    assert narrow.stops == len(path) - 2
    assert narrow.cost == pytest.approx(narrow.cost_before)
    wide = time_path(free, NOTHING, path, **given)
    assert wide.stops == 0
    assert wide.duration < narrow.duration
    # One that is narrow among wide ones is the only one that is stopped at.
    mixed = np.insert(path, 1, path[0] + [1e-4, 0, 0], axis=0)
    found = time_path(free, NOTHING, mixed, **given)
    assert found.stops == 1
    assert found.duration < wide.duration + 0.3
    assert largest_use(free, limits_of(free, **given), found) < 1.001


def test_stops_are_those_between_which_any_motion_is_the_fastest():
    path = np.stack([np.arange(5.0), np.arange(5.0) ** 2, np.zeros(5)], axis=1)
    along = np.concatenate([[0.0], np.cumsum(edges_of(path)[0])])

    def moving(stops, lasts):
        blends = np.full(3, 0.2)
        blends[np.array(stops, int) - 1] = 0.0
        curve, zeros = make_curve(path, blends, 4), np.zeros(len(lasts))
        profile = Profile(np.cumsum([0.0, *lasts]), along[[0, *stops]], zeros, zeros, zeros)
        still = Timing(curve.grid, curve.grid[1:], curve.grid, np.array(-1))
        return moves.Move(Smoothed(path, blends, True), curve, still, profile)

    found = [moving([], [20.0]), moving([2], [2.0, 6.0]), moving([1, 2, 3], [3.0, 3.0, 1.0, 1.0])]
    (mixed,) = moves._best_stops(found)
    np.testing.assert_array_equal(mixed.blends, [0.2, 0.0, 0.0])  # 2, 1 and 1 s
    assert moves._best_stops(found[:2]) == []  # the second one itself
    assert moves._best_stops([found[0]._replace(profile=None)]) == []


def test_a_path_that_turns_back_is_followed(free):
    path = np.array([[0.0, 0.0, 0.0], [1.0, 0.5, 0.2], [0.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    limits = limits_of(free, velocity=SPEEDS, acceleration=PUSHES, torque=TORQUES)
    for blend in (0.0, 0.3):
        found = time_path(free, NOTHING, path, **limits._asdict(), blend=blend)
        assert found.success
        assert largest_use(free, limits, found) < 1.001


def test_an_arm_that_cannot_hold_what_it_carries_is_told_so(tiny):
    path = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    limits = {"velocity": SPEEDS, "acceleration": PUSHES, "torque": TORQUES}
    assert time_path(tiny, NOTHING, path, **limits).success
    held = tiny.attach("lower", [sphere([0.3, 0, 0], 0.03)], mass=5.0)
    found = time_path(held, NOTHING, path, **limits)
    assert not found.success
    assert found.duration == np.inf
    needed = np.abs(inverse_dynamics_by_mujoco(held, path[:1], *np.zeros((2, 1, 3)))[0, 2])
    assert needed > TORQUES[2]
    assert found.reason == (
        f"joint c needs {needed:.4g} N m to hold the arm at the start and has 6; carry less, or "
        "plan elsewhere"
    )
    with pytest.raises(InputError, match="there is no motion to sample: joint c needs"):
        sample_trajectory(held, found, 0.01)


def test_an_arm_too_weak_on_its_way_is_told_where(tiny):
    # Upright at both ends, stretched out in between.
    path = np.array([[0.0, -1.5, 0.0], [0.0, 0.0, 0.0], [0.0, -1.5, 0.3]])
    needed = np.abs(inverse_dynamics_by_mujoco(tiny, path, *np.zeros((2, 3, 3))))
    limits = {"velocity": 1.0, "acceleration": 1.0, "torque": [50, needed[1, 1] * 0.6, 50]}
    found = time_path(tiny, NOTHING, path, **limits)
    assert not found.success
    assert "joint b needs" in found.reason
    assert "% along the path (grid point" in found.reason


@pytest.mark.parametrize(
    ("path", "message"),
    [
        (np.zeros((0, 3)), r"path has shape \(0, 3\); tiny needs \[L, 3\], one configuration"),
        (np.zeros((2, 4)), r"path has shape \(2, 4\)"),
        (np.full((2, 3), np.nan), "path holds what is no finite number"),
    ],
)
def test_paths_that_are_none_are_refused(tiny, path, message):
    with pytest.raises(InputError, match=message):
        time_path(tiny, NOTHING, path, velocity=1.0, acceleration=1.0)


def test_paths_may_be_one_array(tiny):
    paths = np.array([[[0.0, 0, 0], [0.3, 0, 0]], [[0.0, 0, 0], [0, 0.2, 0.1]]])
    found = time_paths(tiny, NOTHING, paths, velocity=1.0, acceleration=1.0)
    alone = [time_path(tiny, NOTHING, path, velocity=1.0, acceleration=1.0) for path in paths]
    assert [x.duration for x in found] == [x.duration for x in alone]
    assert time_paths(tiny, NOTHING, paths[:0], velocity=1.0, acceleration=1.0) == []


@pytest.mark.parametrize("dt", [0.0, -1.0, np.nan, 1e-12])
def test_steps_that_are_none_are_refused(tiny, dt):
    found = time_path(tiny, NOTHING, [[0, 0, 0], [1, 0, 0]], velocity=1.0, acceleration=1.0)
    with pytest.raises(InputError, match="give a step in seconds"):
        sample_trajectory(tiny, found, dt)


@pytest.mark.parametrize("short", [1e-6, 1e-7])
def test_jerk_is_limited_where_two_points_nearly_are_one(tiny, short):
    path = [[0.0, 0.0, 0.0], [0.0, short, 0.0], [1.2, short, 1.0]]
    found = time_path(tiny, NOTHING, path, velocity=1.0, acceleration=5.0, jerk=1.0, torque=1e3)
    seen = sample_trajectory(tiny, found, 1e-3)
    leaps = np.abs(np.diff(seen.accelerations, axis=0))[:-1] / 1e-3
    assert leaps.max() < 1.01
