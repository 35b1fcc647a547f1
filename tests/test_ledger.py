"""The ledger of OMPL's planners: what is tested, once, and by which checker."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gnnjax.arm.robot import load_robot
from gnnjax.baselines.ledger import Ledger, fused_checks, mujoco_checks
from gnnjax.collision.checker import make_checker
from gnnjax.digest import digest
from gnnjax.scene.scene import make_scene
from tests.fine_scan import random_scene

CHECKERS = ["fused", "mujoco"]


NUM_BOXES = 3  # in all scenes here, so that little is compiled


@pytest.fixture(scope="module")
def robot(tiny_path):
    return load_robot(tiny_path)


@pytest.fixture(scope="module")
def fused_maker(robot):
    """For rotated boxes."""
    return fused_checks(robot, False, NUM_BOXES, 0.05)


def test_both_checkers_agree(robot, fused_maker):
    rng = np.random.default_rng(0)
    scene = jax.tree.map(lambda x: x[:NUM_BOXES], random_scene(rng, NUM_BOXES))
    fused, _ = fused_maker(scene, Ledger())
    engine, _ = mujoco_checks(robot, len(scene.mask))(scene, Ledger())
    nodes = rng.uniform(1.1 * robot.joint_lower, 1.1 * robot.joint_upper, (300, 3))
    found = [(fused(q), engine(q)) for q in nodes.astype(np.float32)]
    assert all(a == b for a, b in found)
    assert 0 < sum(a for a, _ in found) < len(found)


def test_neither_checker_takes_what_motors_cannot_hold(robot):
    weak = robot.at_rest_within(0.8, torque=5.0)
    scene = make_scene([], [], max_obstacles=NUM_BOXES)
    fused, _ = fused_checks(weak, True, NUM_BOXES, 0.05)(scene, Ledger())
    engine, _ = mujoco_checks(weak, NUM_BOXES)(scene, Ledger())
    for q, held in (([0.0, 0.0, 0.0], False), ([0.0, -1.2, 0.0], True)):
        assert fused(np.float32(q)) == engine(np.float32(q)) == held


def test_the_next_process_finds_the_compiled_checks(robot, monkeypatch):
    kept = []

    def keep(function):
        kept.append(function)
        return SimpleNamespace(code_for=lambda *args: lambda *args: (False, False, 0))

    monkeypatch.setattr("gnnjax.baselines.ledger.keep", keep)
    fused_checks.__wrapped__(robot, True, NUM_BOXES, 0.05)
    assert len({digest(function) for function in kept}) == 2  # what has none is not kept


@pytest.mark.parametrize("checker", CHECKERS)
def test_what_is_known_costs_nothing(robot, walled, checker):
    scene = jax.tree.map(lambda x: x[0], walled.scene)
    ledger, (start, end) = Ledger(), np.array([[1.6, 0, 0], [1.6, 0.5, 0]], np.float32)
    make = (
        fused_checks(robot, True, NUM_BOXES, 0.05)
        if checker == "fused"
        else mujoco_checks(robot, NUM_BOXES)
    )
    is_valid, test_edge = make(scene, ledger)

    def test():
        return ledger.know(end, is_valid) if test_edge is None else test_edge(start, end)

    assert ledger.know(start, is_valid)
    assert ledger.know_edge(start, end, test)
    counts = ledger.sampling_checks, ledger.search_checks, ledger.edge_checks
    assert counts[0] == counts[2] == 1
    if test_edge is not None:  # the end, and nine points
        assert counts[1] == 10
    assert ledger.know(end, is_valid)
    assert ledger.know(start, is_valid)
    assert ledger.know_edge(end, start, pytest.fail)
    assert (ledger.sampling_checks, ledger.search_checks, ledger.edge_checks) == counts


def test_the_fused_edge_is_that_of_the_checker(robot, fused_maker):
    rng = np.random.default_rng(1)
    scene = jax.tree.map(lambda x: x[:NUM_BOXES], random_scene(rng, NUM_BOXES))
    checker = make_checker(robot, resolution=0.05)
    starts, ends = rng.uniform(robot.joint_lower, robot.joint_upper, (2, 60, 3)).astype(np.float32)
    on_device = jax.tree.map(jnp.asarray, scene)
    known = np.asarray(jax.jit(checker.check_configurations)(on_device, jnp.asarray(ends)))
    edges = jax.jit(checker.check_edges)(on_device, jnp.asarray(starts), jnp.asarray(ends))
    for i in range(len(starts)):
        ledger = Ledger()
        _, test_edge = fused_maker(scene, ledger)
        assert test_edge(starts[i], ends[i]) == (known[i] and edges.valid[i])
        assert ledger.search_checks == 1 + (int(edges.num_checks[i]) if known[i] else 0)


def test_a_closed_ledger_tests_nothing():
    ledger, (start, end) = Ledger(), np.array([[0.0], [1.0]], np.float32)
    assert ledger.know(start, lambda q: True)
    assert ledger.know_edge(start, start, lambda: True)
    ledger.deadline = 0.0
    assert ledger.know(start, pytest.fail)
    assert ledger.know_edge(start, start, pytest.fail)
    assert not ledger.cut_off
    ledger.know(end, pytest.fail)
    ledger.know_edge(start, end, pytest.fail)
    assert ledger.cut_off
    assert (ledger.sampling_checks, ledger.edge_checks) == (1, 1)
    assert len(ledger.configurations) == len(ledger.edges) == 1
