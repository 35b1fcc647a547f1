"""The arms in assets/: figures, kinematics, and what their collision spheres promise.

The figures below are those of the manufacturers (sources in the MJCF headers), written down a
second time, and the kinematics are done again in NumPy, so that a slip in an MJCF shows.
"""

import dataclasses
from pathlib import Path

import mujoco
import numpy as np
import pytest

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
# The last two are the hand and the closed fingers. Link 5 is two bodies, as the hull of the
# whole fills the hollow between forearm and wrist, where the hand may go.
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
    Link("fingers", (0, 0, 0.0584), (0, 0, 0), 0.03, (0, 0, 0), (4.75e-6, 4.75e-6, 1.5e-6)),
)
# fmt: on
ARMS = {"kuka_iiwa14": KUKA, "kinova_gen3": KINOVA, "franka_panda": PANDA}
# Tool frames in the last link: position and turn.
TOOLS = {
    "kuka_iiwa14": ((0, 0, 0.045), (1, 0, 0, 0)),
    "kinova_gen3": ((0, 0, -0.061525), (HALF_TURN, 0, HALF_TURN)),
    "franka_panda": ((0, 0, 0.045), (1, 0, 0, 0)),
}
MOST_SPHERES = {"kuka_iiwa14": 50, "kinova_gen3": 50, "franka_panda": 50}  # of the links that move
MOST_PAIRS = 400
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
def hulls(arm, links):
    with np.load(ROOT / "tests" / "data" / f"{arm}_hulls.npz") as data:
        return {link.name: data[link.name].astype(np.float64) for link in links}


@pytest.fixture(scope="module")
def hull_model(arm, hulls):
    """The arm with its hulls as further geoms, hull/LINK, which collide with nothing."""
    spec = mujoco.MjSpec.from_file(str(ROOT / "assets" / f"{arm}.xml"))
    for name, vertices in hulls.items():
        spec.add_mesh(name=f"hull/{name}", uservert=vertices.ravel())
        spec.body(name).add_geom(
            name=f"hull/{name}",
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=f"hull/{name}",
            contype=0,
            conaffinity=0,
            mass=0,
        )
    return spec.compile()


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


def spheres_of(model, name):
    """Centers [S, 3] and radii [S] of a link's collision geoms, which must all be spheres."""
    own = model.geom_bodyid == model.body(name).id
    own &= (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    assert (model.geom_type[own] == mujoco.mjtGeom.mjGEOM_SPHERE).all()
    return model.geom_pos[own], model.geom_size[own, 0]


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
    first, second = (model.geom(f"hull/{name}").id for name in pair)
    return mujoco.mj_geomDistance(model, data, first, second, 1.0, None)


def folded_configurations(model, count, rng):
    """Random, with about every third joint at a limit, where links come closest."""
    lower, upper = model.jnt_range.T
    q = rng.uniform(lower, upper, size=(count, model.njnt))
    ends = np.where(rng.uniform(size=q.shape) < 0.5, lower, upper)
    return np.where(rng.uniform(size=q.shape) < 0.3, ends, q)


def triangles_of(hull_model, name):
    """Faces [T, 3, 3] of a link's hull, in the link's frame."""
    mesh = hull_model.mesh(f"hull/{name}")
    first, count = mesh.faceadr[0], mesh.facenum[0]
    corners = hull_model.mesh_vert[mesh.vertadr[0] : mesh.vertadr[0] + mesh.vertnum[0]]
    geom = hull_model.geom(f"hull/{name}")  # MuJoCo moves a mesh to its principal axes
    corners = corners.astype(np.float64) @ rotation(geom.quat).T + geom.pos
    return corners[hull_model.mesh_face[first : first + count]]


def depth(points, triangles):
    """Distance of points inside a hull to its surface; negative outside."""
    a, b, c = triangles.transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    area = np.linalg.norm(normals, axis=1)
    normals = normals[area > 1e-12] / area[area > 1e-12, None]
    normals *= np.sign(((a[area > 1e-12] - triangles.mean(axis=(0, 1))) * normals).sum(1))[:, None]
    # Planes that support the hull: a face's normal that is off by rounding then does no harm.
    offsets = (normals @ triangles.reshape(-1, 3).T).max(axis=1)
    return (offsets - points @ normals.T).min(axis=1)


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
    moving = [link for link in links if link.limit]
    assert model.njnt == model.nu == len(moving)
    limits = [
        link.limit if isinstance(link.limit, tuple) else (-link.limit, link.limit)
        for link in moving
    ]
    np.testing.assert_allclose(model.jnt_range, limits, atol=1e-6)
    assert model.jnt_limited.all()
    assert (model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE).all()
    np.testing.assert_array_equal(model.jnt_axis, np.tile([0, 0, 1], (model.njnt, 1)))
    np.testing.assert_allclose(
        model.numeric("velocity_limit").data, [link.velocity for link in moving]
    )
    torque = np.array([link.torque for link in moving])
    np.testing.assert_allclose(model.actuator_forcerange, np.stack([-torque, torque], 1))
    np.testing.assert_array_equal(model.actuator_trnid[:, 0], np.arange(model.njnt))


def test_forward_kinematics_agree_with_numpy(arm, model, links):
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    for q in rng.uniform(*model.jnt_range.T, size=(200, model.njnt)):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        position, turn, angles = np.zeros(3), np.eye(3), iter(q)
        for link in links:
            position = position + turn @ np.asarray(link.pos)
            turn = turn @ rotation(link.turn)
            if link.limit:
                turn = turn @ rotation((0, 0, next(angles)))
            body = data.body(link.name)
            np.testing.assert_allclose(body.xpos, position, atol=1e-5, err_msg=link.name)
            np.testing.assert_allclose(body.xmat.reshape(3, 3), turn, atol=1e-5)
        offset, tool_turn = TOOLS[arm]
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
        for (a, d, alpha), theta in zip(table, (*q, 0.0), strict=True):
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


def test_spheres_enclose_the_hulls(model, hull_model, links):
    for link in links:
        centers, radii = spheres_of(model, link.name)
        triangles = triangles_of(hull_model, link.name)
        # Between samples the gap grows by no more than their distance: 0.2 + 1.8 mm.
        out = gap(surface_samples(triangles, 0.0018), centers, radii).max()
        assert out <= 0.0002, f"{link.name} sticks out by {1e3 * out:.2f} mm"
        corners = triangles.reshape(-1, 3)
        grid = np.meshgrid(
            *(np.arange(a, b, 0.005) for a, b in zip(corners.min(0), corners.max(0), strict=True))
        )
        inside = np.stack(grid, axis=-1).reshape(-1, 3)
        inside = inside[depth(inside, triangles) > 0]
        assert gap(inside, centers, radii).max() <= 0, f"{link.name} has a hole inside"


def test_spheres_are_few_and_tight(arm, model, hull_model, links):
    counts = {link.name: len(spheres_of(model, link.name)[1]) for link in links}
    moving = links[1:]
    assert sum(counts[link.name] for link in moving) <= MOST_SPHERES[arm]
    assert counts[links[0].name] <= 8
    assert sum(counts[a] * counts[b] for a, b in kept_pairs(model, links)) <= MOST_PAIRS
    for link in moving:
        centers, radii = spheres_of(model, link.name)
        overshoot = (radii - depth(centers, triangles_of(hull_model, link.name))).max()
        assert overshoot <= 0.025, f"{link.name} overshoots by {1e3 * overshoot:.1f} mm"


def test_home_is_free_and_within_limits(model, hull_model, links):
    home = model.key("home").qpos
    assert (home >= model.jnt_range[:, 0]).all()
    assert (home <= model.jnt_range[:, 1]).all()
    np.testing.assert_allclose(model.key("home").ctrl, home)
    data = mujoco.MjData(hull_model)
    mujoco.mj_resetDataKeyframe(hull_model, data, hull_model.key("home").id)
    mujoco.mj_forward(hull_model, data)
    assert data.ncon == 0
    for pair in kept_pairs(model, links):
        assert hull_distance(hull_model, data, pair) > 0.05, pair


def test_no_two_links_are_in_collision_often(model):
    """A pair that nearly always touches would leave a planner nothing free."""
    data, rng = mujoco.MjData(model), np.random.default_rng(3)
    counts, samples = {}, rng.uniform(*model.jnt_range.T, size=(1000, model.njnt))
    for q in samples:
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_collision(model, data)
        touching = data.contact.geom[data.contact.dist < 0]
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
    data.qpos[:] = q
    mujoco.mj_forward(model, data)
    assert data.ncon == 0


def test_excluded_links_cannot_meet(arm, hull_model, links):
    """Random samples only; experiments/link_distances.py searches further."""
    data, rng = mujoco.MjData(hull_model), np.random.default_rng(0)
    kept = set(kept_pairs(hull_model, links))
    apart = [
        (a.name, b.name)
        for i, a in enumerate(links)
        for b in links[i + 2 :]  # neighbors touch by construction
        if (a.name, b.name) not in kept | HULL_ARTEFACTS[arm]
    ]
    for q in folded_configurations(hull_model, 1500, rng):
        data.qpos[:] = q
        mujoco.mj_kinematics(hull_model, data)
        for pair in apart:
            assert hull_distance(hull_model, data, pair) > 0.01, (pair, data.qpos)


def test_spheres_notice_every_self_collision_of_the_hulls(hull_model, links):
    data, rng = mujoco.MjData(hull_model), np.random.default_rng(1)
    kept, hits = kept_pairs(hull_model, links), 0
    for q in folded_configurations(hull_model, 3000, rng):
        data.qpos[:] = q
        mujoco.mj_kinematics(hull_model, data)
        if min(hull_distance(hull_model, data, pair) for pair in kept) < -0.004:
            mujoco.mj_comPos(hull_model, data)
            mujoco.mj_collision(hull_model, data)
            assert data.ncon > 0, q
            hits += 1
    assert hits > 5
