"""Covers: spheres that hold all of a hull, kept once they are fitted, shown and saved."""

import subprocess
import sys

import mujoco
import numpy as np
import pytest

from gnnjax.arm import covers
from gnnjax.arm.covers import OVERSHOOT, cover_parts
from gnnjax.arm.fit import Hull, fit_covers, grown
from gnnjax.arm.parts import Part
from gnnjax.arm.robot import load_robot
from gnnjax.errors import InputError
from gnnjax.fit import FitConfig, fit

HULLS = "tests/data/kuka_iiwa14_hulls.npz"


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr("gnnjax.arm.covers._MOST", 4)  # spheres, for speed
    return tmp_path / "cache" / "gnnjax" / "covers"


@pytest.fixture(scope="module", autouse=True)
def fitted_once():
    """What is fitted to the same vertices is the same, and takes its time once."""
    fitted = {}

    def fit_once(vertices, **settings):
        key = vertices.tobytes(), *settings.items()
        if key not in fitted:
            fitted[key] = fit_covers(vertices, **settings)
        return fitted[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(covers, "fit_covers", fit_once)
        yield


def shapes():
    rng = np.random.default_rng(0)
    box = np.stack(np.meshgrid((-0.2, 0.2), (-0.05, 0.05), (-0.1, 0.1)), axis=-1).reshape(-1, 3)
    around = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    ring = 0.06 * np.stack([np.cos(around), np.sin(around), 0 * around], axis=1)
    return {
        "box": box,
        "rod": np.concatenate([ring, ring + np.array([0, 0, 0.5])]),
        "stones": rng.normal(scale=0.05, size=(300, 3)),
        "speck": rng.normal(scale=0.001, size=(10, 3)),
        "plate": np.array([(0, 0, 0), (0.1, 0, 0), (0, 0.1, 0), (0.1, 0.1, 0)]),
        "point": np.zeros((1, 3)),
    }


@pytest.mark.parametrize("name", shapes())
def test_every_point_of_a_hull_is_in_some_sphere(name):
    vertices, rng = shapes()[name], np.random.default_rng(1)
    weights = rng.dirichlet(np.full(len(vertices), 0.2), 20_000)
    inside = np.concatenate([weights @ vertices, vertices])
    for cover in fit_covers(vertices, overshoot=0.01, most=6):
        distances = np.linalg.norm(inside[:, None] - cover.centers, axis=2)
        assert (distances <= cover.radii).any(axis=1).all()
        # Inner balls are inside: no support of theirs is above that of the hull.
        normals = rng.normal(size=(2000, 3))
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        highest = (normals @ vertices.T).max(axis=1)[:, None]
        deep = cover.depths > 2e-4
        assert (normals @ cover.centers[deep].T + cover.depths[deep] <= highest + 2e-4).all()


def test_spheres_reach_less_far_the_more_there_are():
    covers = fit_covers(shapes()["box"], overshoot=0.0, most=12)
    over = [cover.overshoot for cover in covers]
    assert over == sorted(over, reverse=True)
    assert over[0] > 0.15
    assert over[-1] < 0.05
    (enough,) = fit_covers(shapes()["speck"], overshoot=0.01, most=12)
    assert len(enough.radii) == 1


def test_a_link_of_a_real_arm_needs_few_spheres():
    with np.load(HULLS) as data:
        last = fit_covers(data["link_6"], overshoot=0.015, most=8)[-1]
    assert len(last.radii) <= 8
    assert last.overshoot < 0.016


def test_holes_between_spheres_are_closed():
    hull = Hull(shapes()["box"])
    centers = np.array([(-0.1, 0.0, 0.0), (0.1, 0.0, 0.0)])
    radii = grown(hull, centers, np.array([0.13, 0.14]))
    # Each has to hold a half of the box.
    half = np.linalg.norm([0.1, 0.05, 0.1])
    assert radii.max() >= half - 1e-9
    points = np.random.default_rng(0).uniform((-0.2, -0.05, -0.1), (0.2, 0.05, 0.1), (10_000, 3))
    assert (np.linalg.norm(points[:, None] - centers, axis=2) <= radii).any(axis=1).all()
    np.testing.assert_array_equal(grown(hull, centers, radii), radii)


def test_the_depth_is_the_distance_to_the_nearest_face():
    hull = Hull(shapes()["box"])
    points = np.array([(0, 0, 0), (0.19, 0, 0), (0, 0.06, 0)], float)
    np.testing.assert_allclose(hull.depth(points), [0.05, 0.01, -0.01])


@pytest.mark.parametrize("vertices", [np.empty((0, 3)), np.full((4, 3), np.nan)])
def test_hulls_of_nothing_are_refused(vertices):
    with pytest.raises(InputError, match="needs vertices, and all of them finite"):
        fit_covers(vertices, overshoot=0.01, most=2)


def test_many_points_need_little_memory():
    code = (
        "import resource, numpy as np\n"
        "from gnnjax.arm.fit import fit_covers\n"
        "points = np.random.default_rng(0).normal(size=(200_000, 3))\n"
        "points *= 0.1 / np.linalg.norm(points, axis=1, keepdims=True)\n"
        "points = np.concatenate([points[:3000], points * 0.99])\n"
        "before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "fit_covers(points, overshoot=0.002, most=3)\n"
        "print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) // 1024)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert int(done.stdout) < 512  # MB


def parts():
    ball = Part("ball", 0, np.array([(0.0, 0.0, 0.1)]), 0.05)
    stick = Part("stick", 1, np.array([(0.0, 0.0, 0.0), (0.0, 0.2, 0.0)]), 0.03)
    return [
        ball,
        Part("box", 1, shapes()["box"], 0.0),
        stick,
        Part("round", 2, shapes()["box"], 0.02),
    ]


def test_round_parts_cover_themselves_and_others_are_fitted():
    rows = cover_parts(parts())
    (ball,) = np.flatnonzero(rows.parts == 0)
    assert rows.radii[ball] == rows.inner_radii[ball] == 0.05
    # A capsule is a chain along its axis, whose spheres hold it and hardly more.
    own = rows.parts == 2
    stick = parts()[2]
    np.testing.assert_array_equal(rows.inner_radii[own], stick.radius)
    np.testing.assert_allclose(rows.centers[own][[0, -1]], stick.vertices)
    assert (np.linalg.norm(np.diff(rows.centers[own], axis=0), axis=1) <= stick.radius).all()
    line = np.linspace(*stick.vertices, 301)
    around = np.array([0, np.pi / 3, 1.7])
    rim = stick.radius * np.stack([np.cos(around), 0 * around, np.sin(around)], axis=1)
    surface = (line[:, None] + rim).reshape(-1, 3)
    apart = np.linalg.norm(surface[:, None] - rows.centers[own], axis=-1) - rows.radii[own]
    assert apart.min(axis=1).max() < 1e-9
    assert (rows.radii[own] < 1.12 * stick.radius).all()
    for number in (1, 3):
        own = rows.parts == number
        assert (rows.inner_radii[own] < rows.radii[own]).all()
        assert (rows.radii - rows.inner_radii)[own].max() <= OVERSHOOT or own.sum() > 3


def test_covers_are_fitted_once_and_a_damaged_file_anew(cache, monkeypatch):
    first = cover_parts(parts())
    files = sorted(cache.iterdir())
    assert len(files) == 2
    calls = []
    real = covers.fit_covers
    monkeypatch.setattr(
        covers, "fit_covers", lambda *args, **rest: calls.append(0) or real(*args, **rest)
    )
    for change, expected in ((None, 0), (b"", 1), (b"\x93NUMPY", 2), (b"nothing", 3)):
        if change is not None:
            files[0].write_bytes(change)
        again = cover_parts(parts())
        for before, now in zip(first, again, strict=True):
            np.testing.assert_array_equal(before, now)
        assert len(calls) == expected


def test_a_cache_that_cannot_be_written_is_no_obstacle(cache, caplog):
    # A file where the folder should be stops root, too, which permissions do not.
    cache.parent.parent.mkdir(parents=True)
    cache.parent.write_text("")
    assert len(cover_parts(parts()).radii) > 4
    assert "spheres are not kept in" in caplog.text


BRICKS = """
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <worldbody>
    <body name="base"><geom type="box" size="0.1 0.1 0.05"/>
      <body name="upper" pos="0 0 0.1"><joint axis="0 0 1" range="-3 3"/>
        <geom name="beam" type="box" size="0.05 0.05 0.2" pos="0 0 0.2" mass="2"/>
        <body name="lower" pos="0 0 0.45"><joint axis="0 1 0" range="-2.5 2.5"/>
          <geom name="ball" size="0.04" pos="0 0 0.1" mass="1"/>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


def test_the_command_shows_and_saves_spheres_that_load_as_the_same_arm(tmp_path, capsys):
    path, out, picture = tmp_path / "bricks.xml", tmp_path / "round.xml", tmp_path / "round.png"
    path.write_text(BRICKS)
    robot = fit(FitConfig(str(path), out=out, picture=picture))
    printed = capsys.readouterr().out
    assert "beam" in printed
    assert "pairs of spheres" in printed
    for name, *ends in zip(robot.joint_names, robot.joint_lower, robot.joint_upper, strict=True):
        assert f"  {name}: {ends[0]:.4g} to {ends[1]:.4g}\n" in printed
    assert picture.stat().st_size > 10_000
    saved = load_robot(out)
    assert (saved.sphere_inner_radii == saved.sphere_radii).all()
    assert len(saved.sphere_radii) == len(robot.sphere_radii)
    assert len(saved.sphere_pairs) == len(robot.sphere_pairs)
    fitted = robot.sphere_inner_radii < robot.sphere_radii
    larger = np.sort(saved.sphere_radii)[1:] - np.sort(
        robot.sphere_radii[fitted]
    )  # the ball is least
    assert (larger > 5e-6).all()
    assert (larger < 2e-5).all()
    np.testing.assert_allclose(saved.mj_model.body_mass, robot.mj_model.body_mass, atol=1e-5)
    np.testing.assert_allclose(saved.mj_model.body_inertia, robot.mj_model.body_inertia, atol=1e-5)


@pytest.mark.parametrize("hold", [(), (("turn", 0.3),)])
def test_arms_with_pairs_that_are_named_are_saved(tmp_path, hold):
    named = BRICKS.replace('<joint axis="0 0 1"', '<joint name="turn" axis="0 0 1"')
    pair = '<contact><pair geom1="beam" geom2="ball"/></contact></mujoco>'
    (tmp_path / "paired.xml").write_text(named.replace("</mujoco>", pair))
    robot = fit(FitConfig(str(tmp_path / "paired.xml"), out=tmp_path / "round.xml", hold=hold))
    saved = load_robot(tmp_path / "round.xml")
    assert robot.mj_spec.pairs
    assert saved.num_dof == robot.num_dof
    assert len(saved.sphere_pairs) == len(robot.sphere_pairs)


LIMITS = """<custom><numeric name="velocity_limit" data="1.25 2.5"/>
<numeric name="acceleration_limit" data="7 9"/></custom></mujoco>"""
URDF = """<robot name="arm"><link name="base"/><link name="upper"><collision><geometry>
<box size="0.1 0.1 0.4"/></geometry></collision></link><link name="lower"><collision>
<origin xyz="0 0 0.5"/><geometry><sphere radius="0.1"/></geometry></collision></link>
<joint name="turn" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 0 1"/>
<limit lower="-2" upper="2" effort="40" velocity="1.5" acceleration="6"/></joint>
<joint name="bend" type="revolute"><parent link="upper"/><child link="lower"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" effort="30" velocity="2" acceleration="8"/></joint></robot>
"""


@pytest.mark.parametrize("hold", [(), (("turn", 0.3),)])
@pytest.mark.parametrize("kind", ["xml", "urdf"])
def test_saved_arms_keep_their_limits(tmp_path, kind, hold):
    path, out = tmp_path / f"arm.{kind}", tmp_path / "round.xml"
    named = BRICKS.replace('<joint axis="0 0 1"', '<joint name="turn" axis="0 0 1"')
    path.write_text(URDF if kind == "urdf" else named.replace("</mujoco>", LIMITS))
    robot = fit(FitConfig(str(path), out=out, hold=hold))
    saved = load_robot(out)
    assert saved.num_dof == 2 - len(hold)
    np.testing.assert_allclose(saved.velocity_limit, robot.velocity_limit)
    np.testing.assert_allclose(saved.acceleration_limit, robot.acceleration_limit)
    for limit in (saved.torque_limit, robot.torque_limit):
        expected = [40, 30][len(hold) :]
        assert limit is None if kind == "xml" else limit.tolist() == expected


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"out": "x.json"}, r"must end in \.xml"),
        ({"picture": "x.doc"}, "has no known ending"),
        ({"robot": "kuka"}, "no robot 'kuka' in assets/"),
    ],
)
def test_what_the_command_cannot_do_is_said_before_it_begins(tmp_path, settings, message):
    paths = {n: tmp_path / v for n, v in settings.items() if n != "robot"}
    with pytest.raises(InputError, match=message):
        fit(FitConfig(settings.get("robot", "kuka_iiwa14"), **paths))


def test_a_real_mesh_arm_loads_with_a_cover_of_its_hull(tmp_path):
    rng = np.random.default_rng(0)
    points = " ".join(f"{x:.4f}" for x in rng.normal(scale=0.05, size=60))
    path = tmp_path / "mesh.xml"
    path.write_text(
        f'<mujoco><asset><mesh name="rock" vertex="{points}"/></asset><worldbody><body>'
        '<joint range="-1 1" limited="true"/><geom type="mesh" mesh="rock" pos="0.2 0 0" '
        'euler="20 30 40"/></body></worldbody></mujoco>'
    )
    robot = load_robot(path)
    (part,) = robot.parts
    model, data = robot.mj_model, mujoco.MjData(robot.mj_model)
    mujoco.mj_kinematics(model, data)
    # The farthest point in any direction is that of the vertices that MuJoCo has.
    vertices = model.mesh_vert @ data.geom_xmat[0].reshape(3, 3).T + data.geom_xpos[0]
    normals = rng.normal(size=(500, 3))
    np.testing.assert_allclose(
        (normals @ part.vertices.T).max(axis=1), (normals @ vertices.T).max(axis=1), atol=1e-7
    )
