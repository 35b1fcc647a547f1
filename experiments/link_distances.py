"""Finds which links of an arm can never meet: the link pairs that an MJCF may exclude.

    python -m experiments.link_distances --robot assets/kuka_iiwa14.xml \
        --hulls tests/data/kuka_iiwa14_hulls.npz

For each pair of links it prints the smallest distance of their true hulls (not of the collision
spheres) over all configurations within the joint limits, as far as random samples and a local
search from the best of them find it. Negative numbers are penetration depths. It is a search from
above: a pair is safe to exclude if what it finds is well above zero. Last comes the share of random
configurations in self-collision: by the spheres with the MJCF's exclusions, and by the hulls of the
same link pairs.
"""

import dataclasses
from pathlib import Path

import mujoco
import numpy as np
import tyro

from gnnjax.errors import InputError, run_command


@dataclasses.dataclass(frozen=True)
class DistanceConfig:
    """Smallest distances of link hulls within the joint limits."""

    robot: Path
    """The MJCF."""

    hulls: Path
    """An .npz with the hull vertices [V, 3] of each link, in m, under the body's name."""

    samples: int = 20_000
    """Random configurations for each pair of links."""

    starts: int = 10
    """So many of the closest samples are refined."""

    steps: int = 400
    """Random steps of each refinement, of shrinking size."""

    rate_samples: int = 10_000
    """Random configurations for the self-collision rates."""

    seed: int = 0


def hull_model(robot: Path, hulls: dict[str, np.ndarray]) -> mujoco.MjModel:
    """The MJCF with one more geom for each link, named hull/LINK, that collides with nothing."""
    spec = mujoco.MjSpec.from_file(str(robot))
    for name, vertices in hulls.items():
        if spec.body(name) is None:
            raise InputError(f"{robot} has no body {name!r}, of which there are hull vertices")
        spec.add_mesh(name=f"hull/{name}", uservert=vertices.astype(np.float64).ravel())
        spec.body(name).add_geom(
            name=f"hull/{name}",
            type=mujoco.mjtGeom.mjGEOM_MESH,
            meshname=f"hull/{name}",
            contype=0,
            conaffinity=0,
            mass=0,
        )
    return spec.compile()


class HullDistance:
    """Distance of the hulls of two links at a configuration, in m."""

    def __init__(self, model: mujoco.MjModel):
        self.model, self.data = model, mujoco.MjData(model)

    def __call__(self, q: np.ndarray, first: str, second: str) -> float:
        self.data.qpos[:] = q
        mujoco.mj_kinematics(self.model, self.data)
        return self.now(first, second)

    def now(self, first: str, second: str) -> float:
        a, b = (self.model.geom(f"hull/{name}").id for name in (first, second))
        return mujoco.mj_geomDistance(self.model, self.data, a, b, 2.0, None)


def smallest_distance(
    distance: HullDistance, first: str, second: str, config: DistanceConfig
) -> tuple[float, float, np.ndarray]:
    """Smallest and largest distance found, and the configuration of the smallest."""
    rng = np.random.default_rng(config.seed)
    model = distance.model
    lower, upper = model.jnt_range.T
    # Links of an arm follow one another, so the joints between two are those of the bodies after
    # the first, up to the second. The others do not move them against each other.
    a, b = model.body(first).id, model.body(second).id
    moves = (model.jnt_bodyid > a) & (model.jnt_bodyid <= b)
    samples = rng.uniform(lower, upper, size=(config.samples, model.njnt))
    samples[: config.samples // 4] = np.where(  # a quarter with some joints at their limits
        rng.uniform(size=(config.samples // 4, model.njnt)) < 0.4,
        np.where(rng.uniform(size=(config.samples // 4, model.njnt)) < 0.5, lower, upper),
        samples[: config.samples // 4],
    )
    samples[:, ~moves] = 0.0
    values = np.array([distance(q, first, second) for q in samples])
    best, where = np.inf, samples[0]
    for start in np.argsort(values)[: config.starts]:
        q, value = samples[start], values[start]
        for step in range(config.steps):
            scale = 0.3 * 0.985**step + 1e-4
            trial = np.clip(q + moves * rng.normal(scale=scale, size=q.shape), lower, upper)
            found = distance(trial, first, second)
            if found < value:
                q, value = trial, found
        if value < best:
            best, where = value, q
    return float(best), float(values.max()), where


def compare(config: DistanceConfig) -> dict[tuple[str, str], float]:
    """Prints the table and the rates; returns the smallest distance of each pair of links."""
    if not config.hulls.is_file():
        raise InputError(f"no hulls at {str(config.hulls)!r}; give an .npz of hull vertices")
    with np.load(config.hulls) as data:
        hulls = {name: data[name] for name in data.files if data[name].ndim == 2}
    model = hull_model(config.robot, hulls)
    distance = HullDistance(model)
    excluded = {(s >> 16, s & 0xFFFF) for s in model.exclude_signature.tolist()}
    names, found, kept = list(hulls), {}, []
    print("links                                          min [mm]  max [mm]")
    for i, first in enumerate(names):
        for second in names[i + 1 :]:
            bodies = tuple(sorted((model.body(first).id, model.body(second).id)))
            low, high, where = smallest_distance(distance, first, second, config)
            found[first, second] = low
            out = bodies in excluded
            kept += [] if out else [(first, second)]
            print(
                f"{first:22} {second:22} {1e3 * low:9.1f} {1e3 * high:9.1f}  "
                f"{'excluded' if out else '':8}  at {where.round(2).tolist()}",
                flush=True,
            )
    spheres, hull = self_collision_rates(distance, kept, config)
    print(f"in self-collision by spheres {100 * spheres:.2f} %, by hulls {100 * hull:.2f} %")
    return found


def self_collision_rates(
    distance: HullDistance, pairs: list[tuple[str, str]], config: DistanceConfig
) -> tuple[float, float]:
    """Share of random configurations in self-collision, by the spheres and by the hulls."""
    rng = np.random.default_rng(config.seed + 1)
    model, data = distance.model, distance.data
    by_spheres = by_hulls = 0
    for q in rng.uniform(*model.jnt_range.T, size=(config.rate_samples, model.njnt)):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_collision(model, data)
        hit = bool((data.contact.dist < 0).any())
        by_spheres += hit
        by_hulls += any(distance.now(*pair) < 0 for pair in pairs)
    return by_spheres / config.rate_samples, by_hulls / config.rate_samples


def main() -> None:
    compare(tyro.cli(DistanceConfig))


if __name__ == "__main__":
    run_command(main)
