"""Fits collision spheres to the convex hulls of an arm's links.

    python -m experiments.fit_collision --hulls tests/data/kuka_iiwa14_hulls.npz \
        --out assets/kuka_iiwa14.xml --base link_0

The hull of each link, as a volume, lies in the union of that link's spheres, and no sphere reaches
further than `max_overshoot` out of the hull. Under these two conditions the number of spheres is
made as small as a search of `seconds` finds, because a planner's speed is proportional to it.

A sphere whose center lies `depth` inside the hull reaches exactly `radius - depth` out of it: the
ball of radius `depth` touches the nearest face, and no point of the larger ball is further from the
smaller one. So each center has one largest radius, `depth + max_overshoot`, and what is left is to
place the centers. A greedy set cover gives the first solution. Then spheres are taken away one by
one, and the rest is moved until it covers all points again.
"""

import dataclasses
import json
import re
import time
from pathlib import Path

import numpy as np
import tyro
from scipy.spatial import ConvexHull

from gnnjax.errors import InputError, run_command
from gnnjax.files import atomic_write

MARGIN = 1.5e-4  # m by which samples are covered: pays for rounding to 0.1 mm


@dataclasses.dataclass(frozen=True)
class FitConfig:
    """Fit collision spheres to link hulls."""

    hulls: Path
    """An .npz with the hull vertices [V, 3] of each link, in m, under the link's name."""

    out: Path
    """Output: .json for the numbers, or an existing MJCF (.xml) whose geoms of class "collision"
    are replaced in the bodies that bear the links' names (see `write_mjcf`)."""

    max_overshoot: float = 0.025
    """How far a sphere may reach out of its link's hull, in m."""

    base: str = ""
    """A link that does not move, and may overshoot by `base_overshoot` to need fewer spheres."""

    base_overshoot: float = 0.04
    """The same limit for the base, in m."""

    spacing: float = 0.002
    """No point of a hull's surface is further than this from a sample, in m. All samples end up
    inside the spheres, so nothing sticks out by more than this, and far less in practice."""

    seconds: float = 60.0
    """Time for the search, for each link."""

    links: tuple[str, ...] = ()
    """Fit these links only (all of them if empty)."""

    seed: int = 0


class Hull:
    """A convex polytope, with its depth and samples on its surface and in its volume."""

    def __init__(self, vertices: np.ndarray):
        qhull = ConvexHull(vertices)
        self.vertices = vertices[qhull.vertices]
        self.triangles = vertices[qhull.simplices]  # [T 3 3]
        planes = np.unique(qhull.equations.round(9), axis=0)
        self.normals, self.offsets = planes[:, :3], planes[:, 3]

    def depth(self, points: np.ndarray) -> np.ndarray:
        """Distance of points inside to the surface, in m; negative outside."""
        return -(points @ self.normals.T + self.offsets).max(axis=1)

    def nearest_normal(self, points: np.ndarray) -> np.ndarray:
        """Normal of the nearest face, along which the depth falls fastest."""
        return self.normals[(points @ self.normals.T + self.offsets).argmax(axis=1)]

    def surface(self, spacing: float) -> np.ndarray:
        """Points on the surface, such that none of it is further than `spacing` from a point."""
        samples = [self.vertices]
        for a, b, c in self.triangles:
            longest = max(np.linalg.norm(b - a), np.linalg.norm(c - b), np.linalg.norm(a - c))
            # Points of a triangle lie within longest / sqrt(3) of a corner; thinning adds 0.38.
            n = int(np.ceil(longest / (np.sqrt(3.0) * 0.6 * spacing)))
            i, j = np.mgrid[: n + 1, : n + 1]
            i, j = i[i + j <= n], j[i + j <= n]
            samples.append(a + np.outer(i / n, b - a) + np.outer(j / n, c - a))
        points = np.concatenate(samples)
        cells = (points / (0.22 * spacing)).round().astype(np.int64)
        return points[np.unique(cells, axis=0, return_index=True)[1]]

    def interior(self, spacing: float) -> np.ndarray:
        """A grid of points inside."""
        lower, upper = self.vertices.min(axis=0), self.vertices.max(axis=0)
        axes = [np.arange(a + spacing / 2, b, spacing) for a, b in zip(lower, upper, strict=True)]
        points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        return points[self.depth(points) > 0]


def gaps(points: np.ndarray, centers: np.ndarray, radii: np.ndarray) -> np.ndarray:
    """How far each point lies outside each sphere, in m `[points, spheres]`."""
    squared = (points**2).sum(axis=1)[:, None] + (centers**2).sum(axis=1)
    return np.sqrt(np.maximum(squared - 2.0 * points @ centers.T, 0.0)) - radii


def greedy_centers(
    hull: Hull, points: np.ndarray, overshoot: float, rng: np.random.Generator
) -> np.ndarray:
    """Centers whose spheres cover all points, each chosen to cover most of what is left."""
    lower, upper = hull.vertices.min(axis=0), hull.vertices.max(axis=0)
    centers = rng.uniform(lower, upper, size=(20_000, 3))
    centers = centers[hull.depth(centers) > 0][:1500]
    # Every point has a candidate of its own just below the surface, so that a cover exists.
    sunk = points - 1e-4 * hull.nearest_normal(points)
    centers = np.concatenate([centers, sunk[hull.depth(sunk) > 0]])
    covers = gaps(points, centers, hull.depth(centers) + overshoot) < -MARGIN
    if not covers.any(axis=1).all():
        raise InputError(
            f"an overshoot of {overshoot} m is too small; the hull is then not covered"
        )
    left, chosen = np.ones(len(points), dtype=bool), []
    while left.any():
        chosen.append(int(covers[left].sum(axis=0).argmax()))
        left &= ~covers[:, chosen[-1]]
    return centers[chosen]


def move_centers(
    hull: Hull,
    points: np.ndarray,
    centers: np.ndarray,
    overshoot: float,
    steps: int,
    rng: np.random.Generator,
) -> np.ndarray | None:
    """Moves centers until their spheres cover all points: Adam on the squared gaps, with noise."""
    mean, square = np.zeros_like(centers), np.zeros_like(centers)
    for step in range(steps):
        gap = gaps(points, centers, hull.depth(centers) + overshoot) + MARGIN
        nearest = gap.argmin(axis=1)
        gap = gap[np.arange(len(points)), nearest]
        out = np.flatnonzero(gap > 0)
        if not len(out):
            return centers
        owner = nearest[out]
        toward = centers[owner] - points[out]
        toward /= np.linalg.norm(toward, axis=1, keepdims=True)
        gradient = np.zeros_like(centers)
        # A gap closes as its sphere comes nearer, and as the sphere grows with its depth.
        pull = toward + hull.nearest_normal(centers)[owner]
        np.add.at(gradient, owner, pull * gap[out, None])
        mean = 0.9 * mean + 0.1 * gradient
        square = 0.95 * square + 0.05 * gradient**2
        left = 1.0 - step / steps
        centers = centers - 0.003 * left * mean / (np.sqrt(square) + 1e-7)
        if step % 50 == 25:
            centers = centers + rng.normal(scale=0.002 * left, size=centers.shape)
        rise = np.minimum(hull.depth(centers) - 1e-4, 0.0)  # back inside
        centers = centers + rise[:, None] * hull.nearest_normal(centers)
    return None


def fit_link(hull: Hull, overshoot: float, config: FitConfig) -> np.ndarray:
    """Spheres [S, 4] (center and radius, in m, the largest first) that enclose a hull."""
    rng = np.random.default_rng(config.seed)
    start = time.monotonic()
    fine = np.concatenate([hull.surface(config.spacing), hull.interior(2.0 * config.spacing)])
    points = np.concatenate([hull.surface(0.007), hull.interior(0.014)])
    best, centers, attempt = None, greedy_centers(hull, points, overshoot, rng), 0
    while True:
        if centers is not None:  # covers the coarse points; those of the fine that stick out join
            gap = gaps(fine, centers, hull.depth(centers) + overshoot).min(axis=1) + MARGIN
            if (gap > 0).any():
                points = np.concatenate(
                    [points, fine[np.argsort(-gap)[: min(300, (gap > 0).sum())]]]
                )
                centers = move_centers(hull, points, centers, overshoot, 600, rng)
                if best is None and centers is None:
                    centers = greedy_centers(hull, points, overshoot, rng)
                continue
            best, attempt = centers, 0
        if (time.monotonic() - start > config.seconds and best is not None) or len(best) == 1:
            return shrink(hull, fine, best, overshoot)
        # Take away the sphere that covers least alone, or now and then another one.
        inside = gaps(points, best, hull.depth(best) + overshoot) <= 0
        alone = (inside & (inside.sum(axis=1) == 1)[:, None]).sum(axis=0)
        rank = min(int(rng.exponential(2.0)) if attempt else 0, len(best) - 1)
        rest = np.delete(np.asarray(best), int(np.argsort(alone)[rank]), axis=0)
        rest = rest + rng.normal(scale=(0.001, 0.004, 0.012)[attempt % 3], size=rest.shape)
        centers = move_centers(hull, points, rest, overshoot, (150, 300, 500)[attempt % 3], rng)
        attempt += 1


def shrink(hull: Hull, points: np.ndarray, centers: np.ndarray, overshoot: float) -> np.ndarray:
    """Gives each sphere the smallest radius with which all of them enclose the points."""
    radii = hull.depth(centers) + overshoot
    distance = gaps(points, centers, np.zeros(len(centers)))
    inside = distance <= radii - MARGIN
    for i in np.argsort(hull.depth(centers)):
        alone = inside[:, i] & (inside.sum(axis=1) == 1)
        radii[i] = min(radii[i], distance[alone, i].max(initial=0.0) + MARGIN)
        inside[:, i] = distance[:, i] <= radii[i] - MARGIN
    return np.column_stack([centers, radii])[np.argsort(-radii)].round(4)


def describe(hull: Hull, spheres: np.ndarray, spacing: float) -> tuple[float, float]:
    """What sticks out of the spheres at the fine samples, and the largest overshoot, in m."""
    points = np.concatenate([hull.surface(spacing / 2), hull.interior(2.0 * spacing)])
    out = gaps(points, spheres[:, :3], spheres[:, 3]).min(axis=1).max()
    return float(max(out, 0.0)), float((spheres[:, 3] - hull.depth(spheres[:, :3])).max())


def write_mjcf(path: Path, spheres: dict[str, np.ndarray]) -> None:
    """Replaces the collision geoms of an MJCF, line by line, so that all the rest stays as it is.

    Each body needs its name on the line of its `<body` tag and an `<inertial .../>` of one line;
    the spheres come after that. A default class "collision" has to make them spheres.
    """
    lines, current, done = [], "", set()
    for line in path.read_text(encoding="utf-8").splitlines():
        if match := re.search(r'<body name="([^"]+)"', line):
            current = match[1]
        if re.search(r'<geom class="collision"', line) and current in spheres:
            continue
        lines.append(line)
        if "<inertial" in line and current in spheres:
            indent = line[: len(line) - len(line.lstrip())]
            lines += [
                f'{indent}<geom class="collision" pos="{x:.4f} {y:.4f} {z:.4f}" size="{r:.4f}"/>'
                for x, y, z, r in spheres[current]
            ]
            done.add(current)
    if missing := sorted(set(spheres) - done):
        raise InputError(f"no <body> with an <inertial/> for {missing} in {str(path)!r}")
    atomic_write(path, lambda part: part.write_text("\n".join(lines) + "\n", encoding="utf-8"))


def fit(config: FitConfig) -> dict[str, np.ndarray]:
    """Fits all links, prints a table and writes the spheres."""
    if not config.hulls.is_file():
        raise InputError(f"no hulls at {str(config.hulls)!r}; give an .npz of hull vertices")
    with np.load(config.hulls) as data:
        vertices = {
            name: data[name].astype(np.float64)
            for name in data.files
            if data[name].ndim == 2 and not name.endswith("__surface")
        }
    if unknown := sorted(({*config.links, config.base} - {""}) - set(vertices)):
        raise InputError(f"no link {unknown} in {str(config.hulls)!r}; there are {list(vertices)}")
    spheres = {}
    print(f"{'link':24} spheres  sticks out [mm]  overshoot [mm]")
    for name in config.links or tuple(vertices):
        hull = Hull(vertices[name])
        overshoot = config.base_overshoot if name == config.base else config.max_overshoot
        spheres[name] = fit_link(hull, overshoot, config)
        out, over = describe(hull, spheres[name], config.spacing)
        print(f"{name:24} {len(spheres[name]):7} {1e3 * out:16.2f} {1e3 * over:15.1f}", flush=True)
    print(f"{'all':24} {sum(map(len, spheres.values())):7}")
    if config.out.suffix == ".xml":
        write_mjcf(config.out, spheres)
    else:
        text = json.dumps({name: found.tolist() for name, found in spheres.items()}, indent=1)
        atomic_write(config.out, lambda part: part.write_text(text + "\n", encoding="utf-8"))
    return spheres


def main() -> None:
    fit(tyro.cli(FitConfig))


if __name__ == "__main__":
    run_command(main)
