"""The arms in assets/: what their hulls and the spheres around them promise."""

import dataclasses
import itertools

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.spatial import ConvexHull, cKDTree

from gnnjax.arm.robot import load_robot
from gnnjax.fit import mjcf_of_spheres
from gnnjax.problems.family_problem import tip_positions
from tests.published_arms import (
    ARMS,
    OPENINGS,
    ROOT,
    hull_distance,
    kept_pairs,
    place,
    rotation,
)


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


def spheres_of(robot, name):
    """Centers [S, 3] and radii [S], outer and inner, of the spheres around a link, in its frame."""
    (number,) = (i for i, part in enumerate(robot.parts) if part.name == name)
    rows = robot.sphere_parts == number
    return robot.sphere_centers[rows], robot.sphere_radii[rows], robot.sphere_inner_radii[rows]


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
    assert len(robot.sphere_pairs) == said.pairs
    names = [(robot.parts[a].name, robot.parts[b].name) for a, b in robot.part_pairs.tolist()]
    # Held fingers do not move against one another.
    fingers = ("left_finger", "right_finger")
    assert names == [pair for pair in kept_pairs(model, links) if pair != fingers]


def test_an_arm_of_its_spheres_is_the_same_arm(robot, tmp_path):
    path = tmp_path / "round.xml"
    path.write_text(mjcf_of_spheres(robot))
    saved = load_robot(path)
    assert saved.joint_names == robot.joint_names
    np.testing.assert_array_equal(saved.sphere_pairs, robot.sphere_pairs)
    np.testing.assert_allclose(saved.sphere_radii, robot.sphere_radii, atol=2e-5)
    np.testing.assert_allclose(saved.sphere_centers, robot.sphere_centers, atol=2e-5)
    np.testing.assert_allclose(saved.home, robot.home, atol=1e-5)
    np.testing.assert_allclose(saved.mj_model.body_mass, robot.mj_model.body_mass, rtol=1e-4)


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
    first, second = robot.sphere_pairs.T
    reach = robot.sphere_radii[first] + robot.sphere_radii[second]
    bodies = robot.sphere_bodies + 1
    for q in configurations(model, 3000, rng, folded=True):
        place(model, data, q)
        names = ((robot.parts[a].name, robot.parts[b].name) for a, b in kept)
        if min(hull_distance(model, data, pair) for pair in names) < 0:
            turned = data.xmat[bodies].reshape(-1, 3, 3) @ robot.sphere_centers[..., None]
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
