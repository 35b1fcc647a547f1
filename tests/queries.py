"""Random queries, and what their plans are held against, of tests in several files."""

import jax
import numpy as np

from gnnjax.collision.certify import certify_path
from gnnjax.collision.clearances import configuration_clearance
from gnnjax.problems.problem import Problem
from gnnjax.scene.scene import make_scene
from tests.fine_scan import collides_anywhere


def random_problem(robot, rng, num=5):
    centers = rng.uniform(-0.8, 0.8, (num, 3))
    centers *= np.maximum(1, 0.5 / np.linalg.norm(centers, axis=1))[:, None]
    scene = make_scene(centers, rng.uniform(0.05, 0.22, (num, 3)))
    while True:
        ends = rng.uniform(robot.joint_lower, robot.joint_upper, (2, 3)).astype(np.float32)
        if min(configuration_clearance(robot, scene, q) for q in ends) > 0:
            return Problem(ends[0], ends[1], scene)


def one(problems, i):
    return jax.tree.map(lambda x: x[i], problems)


def same(first, second):
    """Whether two plans agree in all but their times."""
    for ours, theirs in zip(first, second, strict=True):
        drop = {"planning_time_s": 0.0, "total_time_s": 0.0}
        ours, theirs = ours._replace(**drop), theirs._replace(**drop)
        if not all(np.array_equal(a, b) for a, b in zip(ours, theirs, strict=True)):
            return False
    return True


def check_path(robot, problem, plan):
    assert plan.certified
    np.testing.assert_array_equal(plan.path[[0, -1]], [problem.start, problem.goal])
    assert certify_path(robot, problem.scene, plan.path)
    assert not collides_anywhere(robot, problem.scene, plan.path, step=0.01)
    steps = np.linalg.norm(np.diff(plan.path.astype(float), axis=0), axis=1)
    np.testing.assert_allclose(plan.cost, steps.sum(), rtol=1e-5)
    assert plan.reason == ""
