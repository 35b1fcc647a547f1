"""Finds which links of an arm can never meet: the link pairs that an MJCF may exclude.

    python -m experiments.link_distances kuka_iiwa14
    python -m experiments.link_distances franka_panda --hold finger_joint_1 0 finger_joint_2 0

For each pair of parts (not of the spheres around them) it prints the smallest distance over all
configurations within the joint limits, as far as random samples and a local search from the best of
them find it. Negative numbers are penetration depths. It is a search from above: a pair is safe to
exclude if what it finds is well above zero. Last comes the share of random configurations in
self-collision: by the spheres and by the parts, of the pairs that are tested.
"""

import dataclasses
import itertools

import mujoco
import numpy as np
import tyro

from gnnjax.arguments import parse_arguments
from gnnjax.arm.robot import Robot, load_robot
from gnnjax.errors import run_command


@dataclasses.dataclass(frozen=True)
class DistanceConfig:
    """Smallest distances of an arm's parts within the joint limits."""

    robot: tyro.conf.Positional[str]
    """Shipped robot, or path of an MJCF or URDF."""

    hold: dict[str, float] = dataclasses.field(default_factory=dict)
    """Joints that do not move, and where they are held, rad or m."""

    samples: int = 20_000
    """Random configurations for each pair of parts."""

    starts: int = 10
    """So many of the closest samples are refined."""

    steps: int = 400
    """Random steps of each refinement, of shrinking size."""

    rate_samples: int = 10_000
    """Random configurations for the self-collision rates; 0 leaves them out."""

    seed: int = 0


class PartDistance:
    """Distance of two parts at a configuration, in m, by MuJoCo's C engine."""

    def __init__(self, robot: Robot):
        self.robot, self.model = robot, robot.mj_model
        self.data = mujoco.MjData(self.model)

    def __call__(self, q: np.ndarray, first: int, second: int) -> float:
        self.move(q)
        return self.now(first, second)

    def move(self, q: np.ndarray) -> None:
        self.data.qpos[:] = q
        mujoco.mj_kinematics(self.model, self.data)

    def now(self, first: int, second: int) -> float:
        a, b = self.robot.part_geoms[[first, second]].tolist()
        return mujoco.mj_geomDistance(self.model, self.data, a, b, 2.0, None)

    def of_spheres(self) -> float:
        """Least distance of the spheres that are tested against one another."""
        robot, bodies = self.robot, self.robot.sphere_bodies + 1
        turns = self.data.xmat[bodies].reshape(-1, 3, 3)
        centers = self.data.xpos[bodies] + (turns @ robot.sphere_centers[..., None])[..., 0]
        a, b = robot.sphere_pairs.T
        gaps = np.linalg.norm(centers[a] - centers[b], axis=1)
        return float(np.min(gaps - robot.sphere_radii[a] - robot.sphere_radii[b], initial=np.inf))


def smallest_distance(
    distance: PartDistance, first: int, second: int, config: DistanceConfig
) -> tuple[float, float, np.ndarray]:
    """Smallest and largest distance found, and the configuration of the smallest."""
    rng = np.random.default_rng(config.seed)
    model = distance.model
    lower, upper = model.jnt_range.T
    moves = _moving(distance.robot, first, second)
    samples = rng.uniform(lower, upper, size=(config.samples, model.njnt))
    samples[: config.samples // 4] = np.where(  # a quarter with some joints at their limits
        rng.uniform(size=(config.samples // 4, model.njnt)) < 0.4,
        np.where(rng.uniform(size=(config.samples // 4, model.njnt)) < 0.5, lower, upper),
        samples[: config.samples // 4],
    )
    samples[:, ~moves] = 0.0
    if not moves.any():
        samples = samples[:1]
    values = np.array([distance(q, first, second) for q in samples])
    best, where = np.inf, samples[0]
    for start in np.argsort(values)[: config.starts]:
        q, value = samples[start], values[start]
        for step in range(config.steps if moves.any() else 0):
            scale = 0.3 * 0.985**step + 1e-4
            trial = np.clip(q + moves * rng.normal(scale=scale, size=q.shape), lower, upper)
            found = distance(trial, first, second)
            if found < value:
                q, value = trial, found
        if value < best:
            best, where = value, q
    return float(best), float(values.max()), where


def _moving(robot: Robot, first: int, second: int) -> np.ndarray:
    """Which joints `[D]` move two parts against each other: those that carry one of them alone."""

    def carrying(part: int) -> np.ndarray:
        joints, body = np.zeros(robot.num_dof, bool), robot.parts[part].body
        while body >= 0:
            joints[[joint.index for joint in robot.bodies[body].joints]] = True
            body = robot.bodies[body].parent
        return joints

    return carrying(first) != carrying(second)


def compare(config: DistanceConfig) -> dict[tuple[str, str], float]:
    """Prints the table and the rates; returns the smallest distance of each pair of parts."""
    robot = load_robot(config.robot, hold=config.hold)
    distance, found = PartDistance(robot), {}
    tested = {tuple(pair) for pair in robot.part_pairs.tolist()}
    print("parts                                          min [mm]  max [mm]")
    for first, second in itertools.combinations(range(len(robot.parts)), 2):
        names = robot.parts[first].name, robot.parts[second].name
        low, high, where = smallest_distance(distance, first, second, config)
        found[names] = low
        print(
            f"{names[0]:22} {names[1]:22} {1e3 * low:9.1f} {1e3 * high:9.1f}  "
            f"{'' if (first, second) in tested else 'excluded':8}  at {where.round(2).tolist()}",
            flush=True,
        )
    if config.rate_samples:
        spheres, parts = self_collision_rates(distance, config)
        print(f"in self-collision by spheres {100 * spheres:.2f} %, by parts {100 * parts:.2f} %")
    return found


def self_collision_rates(distance: PartDistance, config: DistanceConfig) -> tuple[float, float]:
    """Share of random configurations in self-collision, by the spheres and by the parts."""
    rng, model = np.random.default_rng(config.seed + 1), distance.model
    by_spheres = by_parts = 0
    for q in rng.uniform(*model.jnt_range.T, size=(config.rate_samples, model.njnt)):
        distance.move(q)
        by_spheres += distance.of_spheres() <= 0
        by_parts += any(distance.now(*two) < 0 for two in distance.robot.part_pairs.tolist())
    return by_spheres / config.rate_samples, by_parts / config.rate_samples


def main() -> None:
    compare(parse_arguments(DistanceConfig))


if __name__ == "__main__":
    run_command(main)
