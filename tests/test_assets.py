"""The arms in assets/: figures, kinematics, and what their hulls and spheres promise.

The figures below are those of the manufacturers (sources in the MJCF headers), written down a
second time, and the kinematics are done again in NumPy, so that a slip in an MJCF shows.
"""

import dataclasses
import itertools
from pathlib import Path

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.spatial import ConvexHull, cKDTree

from gnnjax.arm.robot import load_robot
from gnnjax.fit import mjcf_of_spheres
from gnnjax.problems.family_problem import tip_positions

ROOT = Path(__file__).parents[1]
HALF_TURN = np.pi
QUARTER = np.pi / 2


@dataclasses.dataclass(frozen=True)
class Link:
    name: str
    pos: tuple[float, float, float]
    turn: tuple[float, ...]  # w x y z, not normalized, or roll pitch yaw about fixed axes
    mass: float
    com: tuple[float, float, float]
    inertia: tuple[float, ...]  # xx yy zz, or xx yy zz xy xz yz
    limit: float | tuple[float, float] = 0.0  # rad, either way or each; 0 has no joint
    velocity: float = 0.0  # rad/s
    torque: float = 0.0  # N m
    opens: tuple[float, float] | None = None  # m; how far a finger slides along its y axis
    parent: str = ""  # if it is not the link before
    hull: str = ""  # if it is not called as the link


# fmt: off
KUKA = (
    Link("link_0", (0, 0, 0), (1, 0, 0, 0), 5, (-0.1, 0, 0.07), (0.05, 0.06, 0.03)),
    Link("link_1", (0, 0, 0.1575), (1, 0, 0, 0), 5.76, (0, -0.03, 0.12),
         (0.0333, 0.033, 0.0123), 2.96706, 1.4835, 320),
    Link("link_2", (0, 0, 0.2025), (0, 0, 1, 1), 6.35, (0.0003, 0.059, 0.042),
         (0.0305, 0.0304, 0.011), 2.09440, 1.4835, 320),
    Link("link_3", (0, 0.2045, 0), (0, 0, 1, 1), 3.5, (0, 0.03, 0.13),
         (0.025, 0.0238, 0.0076), 2.96706, 1.7453, 176),
    Link("link_4", (0, 0, 0.2155), (1, 1, 0, 0), 3.5, (0, 0.067, 0.034),
         (0.017, 0.0164, 0.006), 2.09440, 1.3090, 176),
    Link("link_5", (0, 0.1845, 0), (0, 0, 1, 1), 3.5, (0.0001, 0.021, 0.076),
         (0.01, 0.0087, 0.00449), 2.96706, 2.2689, 110),
    Link("link_6", (0, 0, 0.2155), (1, 1, 0, 0), 1.8, (0, 0.0006, 0.0004),
         (0.0049, 0.0047, 0.0036), 2.09440, 2.3562, 40),
    Link("link_7", (0, 0.081, 0), (0, 0, 1, 1), 1.2, (0, 0, 0.02),
         (0.001, 0.001, 0.001), 3.05433, 2.3562, 40),
)
# The manufacturer rounds the right angles of this arm to 3.1416 and 1.5708.
KINOVA = (
    Link("base_link", (0, 0, 0), (0, 0, 0), 1.697, (-0.000648, -0.000166, 0.084487),
         (0.004622, 0.004495, 0.002079)),
    Link("shoulder_link", (0, 0, 0.15643), (-HALF_TURN, 0, 0), 1.377,
         (-0.000023, -0.010364, -0.07336), (0.00457, 0.004831, 0.001409), np.pi, 1.3963, 39),
    Link("bicep_link", (0, 0.005375, -0.12838), (QUARTER, 0, 0), 1.262,
         (0.000035, -0.208207, -0.01889), (0.046752, 0.00085, 0.047188), 2.24, 1.3963, 39),
    Link("forearm_link", (0, -0.41, 0), (HALF_TURN, 0, 0), 0.930,
         (0.000018, 0.076168, -0.01397), (0.008292, 0.000628, 0.008464), 2.57, 1.3963, 39),
    Link("spherical_wrist_1_link", (0, 0.20843, -0.006375), (QUARTER, 0, 0), 0.6781,
         (-0.000001, 0.008486, -0.062937), (0.001645, 0.001666, 0.000389), np.pi, 1.2218, 9),
    Link("spherical_wrist_2_link", (0, -0.00017505, -0.10593), (-QUARTER, 0, 0), 0.678,
         (-0.000001, 0.046429, -0.008704), (0.001685, 0.0004, 0.001696), 2.09, 1.2218, 9),
    Link("bracelet_link", (0, 0.10593, -0.00017505), (QUARTER, 0, 0), 0.364,
         (-0.000093, 0.000132, -0.022905), (0.000214, 0.000223, 0.00024), np.pi, 1.2218, 9),
)
# The last three are the hand and its fingers, as far apart as they slide. Link 5 is two bodies, as
# the hull of the whole fills the hollow between forearm and wrist, where the hand may go.
PANDA = (
    Link("link_0", (0, 0, 0), (0, 0, 0), 0.629769, (-0.041018, -0.00014, 0.049974),
         (0.00315, 0.00388, 0.004285, 8.2904e-7, 0.00015, 8.2299e-6)),
    Link("link_1", (0, 0, 0.333), (0, 0, 0), 4.970684, (0.003875, 0.002081, -0.04762),
         (0.70337, 0.70661, 0.009117, -0.000139, 0.006772, 0.019169), 2.8973, 2.175, 87),
    Link("link_2", (0, 0, 0), (-QUARTER, 0, 0), 0.646926, (-0.003141, -0.02872, 0.003495),
         (0.007962, 0.02811, 0.025995, -0.003925, 0.010254, 0.000704), 1.7628, 2.175, 87),
    Link("link_3", (0, -0.316, 0), (QUARTER, 0, 0), 3.228604, (0.027518, 0.039252, -0.066502),
         (0.037242, 0.036155, 0.01083, -0.004761, -0.011396, -0.012805), 2.8973, 2.175, 87),
    Link("link_4", (0.0825, 0, 0), (QUARTER, 0, 0), 3.587895, (-0.05317, 0.104419, 0.027454),
         (0.025853, 0.019552, 0.028323, 0.007796, -0.001332, 0.008641),
         (-3.0718, -0.0698), 2.175, 87),
    Link("link_5", (-0.0825, 0.384, 0), (-QUARTER, 0, 0), 1.225946,
         (-0.011953, 0.041065, -0.038437),
         (0.035549, 0.029474, 0.008627, -0.002117, -0.004037, 0.000229), 2.8973, 2.61, 12),
    Link("link_5_wrist", (0, 0, 0), (0, 0, 0), 0, (0, 0, 0), (0, 0, 0)),
    Link("link_6", (0, 0, 0), (QUARTER, 0, 0), 1.666555, (0.060149, -0.014117, -0.010517),
         (0.001964, 0.004354, 0.005433, 0.000109, -0.001158, 0.000341),
         (-0.0175, 3.7525), 2.61, 12),
    Link("link_7", (0.088, 0, 0), (QUARTER, 0, 0), 0.735522, (0.010517, -0.004252, 0.061597),
         (0.012516, 0.010027, 0.004815, -0.000428, -0.001196, -0.000741), 2.8973, 2.61, 12),
    Link("hand", (0, 0, 0.107), (0, 0, -np.pi / 4), 0.73, (-0.01, 0, 0.03),
         (0.001, 0.0025, 0.0017)),
    Link("left_finger", (0, 0, 0.0584), (0, 0, 0), 0.015, (0, 0, 0), (2.375e-6, 2.375e-6, 7.5e-7),
         opens=(0, 0.065), hull="finger"),
    Link("right_finger", (0, 0, 0.0584), (0, 0, np.pi), 0.015, (0, 0, 0),
         (2.375e-6, 2.375e-6, 7.5e-7), opens=(0, 0.065), parent="hand", hull="finger"),
)
# fmt: on
ARMS = {"kuka_iiwa14": KUKA, "kinova_gen3": KINOVA, "franka_panda": PANDA}
# Tool frames: link, position and turn in it.
TOOLS = {
    "kuka_iiwa14": ("link_7", (0, 0, 0.045), (1, 0, 0, 0)),
    "kinova_gen3": ("bracelet_link", (0, 0, -0.061525), (HALF_TURN, 0, HALF_TURN)),
    "franka_panda": ("hand", (0, 0, 0.1034), (1, 0, 0, 0)),
}
OPENINGS = (0.0, 0.04, 0.065)  # m, of each finger


@dataclasses.dataclass(frozen=True)
class Spheres:
    """What the headers say of the spheres around the hulls."""

    moving: int  # number of those on links that move
    base: int
    pairs: int  # for self-collision
    overshoot: float  # m; by which those of links that move stand out of the hulls at most
    base_overshoot: float


SPHERES = {
    "kuka_iiwa14": Spheres(45, 8, 80, 0.025, 0.0396),
    "kinova_gen3": Spheres(36, 2, 88, 0.025, 0.0395),
    "franka_panda": Spheres(42, 5, 438, 0.0255, 0.040),
}
# Hulls fill the hollow in front of the wrist, which the real links do not.
HULL_ARTEFACTS = {
    "kuka_iiwa14": {("link_5", "link_7")},
    "kinova_gen3": set(),
    "franka_panda": {("link_5_wrist", "link_7")},
}


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


@pytest.fixture(scope="module")
def hulls(arm, links):
    with np.load(ROOT / "tests" / "data" / f"{arm}_hulls.npz") as data:
        return {link.name: data[link.hull or link.name].astype(np.float64) for link in links}


def rotation(turn):
    """Matrix of a quaternion (4 numbers) or of roll, pitch and yaw about fixed axes (3)."""
    if len(turn) == 4:
        w, x, y, z = np.asarray(turn) / np.linalg.norm(turn)
        return np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
    (cr, cp, cy), (sr, sp, sy) = np.cos(turn), np.sin(turn)
    roll = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    pitch = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    yaw = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return yaw @ pitch @ roll


def spheres_of(robot, name):
    """Centers [S, 3] and radii [S], outer and inner, of the spheres around a link, in its frame."""
    (number,) = (i for i, part in enumerate(robot.parts) if part.name == name)
    rows = robot.geom_parts == number
    return robot.geom_centers[rows], robot.geom_radii[rows], robot.geom_inner_radii[rows]


def excluded_pairs(model):
    return {
        tuple(sorted((signature >> 16, signature & 0xFFFF)))
        for signature in model.exclude_signature.tolist()
    }


def kept_pairs(model, links):
    """Names of the links that MuJoCo checks against each other."""
    excluded = excluded_pairs(model)
    return [
        (a.name, b.name)
        for i, a in enumerate(links)
        for b in links[i + 1 :]
        if (model.body(a.name).id, model.body(b.name).id) not in excluded
    ]


def hull_distance(model, data, pair):
    """Of the hulls at the configuration in `data`; negative where they overlap."""
    first, second = (model.geom(name).id for name in pair)
    return mujoco.mj_geomDistance(model, data, first, second, 1.0, None)


def configurations(model, count, rng, *, folded=False):
    """Random; if folded, with about every third joint at a limit, where links come closest."""
    lower, upper = model.jnt_range.T
    q = rng.uniform(lower, upper, size=(count, model.njnt))
    if folded:
        ends = np.where(rng.uniform(size=q.shape) < 0.5, lower, upper)
        q = np.where(rng.uniform(size=q.shape) < 0.3, ends, q)
    fingers = model.jnt_type == mujoco.mjtJoint.mjJNT_SLIDE
    q[:, fingers] = rng.choice(OPENINGS, size=(count, 1))
    return q


def place(model, data, q):
    data.qpos[:] = q
    mujoco.mj_kinematics(model, data)


def triangles_of(model, name):
    """Faces [T, 3, 3] of a link's mesh, in the link's frame."""
    geom = model.geom(name)  # MuJoCo moves a mesh to its principal axes
    mesh = model.mesh(geom.dataid[0])
    first, count = mesh.faceadr[0], mesh.facenum[0]
    corners = model.mesh_vert[mesh.vertadr[0] : mesh.vertadr[0] + mesh.vertnum[0]]
    corners = corners.astype(np.float64) @ rotation(geom.quat).T + geom.pos
    return corners[model.mesh_face[first : first + count]]


def depth(points, hull):
    """Distance of points inside a `ConvexHull` to its surface; negative outside."""
    return -(points @ hull.equations[:, :3].T + hull.equations[:, 3]).max(axis=1)


def surface_samples(triangles, spacing):
    """Points such that none of the surface is further than `spacing` from one."""
    samples = []
    for a, b, c in triangles:
        longest = max(np.linalg.norm(b - a), np.linalg.norm(c - b), np.linalg.norm(a - c))
        n = int(np.ceil(longest / (np.sqrt(3.0) * 0.8 * spacing)))
        i, j = np.mgrid[: n + 1, : n + 1]
        i, j = i[i + j <= n, None] / n, j[i + j <= n, None] / n
        samples.append(a + i * (b - a) + j * (c - a))
    points = np.concatenate(samples)
    cells = (points / (0.1 * spacing)).round().astype(np.int64) + 2**19
    return points[np.unique(cells @ [1, 2**20, 2**40], return_index=True)[1]]


def gap(points, centers, radii):
    """How far each point sticks out of the union of the spheres."""
    out = np.full(len(points), np.inf)
    for center, radius in zip(centers, radii, strict=True):
        out = np.minimum(out, np.linalg.norm(points - center, axis=1) - radius)
    return out


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


def test_meshes_are_the_hulls(model, robot, hulls):
    assert [part.name for part in robot.parts] == list(hulls)
    for part in robot.parts:
        expected, hull = hulls[part.name], ConvexHull(hulls[part.name])
        # As far as an OBJ file and single precision tell.
        assert cKDTree(part.vertices).query(expected[hull.vertices])[0].max() < 2e-6
        assert cKDTree(expected).query(part.vertices)[0].max() < 2e-6
        triangles = triangles_of(model, part.name)
        volume = np.linalg.det(triangles - triangles.mean(axis=(0, 1))).sum() / 6
        np.testing.assert_allclose(volume, hull.volume, rtol=1e-3, err_msg=part.name)


def test_spheres_enclose_the_hulls(model, robot, links, hulls):
    for link in links:
        centers, radii, _ = spheres_of(robot, link.name)
        out = gap(surface_samples(triangles_of(model, link.name), 0.003), centers, radii).max()
        assert out <= 0, f"{link.name} sticks out by {1e3 * out:.2f} mm"
        hull = ConvexHull(hulls[link.name])
        grid = np.meshgrid(
            *(np.arange(a, b, 0.007) for a, b in zip(hull.min_bound, hull.max_bound, strict=True))
        )
        inside = np.stack(grid, axis=-1).reshape(-1, 3)
        inside = inside[depth(inside, hull) > 0]
        assert gap(inside, centers, radii).max() <= 0, f"{link.name} has a hole inside"


def test_spheres_are_few_and_tight(arm, model, robot, links, hulls):
    said, counts = SPHERES[arm], {}
    for link in links:
        centers, radii, inner = spheres_of(robot, link.name)
        counts[link.name] = len(radii)
        depths = depth(centers, ConvexHull(hulls[link.name]))
        overshoot = (radii - depths).max()
        most = said.base_overshoot if link is links[0] else said.overshoot
        assert overshoot <= most, f"{link.name} overshoots by {1e3 * overshoot:.1f} mm"
        assert (inner <= depths + 1e-6).all(), f"{link.name}: what is inside is not"
    assert counts[links[0].name] == said.base
    assert sum(counts.values()) == said.base + said.moving
    assert len(robot.self_pairs) == said.pairs
    names = [(robot.parts[a].name, robot.parts[b].name) for a, b in robot.part_pairs.tolist()]
    # Held fingers do not move against one another.
    fingers = ("left_finger", "right_finger")
    assert names == [pair for pair in kept_pairs(model, links) if pair != fingers]


def test_an_arm_of_its_spheres_is_the_same_arm(robot, tmp_path):
    path = tmp_path / "round.xml"
    path.write_text(mjcf_of_spheres(robot))
    saved = load_robot(path)
    assert saved.joint_names == robot.joint_names
    np.testing.assert_array_equal(saved.self_pairs, robot.self_pairs)
    np.testing.assert_allclose(saved.geom_radii, robot.geom_radii, atol=2e-5)
    np.testing.assert_allclose(saved.geom_centers, robot.geom_centers, atol=2e-5)
    np.testing.assert_allclose(saved.home, robot.home, atol=1e-5)
    np.testing.assert_allclose(saved.mj_model.body_mass, robot.mj_model.body_mass, rtol=1e-4)


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


def test_no_two_links_are_in_collision_often(model):
    """A pair that nearly always touches would leave a planner nothing free."""
    data, rng = mujoco.MjData(model), np.random.default_rng(3)
    counts, samples = {}, configurations(model, 1500, rng)
    for q in samples:
        place(model, data, q)
        mujoco.mj_comPos(model, data)
        mujoco.mj_collision(model, data)
        touching = data.contact.geom[data.contact.dist < -3e-4]  # which closed fingers do not
        for pair in {tuple(sorted(model.geom_bodyid[geoms])) for geoms in touching}:
            counts[pair] = counts.get(pair, 0) + 1
    assert counts, "no self-collision in any sample"
    assert max(counts.values()) < 0.1 * len(samples), counts


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


def test_excluded_links_cannot_meet(arm, model, links):
    """Random samples only; experiments/link_distances.py searches further."""
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    touching = {
        (link.parent or before.name, link.name) for before, link in itertools.pairwise(links)
    }
    apart = [
        (a.name, b.name)
        for a, b in itertools.combinations(links, 2)
        if (a.name, b.name) not in touching | HULL_ARTEFACTS[arm] | set(kept_pairs(model, links))
    ]
    for q in configurations(model, 1500, rng, folded=True):
        place(model, data, q)
        for pair in apart:
            assert hull_distance(model, data, pair) > 0.01, (pair, data.qpos)


def test_spheres_notice_every_self_collision_of_the_hulls(model, robot, links):
    data, rng = mujoco.MjData(model), np.random.default_rng(1)
    kept, hits = robot.part_pairs.tolist(), 0
    first, second = robot.self_pairs.T
    reach = robot.geom_radii[first] + robot.geom_radii[second]
    bodies = robot.geom_bodies + 1
    for q in configurations(model, 3000, rng, folded=True):
        place(model, data, q)
        names = ((robot.parts[a].name, robot.parts[b].name) for a, b in kept)
        if min(hull_distance(model, data, pair) for pair in names) < 0:
            turned = data.xmat[bodies].reshape(-1, 3, 3) @ robot.geom_centers[..., None]
            centers = data.xpos[bodies] + turned[..., 0]
            apart = np.linalg.norm(centers[first] - centers[second], axis=1) - reach
            assert apart.min() < 0, q
            hits += 1
    assert hits > 5


@pytest.mark.parametrize("opening", OPENINGS)
def test_the_fingers_of_the_panda_are_held_where_one_says(opening):
    joints = ("finger_joint_1", "finger_joint_2")
    robot = load_robot("franka_panda", hold=dict.fromkeys(joints, opening))
    assert robot.joint_names == tuple(f"joint_{i}" for i in range(1, 8))
    assert robot.held == dict.fromkeys(joints, opening)
    # Closed, they touch, and may.
    names = [part.name for part in robot.parts]
    two = [names.index("left_finger"), names.index("right_finger")]
    assert two not in robot.part_pairs.tolist()
    left, right = (spheres_of(robot, f"{side}_finger") for side in ("left", "right"))
    np.testing.assert_allclose(left[1], right[1], atol=1e-6)
    bodies = {body.name: body.position for body in robot.bodies}
    np.testing.assert_allclose(bodies["left_finger"], [0, opening, 0.0584], atol=1e-6)
    np.testing.assert_allclose(bodies["right_finger"], [0, -opening, 0.0584], atol=1e-6)
    # What problems call the tip is between the fingers, on the axis of the hand.
    data = mujoco.MjData(robot.mj_model)
    place(robot.mj_model, data, robot.home)
    hand, tip = data.body("hand"), np.asarray(tip_positions(robot, jnp.asarray(robot.home)))
    seen = hand.xmat.reshape(3, 3).T @ (tip - hand.xpos)
    np.testing.assert_allclose(seen, [0, 0, 0.084], atol=1e-3)
