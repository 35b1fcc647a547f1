"""Configurations checked per second: the fused kernel, MJX and MuJoCo's C engine, side by side.

    python -m experiments.benchmark_collision --json collision.json

All of them check the same configurations against the same boxes, and their verdicts are compared.
Of arms that are no spheres, the clearance and MJX are those of the spheres around them, and refuse
more than the engine does; the fused kernel's verdict is that of hulls that stand out by 2 mm.
They take turns, so that whatever else the machine does slows all of them. A second process then
measures again on one core only, which is what the C engine uses in the first as well.

The engine runs in a Python loop, of which the cost is measured on an empty model and subtracted:
the rates "net" are those of the C code alone. Of the engine's stages only the two that contacts
need are run. It finds all contacts of a configuration, the fused kernel the smallest distance.

Operations are counted in the compiled program: sums, products, comparisons, selections, roots,
sines and so on count as one each. The yardstick is a matrix product, whose multiply-adds, two
operations in an instruction, keep the vector units busy; a kernel of comparisons and selections
can reach half of it.
"""

import dataclasses
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from experiments.engine import Engine, empty_engine
from experiments.operations import operations
from gnnjax.arguments import parse_arguments
from gnnjax.arm.robot import Robot, load_robot
from gnnjax.collision.checker import make_checker
from gnnjax.collision.fused import obstacles_clear
from gnnjax.errors import InputError, run_command
from gnnjax.files import atomic_write
from gnnjax.problems.problem import sample_scene
from gnnjax.scene.scene import Scene

MARGIN = 1e-3  # m; distances up to this are known where verdicts are compared
UNSURE = 1e-4  # m; closer contacts may be judged either way in float32
YARDSTICK = 1024  # rows of the square matrices of the yardstick


@dataclasses.dataclass(frozen=True)
class BenchmarkConfig:
    """Collision checks per second of all backends."""

    robot: str = "kuka_iiwa14"
    """Shipped robot, or path of an MJCF."""

    batch: int = 65_536
    """Configurations the fused kernel checks at a time."""

    boxes: int = 9
    """Boxes of the scene."""

    repeats: int = 5
    """Turns of every backend."""

    mjx_batch: int = 1024
    """Configurations MJX checks at a time; 0 leaves MJX out."""

    engine_batch: int = 4096
    """Configurations the C engine checks in a turn."""

    seed: int = 0
    """Seed of boxes and configurations."""

    one_core: bool = False
    """Measure on one core only; the default is both, one after the other."""

    json: Path | None = None
    """Where the results go."""


def take_turns(
    runs: dict[str, tuple[int, Callable[[], object]]], repeats: int
) -> tuple[dict[str, np.ndarray], dict[str, float]]:
    """Items per second [repeats], and cores kept busy, of functions given with their items."""
    for _, run in runs.values():  # compiled, and in the caches
        jax.block_until_ready(run())
    rates = {name: np.empty(repeats) for name in runs}
    busy = dict.fromkeys(runs, 0.0)
    for turn in range(repeats):
        for name, (number, run) in runs.items():
            start, cpu = time.perf_counter(), time.process_time()
            jax.block_until_ready(run())
            wall = time.perf_counter() - start
            rates[name][turn] = number / wall
            busy[name] += (time.process_time() - cpu) / wall / repeats
    return rates, busy


def measure(config: BenchmarkConfig) -> dict:
    """Measures all backends in this process and compares their verdicts."""
    robot = load_robot(config.robot)
    scene_key, turn_key = jax.random.split(jax.random.key(config.seed))
    home = jnp.zeros(robot.num_dof)
    aligned = sample_scene(
        scene_key,
        lambda scene: obstacles_clear(robot, scene, home),
        max_obstacles=config.boxes,
        min_num=config.boxes,
        max_num=config.boxes,
    )
    quats = jax.random.normal(turn_key, (config.boxes, 4))
    rotated = aligned._replace(quats=quats / jnp.linalg.norm(quats, axis=-1, keepdims=True))
    scenes = {"aligned": aligned, "rotated": rotated}
    rng = np.random.default_rng(config.seed)
    drawn = rng.uniform(robot.joint_lower, robot.joint_upper, (config.batch, robot.num_dof))
    # Rounding to float32 must not leave the limits.
    q = np.clip(drawn.astype(np.float32), robot.joint_lower, robot.joint_upper)
    some, few = q[: config.engine_batch].astype(float), q[: config.mjx_batch]

    runs, compiled = {}, {}

    def add_compiled(name: str, function: Callable, scene: Scene, rows: np.ndarray) -> None:
        nodes = jnp.asarray(rows)
        program = compiled[name] = jax.jit(function).lower(scene, nodes).compile()
        runs[name] = len(rows), lambda: program(scene, nodes)

    for kind, scene in scenes.items():
        checker = make_checker(robot, axis_aligned=kind == "aligned")
        add_compiled(f"fused {kind}", checker.check_configurations, scene, q)
        if not config.one_core:
            add_compiled(f"fused {kind} clearance", checker.clearance, scene, q)
        if kind == "rotated" and len(few):  # no faster on aligned boxes
            mjx = make_checker(robot, "mjx")
            add_compiled(f"mjx {kind}", mjx.check_configurations, scene, few)
        engine = Engine(robot, scene)
        runs[f"engine {kind}"] = len(some), lambda engine=engine: engine.valid(some)
    empty = empty_engine(robot.num_dof)
    runs["empty engine"] = len(some), lambda: empty.valid(some[:, : empty.model.nq])
    matrix = jax.random.normal(scene_key, (YARDSTICK, YARDSTICK))
    product = jax.jit(jnp.matmul)
    runs["matrix product"] = 2 * YARDSTICK**3, lambda: product(matrix, matrix)

    rates, busy = take_turns(runs, config.repeats)
    # Turn by turn, so that a slow turn is set off against a slow turn.
    for kind in scenes:
        rates[f"engine {kind} net"] = 1 / (1 / rates[f"engine {kind}"] - 1 / rates["empty engine"])

    peak = float(np.median(rates["matrix product"]))
    result: dict = {"matrix_product_gflops": peak / 1e9, "rates": {}}
    for name, values in rates.items():
        if name == "matrix product":
            continue
        row = {
            "batch": runs[name.removesuffix(" net")][0],
            "cores": busy[name.removesuffix(" net")],
            "median": float(np.median(values)),
            "min": float(values.min()),
            "max": float(values.max()),
        }
        if name.startswith("fused"):
            counts = operations(compiled[name].as_text(), config.batch, config.boxes)
            row["operations"] = dict(counts.most_common())
            row["gflops"] = counts.total() * row["median"] / 1e9
            row["share_of_matrix_product"] = row["gflops"] * 1e9 / peak
        result["rates"][name] = row
    for kind in scenes:
        ratio = np.median(rates[f"fused {kind}"] / rates[f"engine {kind} net"])
        result[f"fused_over_engine_{kind}"] = float(ratio)
    result["agreement"] = {
        kind: compare(robot, scene, some, {n: r for n, (_, r) in runs.items() if kind in n})
        for kind, scene in scenes.items()
    }
    return result


def compare(robot: Robot, scene: Scene, q: np.ndarray, runs: dict[str, Callable]) -> dict:
    """How many verdicts are those of the engine, where its distance is not about zero, and how many
    are free where it finds a collision."""
    gaps = Engine(robot, scene, MARGIN).gaps(q)
    sure = np.abs(gaps) > UNSURE
    verdicts = {}
    for name, run in runs.items():
        values = np.asarray(run())[: len(q)]
        valid = values > 0 if name.endswith("clearance") else values
        counted = sure[: len(valid)]
        free = gaps[: len(valid)] > 0
        verdicts[name] = {
            "agree": int(((valid == free) & counted).sum()),
            "wrongly_free": int((valid & ~free & counted).sum()),
            "of": int(counted.sum()),
        }
    return {"valid": float((gaps > 0).mean()), "verdicts": verdicts}


def show(title: str, result: dict) -> None:
    """Prints what `measure` returned."""
    print(f"\n{title}: matrix product {result['matrix_product_gflops']:.0f} GFLOP/s")
    print(
        f"{'':26}{'batch':>8}{'cores':>7}{'configurations/s':>18}{'min .. max':>26}"
        f"{'op':>8}{'GFLOP/s':>9}{'share':>7}"
    )
    for name, row in result["rates"].items():
        spread = f"{row['min']:,.0f} .. {row['max']:,.0f}"
        line = f"{name:26}{row['batch']:8}{row['cores']:7.1f}{row['median']:18,.0f}{spread:>26}"
        if "gflops" in row:
            line += f"{sum(row['operations'].values()):8}{row['gflops']:9.1f}"
            line += f"{100 * row['share_of_matrix_product']:6.0f}%"
        print(line)
    for kind, found in result["agreement"].items():
        ratio = result[f"fused_over_engine_{kind}"]
        print(f"{kind}: fused {ratio:.1f} times engine net; {100 * found['valid']:.0f} % valid")
        for name, verdicts in found["verdicts"].items():
            print(
                f"  {name}: {verdicts['agree']} of {verdicts['of']} verdicts are the engine's, "
                f"{verdicts['wrongly_free']} are free where it finds a collision"
            )


def main(config: BenchmarkConfig) -> dict:
    """Measures, prints the tables and writes them; returns them too."""
    if min(config.batch, config.boxes, config.repeats, config.engine_batch) < 1:
        raise InputError("batch, boxes, repeats and engine_batch must be at least 1")
    if config.engine_batch > config.batch or config.mjx_batch > config.batch:
        raise InputError(
            f"engine_batch {config.engine_batch} and mjx_batch {config.mjx_batch} must not exceed "
            f"batch {config.batch}"
        )
    if config.one_core:
        if hasattr(os, "sched_setaffinity"):  # JAX starts as many threads as it may use cores
            os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
        results = {"one_core": measure(config)}
    else:
        results = {"all_cores": measure(config), **_in_one_core(config)}
    for title, result in results.items():
        show(title.replace("_", " "), result)
    if config.json is not None:
        text = json.dumps(results, indent=1) + "\n"
        atomic_write(config.json, lambda file: file.write_text(text) and None)
    return results


def _in_one_core(config: BenchmarkConfig) -> dict:
    """Measures in a process of its own: how many cores JAX uses is settled when it starts."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "one_core.json"
        command = [sys.executable, "-m", "experiments.benchmark_collision"]
        command += ["--one-core", "--json", str(path)]
        for name, value in dataclasses.asdict(config).items():
            if name not in ("one_core", "json"):
                command += [f"--{name.replace('_', '-')}", str(value)]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        return json.loads(path.read_text())


if __name__ == "__main__":
    run_command(lambda: main(parse_arguments(BenchmarkConfig)) and None)
