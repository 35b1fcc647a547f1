"""Collision spheres that enclose a convex hull, few and close to it.

A planner's first test of a configuration is of spheres alone, and its speed is proportional to
their number. So spheres are added one at a time until none reaches further out of the hull than is
asked for, and each time all of them are moved to where the furthest reaches least.

A sphere whose center lies `depth` inside the hull reaches exactly `radius - depth` out of it: the
ball of radius `depth` touches the nearest face, and no point of the larger ball is further from the
smaller one. A point of the hull is then covered by that center at the cost of an overshoot of
`distance to the center - depth`, and the hull at the largest cost of its points: a smooth problem
once the largest is softened, which Adam solves in a fraction of a second.

Samples decide where spheres go, not whether they enclose: that is shown for every point of the
hull (`grown`), and where something is left the spheres grow.
"""

from typing import NamedTuple

import numpy as np

from gnnjax.errors import InputError

_SAMPLES = 1500  # on the surface; more of them change no cover by a millimetre
_STEPS = 250  # of the descent, for each number of spheres
_FLAT = 1e-4  # m; hulls that are thinner have no volume to compute with, and are made as thick
_CHUNK = 4_000_000  # numbers in one matrix of points and planes or spheres, 32 MB
_SMALLEST = 1e-3  # m; pieces of the hull are not divided further than this
_SLACK = 5e-4  # m by which spheres are larger than samples ask for, as most then need no more


class Hull:
    """A convex polytope, with its depth and samples of it.

    Raises:
        InputError: the vertices are none, or not finite.
    """

    def __init__(self, vertices: np.ndarray):
        from scipy.spatial import ConvexHull, QhullError  # half a second, for new arms alone

        vertices = np.asarray(vertices, float).reshape(-1, 3)
        if not len(vertices) or not np.isfinite(vertices).all():
            raise InputError("a hull needs vertices, and all of them finite")
        try:
            qhull = ConvexHull(vertices)
        except QhullError:  # flat, a line or a point
            box = np.stack(np.meshgrid(*[(-_FLAT, _FLAT)] * 3), axis=-1).reshape(-1, 3)
            vertices = (np.unique(vertices, axis=0)[:, None] + box).reshape(-1, 3)
            qhull = ConvexHull(vertices)
        self.vertices = vertices[qhull.vertices]
        self.triangles = vertices[qhull.simplices]  # [T 3 3]
        planes = np.unique(qhull.equations.round(9), axis=0)
        self.normals, self.offsets = planes[:, :3], planes[:, 3]
        self.area = float(qhull.area)  # m^2

    def depth(self, points: np.ndarray) -> np.ndarray:
        """Distance of points inside to the surface, in m; negative outside, and then no distance
        but the height above the highest plane."""
        return -self._heights(points)[0]

    def nearest_normal(self, points: np.ndarray) -> np.ndarray:
        """Normal of the nearest face, along which the depth falls fastest."""
        return self.normals[self._heights(points)[1]]

    def _heights(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Height above the highest plane, and which one that is."""
        rows = max(1, _CHUNK // len(self.offsets))
        heights, planes = np.empty(len(points)), np.empty(len(points), int)
        for first in range(0, len(points), rows):
            part = points[first : first + rows] @ self.normals.T + self.offsets
            planes[first : first + rows] = part.argmax(axis=1)
            heights[first : first + rows] = part.max(axis=1)
        return heights, planes

    def samples(self, num: int, rng: np.random.Generator) -> np.ndarray:
        """The vertices, thinned out, about `num` points on the surface and a third inside."""
        spacing = np.sqrt(self.area / num)
        a, b, c = self.triangles.swapaxes(0, 1)
        areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
        chosen = rng.choice(len(areas), 4 * num, p=areas / areas.sum())
        u, v = rng.uniform(size=(2, 4 * num, 1))
        u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
        surface = a[chosen] + u * (b - a)[chosen] + v * (c - a)[chosen]
        middle = self.vertices.mean(axis=0)
        inside = middle + rng.uniform(size=(num // 3, 1)) ** (1 / 3) * (
            surface[: num // 3] - middle
        )
        return np.concatenate(
            [_thinned(self.vertices, spacing / 3), _thinned(surface, spacing), inside]
        )


def _thinned(points: np.ndarray, spacing: float) -> np.ndarray:
    """One point of each cube of space."""
    cells = np.floor(points / spacing).astype(np.int64)
    return points[np.unique(cells, axis=0, return_index=True)[1]]


class Cover(NamedTuple):
    """Spheres whose union holds a hull."""

    centers: np.ndarray  # [S 3] m
    radii: np.ndarray  # [S] m
    depths: np.ndarray  # [S] m, of the centers in the hull: radii of balls inside of it

    @property
    def overshoot(self) -> float:
        """How far the furthest sphere reaches out of the hull, m."""
        return float((self.radii - self.depths).max())


def fit_covers(vertices: np.ndarray, *, overshoot: float, most: int, seed: int = 0) -> list[Cover]:
    """Encloses the convex hull of `vertices` by one sphere, by two, and so on.

    Args:
        vertices: `[V 3]` m.
        overshoot: where spheres reach no further, in m, no more of them are tried.
        most: spheres in the last cover.
        seed: of the samples.

    Returns:
        Covers that get better; more spheres that are no better are left out.

    Raises:
        InputError: the vertices are none, or not finite.
    """
    hull, rng = Hull(vertices), np.random.default_rng(seed)
    points = hull.samples(_SAMPLES, rng)
    centers, covers = np.empty((0, 3)), []
    for _ in range(most):
        centers = _descend(hull, points, _with_another(hull, points, centers))
        cover = _closed(hull, points, centers)
        if not covers or cover.overshoot < covers[-1].overshoot:
            covers.append(cover)
        if cover.overshoot <= overshoot:
            break
    return covers


def _with_another(hull: Hull, points: np.ndarray, centers: np.ndarray) -> np.ndarray:
    """Adds a center: the first in the middle, others half the way to what is covered worst."""
    if not len(centers):
        return points.mean(axis=0)[None]
    costs = _costs(hull, points, centers)
    worst = costs.min(axis=1).argmax()
    return np.concatenate([centers, (points[worst] + centers[costs[worst].argmin()])[None] / 2])


def _distances(points: np.ndarray, centers: np.ndarray) -> np.ndarray:
    squared = (points**2).sum(axis=1)[:, None] + (centers**2).sum(axis=1)
    return np.sqrt(np.maximum(squared - 2.0 * points @ centers.T, 0.0))


def _costs(hull: Hull, points: np.ndarray, centers: np.ndarray) -> np.ndarray:
    """The overshoot [m] with which each center covers each point `[P S]`."""
    return _distances(points, centers) - hull.depth(centers)


def _descend(hull: Hull, points: np.ndarray, centers: np.ndarray) -> np.ndarray:
    """Moves centers to where the largest cost is least: Adam on it, softened less and less."""
    mean, square = np.zeros_like(centers), np.zeros_like(centers)
    size = float(np.ptp(hull.vertices, axis=0).max())
    rows, best, least = np.arange(len(points)), centers, np.inf
    for step in range(_STEPS):
        costs = _costs(hull, points, centers)
        owner = costs.argmin(axis=1)
        cost = costs[rows, owner]
        if cost.max() < least:
            best, least = centers, cost.max()
        left = 1.0 - step / _STEPS
        weights = np.exp((cost - cost.max()) / (size * (0.002 + 0.03 * left)))
        toward = centers[owner] - points
        toward /= np.linalg.norm(toward, axis=1, keepdims=True) + 1e-9
        # A cost falls as its center comes nearer, and as that lies deeper.
        pull = (toward + hull.nearest_normal(centers)[owner]) * weights[:, None]
        gradient = np.stack(
            [np.bincount(owner, pull[:, k], len(centers)) for k in range(3)], axis=1
        )
        mean = 0.9 * mean + 0.1 * gradient
        square = 0.95 * square + 0.05 * gradient**2
        centers = centers - 0.02 * size * left * mean / (np.sqrt(square) + 1e-7)
        rise = np.minimum(hull.depth(centers), 0.0)  # back inside
        centers = centers + rise[:, None] * hull.nearest_normal(centers)
    return best


def _closed(hull: Hull, points: np.ndarray, centers: np.ndarray) -> Cover:
    """The smallest spheres that hold the points, grown until they hold the hull."""
    distances, depths = _distances(points, centers), hull.depth(centers)
    radii = np.full(len(centers), (distances - depths).min(axis=1).max()) + depths
    # One after the other, the shallowest first, shrinks to the points that no other holds.
    inside = distances <= radii + 1e-9
    for i in np.argsort(depths):
        alone = inside[:, i] & (inside.sum(axis=1) == 1)
        radii[i] = min(radii[i], distances[alone, i].max(initial=0.0))
        inside[:, i] = distances[:, i] <= radii[i] + 1e-9
    used = radii > 0
    centers, radii, depths = centers[used], radii[used], depths[used]
    radii = grown(hull, centers, radii + _SLACK) + 1e-6
    order = np.argsort(-radii)
    return Cover(centers[order], radii[order], depths[order])


def grown(hull: Hull, centers: np.ndarray, radii: np.ndarray) -> np.ndarray:
    """Radii [m], no smaller than those given, with which spheres hold all of a hull.

    The hull is cut into tetrahedra, and these into halves, until the corners of each are within one
    sphere, which then holds all of it. For what is smaller than a millimetre and not within
    one, the sphere that is nearest to having it grows.
    """
    radii = radii.copy()
    middle = np.broadcast_to(hull.vertices.mean(axis=0), hull.triangles[:, :1].shape)
    pieces = np.concatenate([middle, hull.triangles], axis=1)  # [T 4 3]
    rows = max(1, _CHUNK // (8 * len(centers)))
    while len(pieces):
        now, rest = pieces[:rows], pieces[rows:]  # the last in are the first out: few are kept
        distances = _distances(now.reshape(-1, 3), centers).reshape(len(now), 4, -1).max(axis=1)
        lengths = np.linalg.norm(now[:, _EDGES[:, 0]] - now[:, _EDGES[:, 1]], axis=-1)
        small = np.flatnonzero(lengths.max(axis=1) <= _SMALLEST)
        for piece in small[(distances[small] > radii).all(axis=1)]:
            if (distances[piece] > radii).all():
                nearest = (distances[piece] - radii).argmin()
                radii[nearest] = distances[piece, nearest]
        left_over = (distances > radii).all(axis=1)
        now, lengths = now[left_over], lengths[left_over]
        row = np.arange(len(now))
        first, second = _EDGES[lengths.argmax(axis=1)].T
        half = (now[row, first] + now[row, second]) / 2
        left, right = now.copy(), now.copy()
        left[row, first], right[row, second] = half, half
        pieces = np.concatenate([left, right, rest])
    return radii


_EDGES = np.array([(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)])
