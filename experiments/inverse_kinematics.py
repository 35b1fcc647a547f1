"""Claim: at least 99.5 % of the poses that an arm can reach get a configuration that is clear of
the arm itself, in less than 5 ms.

    python -m experiments.inverse_kinematics

Poses are those of the arm's tool, by MuJoCo's own kinematics, at random configurations clear of
self-collision; a configuration is right where MuJoCo sees it within 0.1 mm and 1 mrad of its pose.

Beside it mink (Zakka), whose steps each solve a quadratic program with the joint limits in it, by
daqp: from home, and, where that does not lead to a configuration that is clear, from others that
are drawn at random. Both find out what is clear with the same test. It returns one configuration,
where ours are up to eight, the nearest to home first. CPU time is that of one pose after the other,
compiled, and for ours also of all in one call.
"""

import dataclasses
import functools
import time
from collections.abc import Callable, Iterator

import mujoco
import numpy as np
from matplotlib.figure import Figure

from experiments.measure import ExperimentConfig
from experiments.record import Experiment, Finding, Measurement, judge, main
from experiments.results import Row
from experiments.statistics import proportion
from experiments.style import draw_bars
from experiments.tables import markdown
from experiments.turns import folder_of, kept
from gnnjax.arm.robot import Robot, load_robot
from gnnjax.collision.clearances import is_self_free
from gnnjax.errors import InputError
from gnnjax.measure.statistics import describe
from gnnjax.pose.goal import PoseGoal, tool_frame
from gnnjax.pose.inverse import inverse_kinematics

OWN, TOGETHER, RIVAL = "gnnjax", "gnnjax, all at once", "mink"
_COLORS = {OWN: "darkblue", TOGETHER: "skyblue", RIVAL: "tab:orange"}
_ENOUGH, _SOON = 0.995, 5e-3  # share of poses; s
_STEPS, _STARTS = 30, 64  # of mink: steps from a configuration, and configurations
_DAMPING = 0.01  # of mink, by which it is fastest: of 0 (fails), 0.01, 0.1, 1, and half steps
_CLOSE = (1e-4, 1e-3)  # m, rad

Solve = Callable[[PoseGoal], np.ndarray]  # configurations [K D] for a pose, the best first


@dataclasses.dataclass(frozen=True)
class InverseKinematicsConfig(ExperimentConfig):
    """Solve for poses that can be reached; of the seeds, the first alone."""

    arms: tuple[str, ...] = ("kuka_iiwa14", "franka_panda", "kinova_gen3")
    """The arms."""
    num_poses: int = 1000
    """Poses of each."""


def measurement(config: InverseKinematicsConfig) -> Measurement:
    """Rows of solvers, for each arm."""
    return Measurement(_rows(config), {"settings": {"num_poses": config.num_poses}})


def _rows(config: InverseKinematicsConfig) -> Iterator[Row]:
    for arm in (config.robot,) if config.robot else config.arms:
        robot, seed = load_robot(arm), config.seeds[0]
        told = [config.num_poses, seed]
        folder = folder_of(config.runs, f"inverse_kinematics_{robot.name}", told, robot.path)
        poses = reachable_poses(robot, config.num_poses, seed)
        for solver, measure in MEASURES.items():
            path = folder / f"{solver.replace(' ', '_').replace(',', '')}.json"
            row = summarize(kept(path, functools.partial(measure, robot, poses)))
            print(f"{robot.name}, {solver}: {1e3 * row['cpu_s']['mean']:.2f} ms a pose", flush=True)
            yield {"arm": robot.name, "solver": solver} | row


def reachable_poses(robot: Robot, num: int, seed: int) -> PoseGoal:
    """Poses `[num ...]` of the tool at random configurations, as MuJoCo sees them."""
    rng, found = np.random.default_rng(seed), np.zeros((0, robot.num_dof))
    while len(found) < num:
        drawn = rng.uniform(robot.drawn_lower, robot.drawn_upper, (num, robot.num_dof))
        found = np.concatenate([found, drawn[is_self_free(robot, drawn)]])
    position, quat = _seen(robot, found[:num])
    return PoseGoal(position, quat, tolerance=_CLOSE)


def _seen(robot: Robot, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places `[N 3]` and quaternions `[N 4]` of the tool, by MuJoCo's kinematics."""
    tool, data = tool_frame(robot), mujoco.MjData(robot.mj_model)
    body, turn = tool.chain[-1] + 1, np.zeros(4)
    mujoco.mju_mat2Quat(turn, tool.rotation.ravel())
    position, quat = np.empty((len(q), 3)), np.empty((len(q), 4))
    for row, one in enumerate(q):
        data.qpos[:] = one
        mujoco.mj_kinematics(robot.mj_model, data)
        frame = data.xpos[body], data.xquat[body]
        mujoco.mju_mulPose(position[row], quat[row], *frame, tool.position, turn)
    return position, quat


def one_by_one(robot: Robot, poses: PoseGoal) -> list[Row]:
    """Our own, a pose at a time."""

    def solve(pose: PoseGoal) -> np.ndarray:
        found = inverse_kinematics(robot, pose)
        return found.q[found.valid]

    return _timed(robot, poses, solve)


def all_at_once(robot: Robot, poses: PoseGoal) -> list[Row]:
    """Our own, all poses in one call."""
    inverse_kinematics(robot, poses)  # compiles
    begin = time.process_time()
    found = inverse_kinematics(robot, poses)
    each = (time.process_time() - begin) / len(found.q)
    each_found = [q[valid] for q, valid in zip(found.q, found.valid, strict=True)]
    return _judged(robot, poses, each_found, [each] * len(each_found))


def by_mink(robot: Robot, poses: PoseGoal) -> list[Row]:
    """mink, with restarts."""
    try:
        import mink  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise InputError(f"no mink ({error}); pip install 'gnnjax[experiments]'") from None
    configuration = mink.Configuration(robot.mj_model)
    tool = tool_frame(robot)
    sites = {robot.mj_model.site(s).name for s in range(robot.mj_model.nsite)}
    kind = "site" if tool.name in sites else "body"
    task = mink.FrameTask(tool.name, kind, 1.0, 1.0, lm_damping=_DAMPING)
    limits = [mink.ConfigurationLimit(robot.mj_model)]
    rng = np.random.default_rng(0)

    def solve(pose: PoseGoal) -> np.ndarray:
        rotation = mink.SO3(np.asarray(pose.quat))
        task.set_target(mink.SE3.from_rotation_and_translation(rotation, np.asarray(pose.position)))
        for start in range(_STARTS):
            drawn = rng.uniform(robot.drawn_lower, robot.drawn_upper)
            configuration.update(robot.home.astype(float) if start == 0 else drawn)
            for _ in range(_STEPS):
                error = task.compute_error(configuration)
                off = np.linalg.norm(error[:3]), np.linalg.norm(error[3:])
                if off[0] <= _CLOSE[0] and off[1] <= _CLOSE[1]:
                    if is_self_free(robot, configuration.q[None])[0]:
                        return configuration.q[None].copy()
                    break
                speed = mink.solve_ik(configuration, [task], 1.0, "daqp", 1e-12, limits=limits)
                configuration.integrate_inplace(speed, 1.0)
        return np.zeros((0, robot.num_dof))

    return _timed(robot, poses, solve)


MEASURES = {OWN: one_by_one, TOGETHER: all_at_once, RIVAL: by_mink}


def _timed(robot: Robot, poses: PoseGoal, solve: Solve) -> list[Row]:
    each = [
        poses._replace(position=position, quat=quat)
        for position, quat in zip(np.asarray(poses.position), np.asarray(poses.quat), strict=True)
    ]
    solve(each[0])  # compiles
    found, times = [], []
    for pose in each:
        begin = time.process_time()
        found.append(solve(pose))
        times.append(time.process_time() - begin)
    return _judged(robot, poses, found, times)


def _judged(
    robot: Robot, poses: PoseGoal, found: list[np.ndarray], times: list[float]
) -> list[Row]:
    """Of each pose, whether its best configuration is right, how many there are, and CPU time."""
    rows = [
        {"right": False, "num": len(q), "cpu_s": cpu} for q, cpu in zip(found, times, strict=True)
    ]
    there = [i for i, q in enumerate(found) if len(q)]
    if there:
        best = np.array([found[i][0] for i in there], float)
        position, quat = _seen(robot, best)
        off = np.linalg.norm(position - np.asarray(poses.position)[there], axis=1)
        # The cosine of half the angle between two quaternions is their product.
        along = np.abs(np.sum(quat * np.asarray(poses.quat)[there], axis=1))
        angle = 2 * np.arccos(np.minimum(along, 1))
        inside = (best >= robot.joint_lower - 1e-6) & (best <= robot.joint_upper + 1e-6)
        # A tenth more, for single precision.
        right = (off <= 1.1 * _CLOSE[0]) & (angle <= 1.1 * _CLOSE[1]) & inside.all(axis=1)
        right &= is_self_free(robot, best)
        for i, good in zip(there, right.tolist(), strict=True):
            rows[i]["right"] = good
    return rows


def summarize(rows: list[Row]) -> Row:
    """Sums up a solver's poses."""
    right = sum(row["right"] for row in rows)
    return {
        "num_poses": len(rows),
        "right": right,
        "share": proportion(right, len(rows)),
        "num_configurations": float(np.mean([row["num"] for row in rows])),
        "cpu_s": describe(np.array([row["cpu_s"] for row in rows])),
    }


def draw(results: Row) -> Figure:
    """Draws bars of CPU times: a group an arm, a bar a solver, up to the 95th percentile."""
    arms = list(dict.fromkeys(row["arm"] for row in results["rows"]))
    figure = Figure(figsize=(8, 4), dpi=100, layout="constrained")
    axes = figure.subplots()
    found = {(row["solver"], row["arm"]): row["cpu_s"] for row in results["rows"]}
    values = {
        solver: [
            {"mean": cpu["mean"], "low": cpu["mean"], "high": cpu["p95"]}
            for cpu in (found[solver, arm] for arm in arms)
        ]
        for solver in MEASURES
    }
    looks = {solver: (color, solver) for solver, color in _COLORS.items()}
    draw_bars(axes, values, arms, 1e3, looks)
    axes.set_title("CPU time of a pose, ms: mean, and 95th percentile")
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return figure


def table(results: Row) -> str:
    """A line an arm and solver."""
    machine = results["machine"]
    words = (
        f"{results['settings']['num_poses']} poses an arm; {machine['processor']}, jax "
        f"{machine['jax']}, gnnjax {machine['gnnjax']}. CPU time of one pose; configurations are "
        "those that are clear, up to eight of ours and one of mink's.\n"
    )
    head = ["arm", "solver", "right, %", "configurations", "CPU, ms, mean", "median", "95th"]
    lines = [
        [
            row["arm"],
            row["solver"],
            f"{100 * row['share']['mean']:.1f}",
            f"{row['num_configurations']:.1f}",
            *(f"{1e3 * row['cpu_s'][key]:.2f}" for key in ("mean", "median", "p95")),
        ]
        for row in results["rows"]
    ]
    return f"{words}\n{markdown(head, lines)}"


def verdict(results: Row) -> str:
    """Whether each arm gets enough of its poses, and soon enough."""
    findings = []
    for row in results["rows"]:
        if row["solver"] == OWN:
            share, cpu = row["share"]["mean"], row["cpu_s"]["mean"]
            findings.append(
                Finding(
                    share >= _ENOUGH and cpu < _SOON,
                    f"{row['arm']}: {100 * share:.1f} % in {1e3 * cpu:.1f} ms",
                )
            )
    rival = [row for row in results["rows"] if row["solver"] == RIVAL]
    words = ", ".join(
        f"{row['arm']} {100 * row['share']['mean']:.1f} % in {1e3 * row['cpu_s']['mean']:.1f} ms"
        for row in rival
    )
    return judge(*findings, beside=[f"mink, one configuration each: {words}."])


EXPERIMENT = Experiment(
    name="inverse_kinematics",
    title="Inverse kinematics",
    claim="At least 99.5 % of the poses that an arm can reach get a configuration that is clear of "
    "the arm itself, in less than 5 ms.",
    config=InverseKinematicsConfig,
    quick={"num_poses": 20},
    measure=measurement,
    draw=draw,
    table=table,
    verdict=verdict,
)


if __name__ == "__main__":
    main(EXPERIMENT)
