"""Motions carried out in simulation, against plain loops and closed forms."""

import inspect
import re

import mujoco
import numpy as np
import pytest

from gnnjax.arm.robot import load_robot
from gnnjax.arm.torques import inverse_dynamics_by_mujoco
from gnnjax.errors import InputError
from gnnjax.planning.query import unit_of
from gnnjax.scene.allowed import allow_contacts
from gnnjax.scene.batches import stack_scenes
from gnnjax.scene.cloud import point_cloud
from gnnjax.scene.mujoco_world import obstacles
from gnnjax.scene.scene import make_scene, scene_from_shapes
from gnnjax.scene.shapes import box, sphere
from gnnjax.trajectory import execution
from gnnjax.trajectory.control import control, inertias
from gnnjax.trajectory.execution import (
    execute_trajectories,
    execute_trajectory,
    motion_clearance,
)
from gnnjax.trajectory.files import load_trajectory, save_trajectory
from gnnjax.trajectory.limits import limits_of
from gnnjax.trajectory.simulate import DT, ModelErrors, build_true_world
from gnnjax.trajectory.states import followed, largest_use, sample_trajectory
from gnnjax.trajectory.steps import at_steps
from gnnjax.trajectory.trajectory import time_path, time_paths
from tests.conftest import TINY

NOTHING = make_scene([], [])
TORQUE = np.array([40.0, 40.0, 20.0])
PATH = [[0.0, 0.0, 0.0], [1.0, 0.5, 0.0], [1.5, 0.0, 0.4]]
SPEEDS = {"velocity": 1.0, "acceleration": 3.0}


@pytest.fixture(scope="module")
def robot(tiny_path):
    return load_robot(tiny_path)


@pytest.fixture(scope="module")
def motion(robot):
    return time_path(robot, NOTHING, PATH, **SPEEDS)


def in_the_way(robot, motion, size=0.05):
    """A scene with a box where the last link is in the middle of a motion."""
    points = sample_trajectory(robot, motion, motion.duration / 2)
    data = mujoco.MjData(robot.mj_model)
    data.qpos = points.positions[1]
    mujoco.mj_kinematics(robot.mj_model, data)
    return scene_from_shapes([box(data.geom_xpos[-1], [size] * 3)])


def looped(robot, scene, found, controller, errors):
    """Positions and torques of a motion that was executed, step by step in one simulation."""
    model = build_true_world(robot, scene, errors)
    data, late = mujoco.MjData(model), round(errors.delay / DT)
    wanted = found.trace.wanted
    law = control(robot, controller, wanted)
    data.qpos, data.qvel = wanted.positions[0], wanted.velocities[0]
    told = [law.before] * late
    places, torques = [], []
    for step in range(len(wanted.times)):
        places.append(data.qpos.copy())
        off = law.kp * (wanted.positions[step] - data.qpos)
        off += law.kd * (law.velocities[step] - data.qvel)
        told.append(law.rest[step] + law.weight[step] @ off)
        data.qfrc_applied = np.clip(told[step], -TORQUE, TORQUE)
        torques.append(data.qfrc_applied.copy())
        mujoco.mj_step(model, data)
    return np.array(places), np.array(torques)


@pytest.mark.parametrize("controller", ["computed_torque", "position"])
@pytest.mark.parametrize(
    "errors",
    [ModelErrors(), ModelErrors(mass=0.3, friction=0.2, payload=0.5), ModelErrors(delay=0.003)],
)
def test_motions_are_those_of_a_plain_loop(robot, motion, controller, errors):
    scene = in_the_way(robot, motion)  # contacts, too
    found = execute_trajectory(
        robot, scene, motion, controller=controller, torque=TORQUE, errors=errors
    )
    places, torques = looped(robot, scene, found, controller, errors)
    np.testing.assert_allclose(found.trace.positions, places, atol=1e-6)
    np.testing.assert_allclose(found.trace.torques, torques, atol=1e-3)
    assert found.touched


def test_an_arm_that_is_as_its_model_follows_by_computed_torque(robot, motion):
    found = execute_trajectory(robot, NOTHING, motion, torque=TORQUE)
    assert found.success, found.reason
    assert found.settled
    assert found.max_error.max() < 2e-3
    assert (found.rms_error <= found.max_error).all()
    assert found.goal_error < 1e-4
    assert found.duration == pytest.approx(motion.duration, abs=DT)
    assert (found.depth, found.touched_at, found.touched) == (0.0, np.inf, ())
    assert found.torque_use == pytest.approx(np.abs(found.trace.torques / TORQUE).max())
    assert 0.1 < found.torque_use < 1


@pytest.mark.parametrize("torque", [0.9, 1.2])
def test_dry_friction_holds_up_to_its_torque_and_no_further(tmp_path, torque):
    file, inertia = tmp_path / "light.xml", 0.4 * 0.05 * 0.05**2  # kg m^2
    file.write_text(
        '<mujoco><worldbody><body><joint name="a" axis="0 0 1"/>'
        '<geom type="sphere" size="0.05" mass="0.05"/></body></worldbody></mujoco>'
    )
    model = build_true_world(load_robot(file), NOTHING, ModelErrors(friction=1.0))
    data = mujoco.MjData(model)
    data.qfrc_applied = torque
    mujoco.mj_step(model, data, 20)
    expected = max(torque - 1.0, 0.0) / inertia * 20 * DT
    np.testing.assert_allclose(data.qvel, expected, rtol=0.01, atol=0.1)


BALL = '<geom type="sphere" size="0.05" mass="1"/>'
HINGE = f"""<body pos="0.3 0 0"><joint name="a" axis="0 1 0" range="-3 3"/>{BALL}</body>"""
GANTRY = f"""<body pos="0.3 0 0"><joint name="x" type="slide" axis="1 0 0" range="0 1"/>{BALL}
<body pos="0 0 0.3"><joint name="z" type="slide" axis="0 0 1" range="0 1"/>{BALL}</body></body>"""


@pytest.mark.parametrize(
    ("name", "bodies", "unit", "path"),
    [
        ("hinge", HINGE, "rad", [[-1.0], [0.4], [-0.2]]),  # there and back
        ("gantry", GANTRY, "m", [[0.0, 0.0], [0.5, 0.1], [0.2, 0.4]]),
    ],
)
def test_arms_of_one_joint_and_of_slides_follow_motions_of_limited_jerk(
    tmp_path, name, bodies, unit, path
):
    file = tmp_path / f"{name}.xml"
    base = '<compiler autolimits="true" angle="radian"/><worldbody><geom size="0.05"/>'
    file.write_text(f'<mujoco model="{name}">{base}{bodies}</worldbody></mujoco>')
    assert unit_of(load_robot(file)) == unit
    arm, limits = load_robot(file), {**SPEEDS, "jerk": 30.0, "torque": 40.0}
    found = time_path(arm, NOTHING, path, **limits)
    assert 0.9 < largest_use(arm, limits_of(arm, **limits), found) < 1.001
    done = execute_trajectory(arm, NOTHING, found, torque=limits["torque"])
    assert done.success, done.reason
    assert done.max_error.max() < 1e-3
    np.testing.assert_allclose(done.trace.positions[[0, -1]], [path[0], path[-1]], atol=1e-4)
    leaps = np.diff(done.trace.wanted.accelerations, axis=0) / DT
    assert 0.99 < np.abs(leaps).max() / limits["jerk"] < 1.0001
    # Where jerk leaps within a step, what is interpolated overshoots.
    between = at_steps(arm, sample_trajectory(arm, found, DT))
    leaps = np.diff(between.accelerations, axis=0) / DT
    assert np.abs(leaps).max() < 1.2 * limits["jerk"]
    np.testing.assert_allclose(between.positions, done.trace.wanted.positions, atol=1e-12)


def test_position_servos_are_late_by_their_damper_over_their_spring(robot):
    straight = time_path(robot, NOTHING, [[-1.5, 0, 0], [1.5, 0, 0]], **SPEEDS)
    found = execute_trajectory(robot, NOTHING, straight, controller="position", torque=TORQUE)
    law = control(robot, "position", found.trace.wanted)
    assert found.max_error[0] == pytest.approx((law.kd / law.kp)[0] * 1.0, rel=0.02)
    assert found.success, found.reason
    assert found.stray < 0.05  # late, and near its curve


@pytest.fixture(scope="module")
def servos(tmp_path_factory):
    """The tiny arm with two servos, one behind a gear; its last joint has a motor."""
    path = tmp_path_factory.mktemp("robots") / "servos.xml"
    path.write_text(
        TINY.replace(
            "</mujoco>",
            """<actuator>
            <position joint="a" kp="300" kv="30" forcerange="-50 50"/>
            <position joint="b" kp="100" kv="5" gear="2" forcerange="-30 30"/>
            <motor joint="c" ctrlrange="-1 1" forcerange="-30 30"/></actuator></mujoco>""",
        )
    )
    return load_robot(path)


def test_gains_are_those_of_the_models_servos(servos, motion):
    points = execute_trajectory(servos, NOTHING, motion).trace.wanted
    law = control(servos, "position", points)
    own = inertias(servos, np.asarray(servos.home, float)[None])[0]
    np.testing.assert_allclose(law.kp, [300, 400, 400 * own[2, 2]])
    np.testing.assert_allclose(law.kd, [30, 20, 40 * own[2, 2]])


@pytest.mark.parametrize(
    ("errors", "change"),
    [
        (ModelErrors(mass=0.2), ('mass="1"', 'mass="1.2"')),
        (
            ModelErrors(payload=0.7),
            ('<geom type="sphere" size="0.07"', '<geom size="0.05" mass="0.7"/>'),
        ),
    ],
)
def test_an_unknown_weight_is_held_where_the_spring_balances_it(
    robot, motion, tmp_path, errors, change
):
    path = tmp_path / "heavier.xml"
    old, new = change
    path.write_text(TINY.replace(old, new if "mass=" in old else new + old))
    heavier = load_robot(path)
    found = execute_trajectory(robot, NOTHING, motion, torque=TORQUE, errors=errors)
    goal, q = found.trace.wanted.positions[-1:], found.trace.positions[-1:]
    still = np.zeros_like(goal)
    needed = inverse_dynamics_by_mujoco(heavier, q, still, still)
    missing = needed - inverse_dynamics_by_mujoco(robot, goal, still, still)
    law = control(robot, "computed_torque", found.trace.wanted)
    expected = np.linalg.solve(law.weight[-1], missing[0]) / law.kp
    np.testing.assert_allclose((goal - q)[0], expected, atol=2e-5)
    assert np.abs(expected).max() > 1e-3


def test_what_is_touched_is_named_with_time_and_depth(robot, motion):
    scene = in_the_way(robot, motion)
    found = execute_trajectory(robot, scene, motion, torque=TORQUE)
    assert not found.success
    assert set(found.touched) == {"box 0", robot.parts[-1].name}
    assert 0.1 < found.touched_at < motion.duration
    assert 0 < found.depth < 0.05
    assert "touches" in found.reason
    assert not found.proven


def test_clouds_are_touched_and_touches_of_the_arm_itself_are_seen(robot, motion):
    center = np.asarray(in_the_way(robot, motion).centers[0])
    points = center + np.random.default_rng(0).uniform(-0.03, 0.03, (40, 3))
    scene = scene_from_shapes([], clouds=[point_cloud(points, radius=0.02)])
    found = execute_trajectory(robot, scene, motion, torque=TORQUE)
    assert "the cloud" in found.touched
    # Folded, the last link meets the first: a path that nobody certified.
    folded = np.linspace([0, 0, 0], [0, 2.4, 1.9], 200)
    times, still = np.arange(200) * 0.01, np.gradient(folded, 0.01, axis=0)
    points = sample_trajectory(robot, motion, 0.01)._replace(
        times=times, positions=folded, velocities=still
    )
    found = execute_trajectory(robot, NOTHING, points, torque=TORQUE)
    assert set(found.touched) <= {part.name for part in robot.parts}
    assert found.touched


@pytest.mark.parametrize("moves", [False, True])
def test_why_an_arm_does_not_rest_is_told_of_place_and_speed(robot, motion, monkeypatch, moves):
    real = execution.simulate

    def simulate_otherwise(*args):
        (run,) = real(*args)
        (run.velocities if moves else run.positions)[-2, 1] += 0.5
        return [run]

    monkeypatch.setattr(execution, "simulate", simulate_otherwise)
    found = execute_trajectory(robot, NOTHING, motion, torque=TORQUE)
    assert not found.settled
    place, speed = (r"\S+e-\S+", "0.5") if moves else ("0.5", r"\S+e-\S+")
    said = rf"joint b is {place} rad away from it and moves at {speed} rad/s \(0.02 allowed\)"
    assert re.fullmatch(f"the arm does not rest at the goal: at the end {said}", found.reason)


def test_a_controller_that_diverges_is_data(robot, motion):
    late = ModelErrors(delay=0.08)
    found = execute_trajectory(robot, NOTHING, motion, torque=TORQUE, errors=late)
    assert not found.success
    assert not found.settled
    assert re.match(r"joint . was \S+ rad from where it should be after", found.reason)
    assert len(found.trace.times) < len(
        execute_trajectory(robot, NOTHING, motion, torque=TORQUE).trace.times
    )
    # What is said of the curve is of all of it, which leads into the box; the arm never was there.
    scene = in_the_way(robot, motion)
    found = execute_trajectory(robot, scene, motion, torque=TORQUE, most_error=1e-9)
    assert len(found.trace.times) < 9
    assert not found.touched
    assert not found.proven
    assert found.duration == pytest.approx(motion.duration, abs=DT)
    weak = execute_trajectory(robot, NOTHING, motion, torque=1.0)
    assert not weak.success
    assert weak.torque_use == 1.0


def test_a_batch_is_as_each_of_its_motions_alone(robot):
    paths = [PATH, [[0.3, 0, 0], [0.3, 0.2, 0]], [[0.0, 0, 0], [-1, 0.3, 0.5]]]
    motions = time_paths(robot, NOTHING, paths, **SPEEDS)
    scenes = [in_the_way(robot, motions[i]) for i in (0, 2, 1)]
    together = execute_trajectories(robot, stack_scenes(scenes), motions, torque=TORQUE)
    for scene, motion, found in zip(scenes, motions, together, strict=True):
        alone = execute_trajectory(robot, scene, motion, torque=TORQUE)
        assert (found.reason, found.touched) == (alone.reason, alone.touched)
        np.testing.assert_allclose(found.trace.positions, alone.trace.positions, atol=1e-9)
    assert {found.success for found in together} == {True, False}


def test_a_motion_of_states_is_the_motion_that_they_are_of(robot, motion):
    points = sample_trajectory(robot, motion, 0.01)
    ours, theirs = (
        execute_trajectory(robot, NOTHING, each, torque=TORQUE) for each in (motion, points)
    )
    np.testing.assert_allclose(
        ours.trace.wanted.positions, theirs.trace.wanted.positions, atol=1e-4
    )
    np.testing.assert_allclose(ours.trace.positions, theirs.trace.positions, atol=5e-4)


def test_strays_and_clearances_bound_what_is_seen(robot):
    scene = scene_from_shapes([sphere([0.2, 0.95, 0.0], 0.05)])
    motion = time_path(robot, scene, PATH, **SPEEDS)
    assert motion.success
    found = execute_trajectory(
        robot, scene, motion, torque=TORQUE, errors=ModelErrors(mass=0.5, friction=1.0)
    )
    model = build_true_world(robot, scene, ModelErrors())
    data, nearest = mujoco.MjData(model), {}
    ball = int(obstacles(model, len(scene.mask)).geoms[0])
    for name, rows in (("wanted", found.trace.wanted.positions), ("was", found.trace.positions)):
        nearest[name] = np.inf
        for q in rows[::20]:
            data.qpos = q
            mujoco.mj_kinematics(model, data)
            for g in robot.part_geoms[1:].tolist():
                apart = mujoco.mj_geomDistance(model, data, g, ball, 1.0, None)
                nearest[name] = min(nearest[name], apart)
    clearance = motion_clearance(robot, scene, found.trace.wanted.positions)
    assert 0 < clearance <= nearest["wanted"] < clearance + 0.03
    assert nearest["was"] >= clearance - found.stray
    assert 0.002 < found.stray < clearance
    assert found.proven
    assert motion_clearance(robot, NOTHING, found.trace.wanted.positions) == 0.25


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({}, "tiny has no torque limits.*give torque="),
        ({"torque": 5.0, "controller": "pid"}, "no controller 'pid'; there are"),
        ({"torque": 5.0, "errors": ModelErrors(delay=1.0)}, r"delay error is 1.0; give 0 to 0.1"),
        ({"torque": 5.0, "errors": ModelErrors(mass=-1.0)}, r"mass error is -1.0; give -0.9 to"),
        ({"torque": 5.0, "errors": ModelErrors(payload=np.nan)}, "payload error is nan"),
        ({"torque": 5.0, "most_error": 0.0}, "most_error is 0.0; give a positive number"),
        ({"torque": [5.0, 5.0]}, "torque limits of tiny are"),
    ],
)
def test_what_cannot_be_simulated_is_refused(robot, motion, options, message):
    with pytest.raises(InputError, match=message):
        execute_trajectory(robot, NOTHING, motion, **options)


def test_no_motion_and_contacts_that_are_meant_are_refused(robot, motion):
    none = motion._replace(success=False, reason="too heavy")
    with pytest.raises(InputError, match="there is no motion to sample: too heavy"):
        execute_trajectory(robot, NOTHING, none, torque=TORQUE)
    with pytest.raises(InputError, match=r"a NoneType is no motion; give plan\.trajectory"):
        inspect.unwrap(followed)(robot, None, DT)
    points = sample_trajectory(robot, motion, 0.01)
    for changed, message in (
        ({"times": points.times[::-1]}, "times in the motion do not begin at 0 and ascend"),
        ({"positions": points.positions[:, :2]}, "the motion has arrays of the shapes"),
        ({"velocities": points.velocities * np.nan}, "the motion holds what is no finite number"),
    ):
        with pytest.raises(InputError, match=message):
            execute_trajectory(robot, NOTHING, points._replace(**changed), torque=TORQUE)
    scene = allow_contacts(robot, in_the_way(robot, motion), [("lower", "box 0")])
    with pytest.raises(InputError, match="MuJoCo world"):
        execute_trajectory(robot, scene, motion, torque=TORQUE)
    with pytest.raises(InputError, match="1 motions in 2 scenes"):
        execute_trajectories(robot, stack_scenes([NOTHING, NOTHING]), [motion], torque=TORQUE)


def test_a_hair_more_than_whole_steps_is_carried_out_and_saved(robot, tmp_path):
    path = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]
    about = time_path(robot, NOTHING, path, velocity=10.0, acceleration=4.0).duration
    for more in (5e-13, 2e-10):
        push = 4.0 * (about / (1 + more)) ** 2
        found = time_path(robot, NOTHING, path, velocity=10.0, acceleration=push)
        assert 0 < found.duration - 1 < 1e-9
        assert len(at_steps(robot, found).times) == 1000 + round(0.5 / DT)
        save_trajectory(robot, found, tmp_path / "motion.json")
        assert load_trajectory(robot, tmp_path / "motion.json").times[-1] == pytest.approx(1.0)


def test_a_batch_whose_motors_are_late_is_as_each_motion_alone(robot):
    paths = [[[0.0, 0.0, 0.0], [way, way / 2, 0.0]] for way in (0.1, 0.6, 1.2)]
    motions = [time_path(robot, NOTHING, path, **SPEEDS) for path in paths]
    errors, how = ModelErrors(delay=0.05), {"torque": 1e4, "most_error": 10.0}
    together = execute_trajectories(robot, NOTHING, motions, errors=errors, **how)
    for found, motion in zip(together, motions, strict=True):
        alone = execute_trajectory(robot, NOTHING, motion, errors=errors, **how)
        assert found.reason == alone.reason
        np.testing.assert_array_equal(found.max_error, alone.max_error)


def test_a_payload_weighs_what_is_said_whatever_the_masses_are(robot):
    masses = [
        build_true_world(robot, NOTHING, ModelErrors(mass=share, payload=2.0)).body_mass
        for share in (0.0, 0.5)
    ]
    np.testing.assert_allclose(masses[1][1:5] / masses[0][1:5], [1.5, 1.5, 1.5, 1])


def test_friction_that_a_file_switches_off_can_be_there_all_the_same(tmp_path):
    path = tmp_path / "smooth.xml"
    text = TINY.replace('axis="0 0 1"', 'axis="0 0 1" frictionloss="3"')
    off = '<option><flag frictionloss="disable"/></option>'
    path.write_text(text.replace("<worldbody>", f"{off}<worldbody>"))
    smooth = load_robot(path)
    assert not smooth.mj_model.dof_frictionloss.any()
    world = build_true_world(smooth, NOTHING, ModelErrors(friction=2.0))
    assert not world.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_FRICTIONLOSS
