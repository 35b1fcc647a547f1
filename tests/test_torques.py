"""Torques that hold an arm: MuJoCo's, and planning where they are within limits."""

import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from gnnjax.arm.robot import load_robot
from gnnjax.arm.torques import can_rest, rests
from gnnjax.arm_options import load_arm
from gnnjax.digest import digest
from gnnjax.errors import InputError
from gnnjax.evaluate import EvaluateConfig, planner_for
from gnnjax.generate import GenerateConfig, generate
from gnnjax.guide.guide import Guide, Prices
from gnnjax.guide.rest import with_rest
from gnnjax.plan import PlanConfig
from gnnjax.planning.load import load_planner
from gnnjax.planning.query import check_queries
from gnnjax.pose.goal import PoseGoal
from gnnjax.pose.inverse import inverse_kinematics
from gnnjax.problems.problem import Problem
from gnnjax.roadmap.stored import stored_roadmap
from gnnjax.scene.batches import stack_scenes
from gnnjax.scene.scene import make_scene
from gnnjax.scene.shapes import sphere
from tests.arms import HEAVY
from tests.conftest import TINY

NOTHING = make_scene([], [])
# Straight out the tiny arm needs 4.4 N m in joint b.
START, GOAL, TORQUE = np.array([0.0, -1.2, 0.0]), np.array([0.0, 1.2, 0.0]), 5.0


@pytest.fixture(scope="module")
def heavy(tmp_path_factory):
    path = tmp_path_factory.mktemp("robots") / "heavy.xml"
    path.write_text(HEAVY)
    return load_robot(path)


@pytest.fixture(scope="module")
def weak(tiny):
    return tiny.at_rest_within(0.8, torque=TORQUE)


def held_by(robot, q):
    """Torques [B D] by MuJoCo's C engine, of an arm without velocity: its bias forces, less what
    springs and bodies that carry themselves do."""
    data, found = mujoco.MjData(robot.mj_model), []
    for data.qpos[:] in q:
        mujoco.mj_forward(robot.mj_model, data)
        found.append(data.qfrc_bias - data.qfrc_passive)
    return np.abs(found)


@pytest.mark.parametrize("name", ["heavy", "kinova_gen3"])
def test_an_arm_rests_where_no_joint_needs_more_than_its_share(heavy, name):
    robot = heavy
    if name != "heavy":  # 3 kg in its last link
        named = [body.name for body in load_robot(name).bodies]
        robot = load_robot(name).attach(
            named[-1], [sphere([0, 0, 0], 0.001)], mass=3.0, allow=named
        )
    rng = np.random.default_rng(0)
    q = rng.uniform(robot.joint_lower, robot.joint_upper, (2000, robot.num_dof)).astype(np.float32)
    needed = held_by(robot, q)
    # So that each joint alone is what some are refused for.
    limit = np.quantile(needed, 0.85, axis=0) + 1e-3
    arm = robot.at_rest_within(0.5, torque=2 * limit)
    use = (needed / limit).max(axis=1)
    np.testing.assert_array_equal(rests(arm, q), use <= 1)
    kernel = np.asarray(jax.jit(functools.partial(can_rest, arm))(q))
    assert kernel.mean() > 0.2
    assert not kernel[use > 1].any()
    assert kernel[use < 1 - 2e-4].all()
    assert not can_rest(arm, jnp.full(arm.num_dof, jnp.nan))


def test_the_same_share_gives_the_same_arm_and_what_it_holds_weighs_on_it(tiny, weak):
    assert tiny.at_rest_within(0.8, torque=TORQUE) is weak
    assert tiny.rest_limit is None
    assert weak.name == tiny.name
    assert len({digest(r) for r in (tiny, weak, tiny.at_rest_within(0.7, torque=TORQUE))}) == 3
    q, ball = np.zeros((1, 3)), [sphere([0.2, 0, 0], 0.03)]
    strong = tiny.at_rest_within(1.0, torque=TORQUE)
    assert rests(strong, q)
    assert rests(strong.attach("lower", ball), q)
    for arm in (strong.attach("lower", ball, mass=1.0), tiny.attach("lower", ball, mass=1.0)):
        assert not rests(arm.at_rest_within(1.0, torque=TORQUE), q)
    assert not rests(strong.attach("lower", ball, mass=1.0), q)


def test_a_path_goes_where_the_arm_is_held_all_along(tiny, weak):
    plans = [load_planner(robot, num_nodes=60).plan(NOTHING, START, GOAL) for robot in (tiny, weak)]
    assert [plan.success for plan in plans] == [True, True]
    for plan, held in zip(plans, (False, True), strict=True):
        steps = np.linspace(0, 1, 200)[:, None, None]
        along = plan.path[:-1] + steps * np.diff(plan.path, axis=0)
        needed = held_by(weak, along.reshape(-1, 3))
        # Tested every 0.05 rad: in between it is as good as the same.
        assert (needed <= 1.001 * weak.rest_limit).all() == held
    assert plans[0].cost == pytest.approx(2.4, abs=1e-5)
    assert 2.4 < plans[1].cost < 3.5


def test_stored_nodes_and_configurations_that_reach_a_pose_are_held(weak, tiny):
    stored = stored_roadmap(weak, 60, 0)
    assert rests(weak, np.asarray(stored.nodes)[np.asarray(stored.node_mask)]).all()
    other = stored_roadmap(tiny, 60, 0)
    assert not rests(weak, np.asarray(other.nodes)[np.asarray(other.node_mask)]).all()
    # Whatever the last joint does, the last body is about there.
    pose = PoseGoal([0.7, 0, 0], [1.0, 0, 0, 0], free=["rx", "ry", "rz"], tolerance=(0.05, 0.1))
    every, held = (inverse_kinematics(robot, pose) for robot in (tiny, weak))
    assert held.valid.any()
    assert (held_by(weak, held.q[held.valid]) <= weak.rest_limit).all()
    assert (held_by(weak, every.q[every.valid]) > weak.rest_limit).any()


def test_a_guide_is_told_what_the_arm_cannot_hold(tiny, weak):
    def nothing(weights, reading):
        return Prices(lambda q: jnp.zeros(len(q)), lambda starts, ends, most: jnp.ones(len(starts)))

    stored = stored_roadmap(tiny, 60, 0)
    edges = jnp.full((2, *stored.neighbors.shape), 2.0)
    plain = Guide(3.0, lambda *of: None, nothing, lambda roadmap: 5, lambda *of: edges)
    assert with_rest(tiny, plain) is plain
    guide = with_rest(weak, plain)
    prices = guide.prices(guide.weights, None)
    steps = np.linspace(START, GOAL, 8, dtype=np.float32)
    good = (held_by(weak, steps) <= weak.rest_limit).all(axis=1)
    assert 0 < good.sum() < 8
    nodes = prices.nodes(jnp.asarray(steps))
    assert (nodes[good] < 0.7).all()
    assert (nodes[~good] > 1).all()
    # Straight out, and with the last joint bent.
    bent = np.array([0.0, 0.0, 1.2])
    ends = [jnp.asarray(np.stack([q, q + bent]), jnp.float32) for q in (START, GOAL)]
    out, folded = jax.jit(prices.motions, static_argnums=2)(*ends, 16)
    assert out > 8
    assert folded < 1.1
    found = guide.stored(guide.weights, None, guide.tabulate(stored))
    assert found.shape == edges.shape
    rows, slots = np.nonzero(np.asarray(stored.neighbor_mask))
    ends = stored.nodes[rows], stored.nodes[stored.neighbors[rows, slots]]
    fine = ends[0] + np.linspace(0, 1, 50)[:, None, None] * (ends[1] - ends[0])
    held = (held_by(weak, fine.reshape(-1, 3)) <= weak.rest_limit).all(axis=1)
    held = held.reshape(50, -1).all(axis=0)
    likely = np.asarray(found[1] - 2)[rows, slots] < np.log(2)
    assert 0.2 < held.mean() < 0.95
    assert (likely == held).mean() > 0.97


def test_ends_where_the_arm_is_not_held_are_refused_by_joint_and_torque(weak):
    problems = Problem(np.stack([START, 0 * GOAL]), np.stack([GOAL, GOAL]), None)
    problems = problems._replace(scene=stack_scenes([NOTHING] * 2))
    good, bad = check_queries(weak, problems)
    assert good is None
    assert bad == (
        "at start [0.0, 0.0, 0.0] joint b needs 4.415 N m to hold the arm and may take 4; carry "
        "less, allow a larger share, or choose another configuration"
    )


@pytest.mark.parametrize(
    ("share", "torque", "message"),
    [
        (0.0, 5.0, "share of torques at rest is 0.0; give one above 0, up to 1"),
        (1.5, 5.0, "at rest is 1.5; give"),
        (np.nan, 5.0, "at rest is nan; give"),
        (0.8, [5.0, -1.0, 5.0], "torque limits of tiny are .* give one positive number, or 3"),
        (0.8, None, "joint a of tiny has no torque limit .*; give torque=.*, or put actuatorfrc"),
    ],
)
def test_shares_and_limits_that_are_none_are_refused(tiny, share, torque, message):
    with pytest.raises(InputError, match=message):
        tiny.at_rest_within(share, torque=torque)


def test_an_arm_that_other_forces_hold_or_that_rests_nowhere_is_refused(tiny, tmp_path):
    tendon = """<tendon><fixed stiffness="9" springlength="0.1"><joint joint="b" coef="1"/></fixed>
        </tendon></mujoco>"""
    path = tmp_path / "tendon.xml"
    path.write_text(TINY.replace("</mujoco>", tendon))
    with pytest.raises(InputError, match="joint b of tendon is held by other forces than gravity"):
        load_robot(path).at_rest_within(0.8, torque=TORQUE)
    with pytest.raises(InputError, match="cannot rest within its share of torques at nearly"):
        stored_roadmap(tiny.at_rest_within(1e-4, torque=TORQUE), 60, 0)


def test_commands_take_a_share(tiny_path):
    options: dict = {"robot": "kinova_gen3", "rest_share": 0.5}
    limit = load_robot("kinova_gen3").torque_limit
    planned = PlanConfig(scene=Path(), **options)
    np.testing.assert_allclose(load_arm(planned).rest_limit, limit / 2)
    np.testing.assert_allclose(load_arm(planned, (30.0,)).rest_limit, [15.0] * 6)
    evaluated = EvaluateConfig(problems=Path(), json=Path(), **options)
    np.testing.assert_allclose(planner_for(evaluated).robot.rest_limit, limit / 2)
    with pytest.raises(InputError, match="joint a of tiny has no torque limit"):
        generate(GenerateConfig(robot=str(tiny_path), rest_share=0.5))
