"""Points drawn at random, and distances to them by brute force."""

import numpy as np
from scipy.spatial.distance import cdist

# Blobs, a wall without thickness, and points so far away that the grid does not hold them.
KINDS = ("blob", "wall", "one", "far", "around")


def draw(rng, kind):
    if kind == "blob":
        return rng.normal(0, 0.25, (400, 3)) + rng.normal(0, 0.4, 3)
    if kind == "wall":
        side = np.arange(-1, 1, 0.03) + rng.uniform(0, 0.03)
        return np.stack(np.meshgrid(side, side, [0.5]), axis=-1).reshape(-1, 3)
    if kind == "one":
        return rng.uniform(-0.5, 0.5, (1, 3))
    if kind == "far":
        return rng.uniform(3.5, 4.0, (50, 3)) * [1, -1, 1]
    return rng.normal(0, 4.0, (2000, 3))


def brute_force(points, at):
    """Distances [m] of places `[N, 3]` to the nearest of points."""
    return cdist(at, points).min(axis=1)
