"""Whether convex bodies are apart: against MuJoCo's C engine, and by the proof in float64."""

from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.optimize import lsq_linear
from scipy.spatial.transform import Rotation

from gnnjax.arm.hulls import simplify
from gnnjax.collision.convex import (
    Parts,
    Sums,
    separate_obstacles,
    separate_parts,
)
from gnnjax.errors import InputError

DATA = Path(__file__).parent / "data"
LINKS = {
    "franka_panda": ("link_0", "link_3", "link_7", "hand", "finger"),
    "kinova_gen3": ("base_link",),
    "kuka_iiwa14": ("link_0",),
}
BOX, CYLINDER, CAPSULE, SPHERE = (
    mujoco.mjtGeom.mjGEOM_BOX,
    mujoco.mjtGeom.mjGEOM_CYLINDER,
    mujoco.mjtGeom.mjGEOM_CAPSULE,
    mujoco.mjtGeom.mjGEOM_SPHERE,
)
# Type and size in MuJoCo; box, disc and ball.
SHAPES = [
    (BOX, [0.3, 0.2, 0.02], [0.3, 0.2, 0.02, 0.0, 0.0]),
    (BOX, [0.05, 0.04, 0.06], [0.05, 0.04, 0.06, 0.0, 0.0]),
    (CYLINDER, [0.2, 0.05, 0.0], [0.0, 0.0, 0.05, 0.2, 0.0]),
    (CYLINDER, [0.03, 0.3, 0.0], [0.0, 0.0, 0.3, 0.03, 0.0]),
    (CAPSULE, [0.04, 0.2, 0.0], [0.0, 0.0, 0.2, 0.0, 0.04]),
    (SPHERE, [0.1, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0, 0.1]),
]
PARTS_APART, OBSTACLES_APART = jax.jit(separate_parts), jax.jit(separate_obstacles)
PENETRATION, CLEAR = -1e-5, 5e-5  # m; beyond these the answer is determined


def hulls():
    loaded = []
    for arm, links in LINKS.items():
        with np.load(DATA / f"{arm}_hulls.npz") as data:
            loaded += [data[link] for link in links]
    return loaded


def table(vertices, radii):
    longest = max(map(len, vertices))
    padded = [np.concatenate([v, np.repeat(v[-1:], longest - len(v), axis=0)]) for v in vertices]
    return Parts(jnp.asarray(np.stack(padded), jnp.float32), jnp.asarray(radii, jnp.float32))


HULLS = hulls()
PARTS = table(HULLS, np.zeros(len(HULLS)))
SIMPLE = table(*zip(*(simplify(hull, 1e-3) for hull in HULLS), strict=True))


class Pairs:
    """Random poses of parts beside others, every third moved to within 10 mm of contact."""

    def __init__(self, with_parts, number):
        self.rng = np.random.default_rng(int(with_parts))
        spec = mujoco.MjSpec()
        for i, hull in enumerate(HULLS):
            for copy in "ab":
                spec.add_mesh(name=f"{i}{copy}").uservert = hull.ravel().tolist()
                body = spec.worldbody.add_body(name=f"part{i}{copy}", mocap=True)
                body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"{i}{copy}")
        for i, (kind, size, _) in enumerate(SHAPES):
            spec.worldbody.add_body(name=f"shape{i}").add_geom(type=kind, size=size)
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        others = [f"part{i}b" if with_parts else f"shape{i}" for i in range(6)]
        self.part = self.rng.integers(len(HULLS), size=number)
        self.other = self.rng.integers(len(others), size=number)
        self.rotation = Rotation.random(number, rng=self.rng).as_matrix()
        self.position = self.rng.normal(size=(number, 3))
        self.position *= self.rng.uniform(0.0, 0.4, (number, 1))
        self.distance = np.array([self._place(n, others) for n in range(number)])

    def _place(self, n, others):
        part, other = f"part{self.part[n]}a", others[self.other[n]]
        distance, normal = self._distance(n, part, other)
        if n % 3 == 0:
            reach = 1e-2 if n % 2 else 2e-4
            target = self.rng.uniform(-reach, reach)
            for _ in range(4):
                self.position[n] += (target - distance) * normal
                distance, normal = self._distance(n, part, other)
        return distance

    def _distance(self, n, part, other):
        model, data, ends = self.model, self.data, np.zeros(6)
        mocap = model.body(part).mocapid[0]
        data.mocap_pos[mocap] = self.position[n]
        mujoco.mju_mat2Quat(data.mocap_quat[mocap], self.rotation[n].ravel())
        mujoco.mj_kinematics(model, data)
        geoms = [model.body(name).geomadr[0] for name in (part, other)]
        distance = mujoco.mj_geomDistance(model, data, *geoms, 3.0, ends)
        normal = (ends[:3] - ends[3:]) * np.sign(distance)
        return distance, normal / max(np.linalg.norm(normal), 1e-12)

    def separated(self, parts, with_parts, rows=slice(None)):
        part, position, rotation = (x[..., rows] for x in (self.part, *self.pose()))
        args = [parts, jnp.asarray(part), position, rotation]
        direction = position + 0.01
        if with_parts:
            found = PARTS_APART(*args, self.other[rows], direction, jnp.zeros(len(part)))
        else:
            obstacles = jax.tree.map(lambda x: x[..., rows], self.obstacles())
            found = OBSTACLES_APART(*args, obstacles, direction)
        return np.asarray(found.gaps), np.asarray(found.directions)

    def pose(self):
        position = jnp.asarray(self.position.T, jnp.float32)
        return position, jnp.asarray(np.moveaxis(self.rotation, 0, -1), jnp.float32)

    def obstacles(self):
        sizes = jnp.asarray(np.array([SHAPES[i][2] for i in self.other]).T, jnp.float32)
        return Sums(sizes[:3], sizes[3], sizes[4])


@pytest.fixture(scope="module", params=[False, True], ids=["obstacles", "parts"])
def pairs(request):
    return request.param, Pairs(request.param, 900)


def test_the_sign_is_that_of_mujocos_distance(pairs):
    with_parts, pairs = pairs
    gaps, _ = pairs.separated(PARTS, with_parts)
    distance = pairs.distance
    assert np.sum(np.abs(distance) < 0.01) > 300
    assert np.sum(distance > CLEAR) > 200
    assert np.sum(distance < PENETRATION) > 200
    assert not np.any(gaps[distance < PENETRATION] > 0.0)
    assert np.all(gaps[distance > CLEAR] > 0.0)
    assert np.all(gaps <= np.maximum(distance, 0.0) + 1e-6)


def test_the_direction_proves_the_gap_in_float64(pairs):
    with_parts, pairs = pairs
    gaps, directions = pairs.separated(PARTS, with_parts)
    position, rotation = (np.asarray(x, np.float64) for x in pairs.pose())
    for n in np.flatnonzero(gaps > 0.0):
        direction = directions[:, n].astype(np.float64)
        assert abs(np.linalg.norm(direction) - 1.0) < 1e-5
        direction /= np.linalg.norm(direction)
        seen = HULLS[pairs.part[n]].astype(np.float64) @ rotation[:, :, n].T + position[:, n]
        if with_parts:
            top = np.max(HULLS[pairs.other[n]].astype(np.float64) @ direction)
        else:
            *half_extents, disc, ball = np.float64(np.float32(SHAPES[pairs.other[n]][2]))
            top = np.abs(direction) @ half_extents + disc * np.hypot(*direction[:2]) + ball
        assert np.min(seen @ direction) - top >= gaps[n]


def test_a_pair_is_separated_alike_in_any_company(pairs):
    with_parts, pairs = pairs
    gaps, directions = pairs.separated(PARTS, with_parts)
    num, quickest = len(gaps), np.argsort(-gaps)
    for some in (quickest[: num // 2], quickest[num // 2 :], np.arange(num) // 9 * 9):
        rows = np.resize(some, num)
        again = pairs.separated(PARTS, with_parts, rows)
        np.testing.assert_array_equal(again[0], gaps[rows])
        np.testing.assert_array_equal(again[1], directions[:, rows])


def test_simplified_parts_are_refused_by_their_radius_at_most(pairs):
    with_parts, pairs = pairs
    gaps, _ = pairs.separated(SIMPLE, with_parts)
    radii = np.asarray(SIMPLE.radii)
    thicker = radii[pairs.part] + (radii[pairs.other] if with_parts else 0.0)
    assert not np.any(gaps[pairs.distance < 0.0] > 0.0)
    assert np.all(gaps[pairs.distance > CLEAR + thicker] > 0.0)


@pytest.mark.parametrize("tolerance", [1e-3, 5e-3])
def test_a_simplified_hull_encloses_the_hull(tolerance):
    for hull in HULLS:
        kept, radius = simplify(hull, tolerance)
        assert len(kept) < len(hull)
        assert radius <= tolerance
        assert {tuple(v) for v in kept} <= {tuple(v) for v in hull}
        assert max(_farther(v, kept) for v in hull) <= radius


def test_a_tolerance_without_room_is_refused():
    with pytest.raises(InputError, match=r"to 0\.0 m; take more than 1e-06"):
        simplify(HULLS[0], 0.0)


def _farther(point, kept):
    """The distance of some point of a hull to a point, and nearly of the nearest one, m."""
    corners = kept.astype(np.float64) - point
    system = np.vstack([corners.T, np.ones(len(kept))])
    weights = lsq_linear(system, [0.0, 0.0, 0.0, 1.0], (0.0, np.inf), method="bvls").x
    return np.linalg.norm(weights @ corners / weights.sum())


def small(vertices, radius):
    """A part of few vertices, as one of a size that all tests share."""
    return table([np.asarray(vertices, float), np.zeros((4, 3))], [radius, 0.0])


def one_vertex(radius):
    return small([[0.0, 0.0, 0.0]], radius)


def gap(parts, position, box=(0.0, 0.0, 0.0), disc=0.0, ball=0.0, rotation=None, direction=None):
    column = jnp.asarray(position, jnp.float32)[:, None]
    turn = jnp.asarray(np.eye(3) if rotation is None else rotation, jnp.float32)[:, :, None]
    obstacle = Sums(jnp.asarray(box)[:, None], jnp.asarray([disc]), jnp.asarray([ball]))
    start = column if direction is None else jnp.asarray(direction, jnp.float32)[:, None]
    part = jnp.zeros(1, int)
    return OBSTACLES_APART(parts, part, column, turn, obstacle, start).gaps.item()


def test_a_sphere_is_as_far_from_a_sphere_as_it_is():
    assert gap(one_vertex(0.1), [0.3, 0.0, 0.4], ball=0.2) == pytest.approx(0.2, abs=1e-5)
    assert gap(one_vertex(0.1), [0.0, 0.0, 0.30006], ball=0.2) > 0.0
    assert gap(one_vertex(0.1), [0.0, 0.0, 0.29999], ball=0.2) <= 0.0


def test_a_capsule_passes_a_cylinders_rim():
    capsule = small([[0.0, -0.5, 0.0], [0.0, 0.5, 0.0]], 0.02)
    # It lies across the rim, at 45 degrees beyond and above it.
    for beyond, free in ((0.0201, True), (0.0199, False)):
        place = [0.1 + beyond * np.sqrt(0.5), 0.0, 0.3 + beyond * np.sqrt(0.5)]
        assert (gap(capsule, place, box=(0.0, 0.0, 0.3), disc=0.1) > 0.0) == free


@pytest.mark.parametrize(("height", "free"), [(6e-5, True), (-1e-5, False), (0.0, False)])
def test_flat_hulls_and_boxes_that_touch_are_not_free(height, free):
    square = small([[x, y, 0.0] for x in (-0.1, 0.1) for y in (-0.1, 0.1)], 0.0)
    plate = (0.05, 0.3, 0.0)
    assert (gap(square, [0.0, 0.0, height], box=plate) > 0.0) == (free or height < 0)
    tilted = Rotation.from_euler("x", 0.3).as_matrix()
    lift = 0.1 * np.sin(0.3) + height
    assert (gap(square, [0.0, 0.0, lift], box=plate, rotation=tilted) > 0.0) == free


def test_bodies_with_the_same_middle_are_not_separated():
    square = [[x, y, 0.0] for x in (-0.1, 0.1) for y in (-0.1, 0.1)]
    tetrahedron = [[0.1, 0.1, 0.1], [0.1, -0.1, -0.1], [-0.1, 0.1, -0.1], [-0.1, -0.1, 0.1]]
    for vertices in ([[0.0, 0.0, 0.0]], [[0.0, 0.0, -0.1], [0.0, 0.0, 0.1]], square, tetrahedron):
        for box in ((0.0, 0.0, 0.0), (0.01, 0.02, 0.03), (0.2, 0.2, 0.0)):
            assert gap(small(vertices, 0.0), [0.0, 0.0, 0.0], box=box) <= 0.0
            assert gap(small(vertices, 0.0), [0.0, 0.0, 0.0], box=box, disc=0.1) <= 0.0


@pytest.mark.parametrize("first", [0.0, -1.0, 1e-20, 1e3, np.nan])
def test_any_first_direction_will_do(first):
    capsule = small([[0.0, -0.5, 0.0], [0.0, 0.5, 0.0]], 0.02)
    direction = [first, first, 0.0]
    assert gap(capsule, [0.3, 0.0, 0.3], box=(0.2, 0.2, 0.2), disc=0.05, direction=direction) > 0.0


@pytest.mark.parametrize("bad", ["vertices", "position", "rotation", "box", "radius"])
def test_nan_is_not_separated(bad):
    parts = one_vertex(np.nan if bad == "radius" else 0.1)
    if bad == "vertices":
        parts = small([[0.0, 0.0, 0.0], [np.nan, 0.0, 0.0]], 0.1)
    found = gap(
        parts,
        [np.nan if bad == "position" else 1.0, 0.0, 0.0],
        box=(np.nan if bad == "box" else 0.1, 0.1, 0.1),
        rotation=np.full((3, 3), np.nan) if bad == "rotation" else None,
    )
    assert not found > 0.0
