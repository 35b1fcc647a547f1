"""Spheres of an arm that are tested by tables of pairs, as of arms with many."""

import jax
import jax.numpy as jnp
import numpy as np

from gnnjax.arm.kinematics import joint_terms
from gnnjax.arm.robot import load_robot
from gnnjax.collision import spheres
from gnnjax.collision.checker import make_checker
from tests.draws import random_boxes, random_configurations


def test_tables_say_what_straight_line_code_does(capsules, request):
    rng = np.random.default_rng(5)
    scene = random_boxes(rng, 3, rotated=True)
    q = random_configurations(rng, capsules, 600)
    q[5, 1] = np.nan
    found = []
    for _ in range(2):
        checker = make_checker(capsules)
        assert checker.levels is not None
        clear = checker.levels.second.clear_of_itself
        found.append(
            (
                jax.jit(checker.check_configurations)(scene, q),
                jax.jit(checker.clearance)(scene, q),
                jax.jit(checker.clearance)(random_boxes(rng, 0), q),  # to itself alone
                jax.jit(clear)(q[:64], np.arange(64) % 3 > 0),
            )
        )
        request.getfixturevalue("in_tables")
    for code, tables in zip(*found, strict=True):
        same = np.asarray(tables, float), np.asarray(code, float)
        np.testing.assert_allclose(*same, atol=1e-6)
    assert 0 < found[0][0].mean() < 1


def test_the_clearance_of_small_balls_far_from_each_other_is_that_by_tables_too(tmp_path, request):
    link = '<body pos="0 0 {}"><joint axis="{}" range="-3 3"/><geom size="0.06" pos="0 0 0.5"/>'
    links = [link.format(*x) for x in ((0, "0 1 0"), (0.5, "1 0 0"), (0.5, "0 1 0"))]
    path = tmp_path / "balls.xml"
    path.write_text(
        '<mujoco><compiler angle="radian"/><worldbody><geom size="0.03" pos="0 0 0.1"/>'
        f"{''.join(links)}{'</body>' * 3}</worldbody></mujoco>"
    )
    balls, rng, found = load_robot(path), np.random.default_rng(7), []
    q = random_configurations(rng, balls, 400)
    for _ in range(2):
        checker = make_checker(balls)
        tests = checker.clearance, checker.check_configurations
        found.append([np.asarray(jax.jit(test)(random_boxes(rng, 0), q), float) for test in tests])
        request.getfixturevalue("in_tables")
    for code, tables in zip(*found, strict=True):
        np.testing.assert_allclose(tables, code, atol=1e-6)
    assert (found[0][0] > 0.3).any()
    assert (found[0][1] == 0).any()


def test_a_row_is_of_two_links_and_its_balls_hold_its_spheres(capsules, in_tables):
    table = spheres.pair_table(capsules, capsules.sphere_pairs)
    assert {frozenset(x) for x in table.pairs.reshape(-1, 2).tolist()} == {
        frozenset(x) for x in capsules.sphere_pairs.tolist()
    }
    for q in random_configurations(np.random.default_rng(6), capsules, 20):
        centers = np.array(
            spheres.placed_spheres(capsules, joint_terms(capsules, jnp.asarray(q, jnp.float32)))
        )
        far, apart = (
            np.linalg.norm(centers[x[..., 0]] - centers[x[..., 1]], axis=-1)
            for x in (table.near, table.pairs)
        )
        gaps = (apart - capsules.sphere_radii[table.pairs].sum(axis=-1)).min(axis=1)
        assert (gaps >= far - table.reach - 1e-6).all()


def test_balls_that_no_joint_moves_against_each_other_are_compared_as_others_are(tmp_path):
    """Their distance is a number of Python's while kernels are traced."""
    path = tmp_path / "posts.xml"
    path.write_text(
        '<mujoco><compiler angle="radian"/><worldbody><body><geom size="0.05"/>'
        '<body pos="0 0 0.2"><joint axis="0 0 1" range="-3 3"/><geom size="0.05"/>'
        '<body pos="0 0 0.2"><joint axis="0 1 0" range="-2 2"/><geom size="0.05" pos="0 0 0.2"/>'
        "</body></body></body></worldbody></mujoco>"
    )
    check = jax.jit(make_checker(load_robot(path)).check_configurations)
    q = random_configurations(np.random.default_rng(0), load_robot(path), 20)
    assert check(random_boxes(np.random.default_rng(0), 0), q).all()
