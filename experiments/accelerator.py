"""What an accelerator does for planning: tests, roadmaps with labels, and searches, a second.

    python -m experiments.accelerator --out accelerator.jsonl
    python -m experiments.accelerator --sizes 1024 --parts kernels   # what a CPU does

Each line of the file is one measurement: what was done, how many at once, and the median rate of
some turns, of which the first, that compiles, is not one. Parts that were cut off are measured
again. On a machine without an accelerator all of it runs on the CPU.

- kernels: configurations a second, by what the arm's spheres prove (first level), by pairs of a
  part and an obstacle (second level), both together, and by MJX.
- labels: roadmaps of 200 nodes a second, drawn with their problems, tested and labelled.
- pool: certified plans a second by the planner, whose searches run on the host's cores.
- abreast: candidates a second by `abreast.py`, which nobody has certified, and of how many
  problems there is one.
"""

import dataclasses
import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from experiments.abreast import AbreastSearch, Candidates
from gnnjax.arguments import parse_arguments
from gnnjax.arm.robot import Robot, load_robot
from gnnjax.collision.checker import make_checker
from gnnjax.collision.fused import obstacles_clear
from gnnjax.devices import cache_compilations
from gnnjax.errors import InputError, run_command
from gnnjax.files import check_target
from gnnjax.guide.field import field_guide
from gnnjax.planning.guided import Guided
from gnnjax.planning.load import own_planner
from gnnjax.planning.options import PlannerOptions
from gnnjax.planning.query import Plan
from gnnjax.problems.labelled import generate_labelled, problem_keys
from gnnjax.problems.problem import Problem, sample_scene
from gnnjax.scene.scene import Scene

Part = Literal["kernels", "mjx", "labels", "pool", "abreast"]
_SCENES = 16
_NODES = 200  # of a labelled roadmap


@dataclasses.dataclass(frozen=True)
class AcceleratorConfig:
    """Rates of kernels, labelled roadmaps and searches on the device at hand."""

    out: Path = Path("accelerator.jsonl")
    """A line of JSON for each measurement, added as it comes."""
    robot: str = "kuka_iiwa14"
    """Shipped robot, or path of an MJCF."""
    parts: tuple[Part, ...] = ("kernels", "mjx", "labels", "abreast", "pool")
    """What is measured."""
    sizes: tuple[int, ...] = (4096, 65_536, 1_048_576)
    """Configurations that are tested at once."""
    problems: tuple[int, ...] = (1024, 4096)
    """Problems that are searched at once."""
    roadmaps: tuple[int, ...] = (100, 500)
    """Problems that are labelled at once."""
    turns: int = 3
    """Of each measurement."""
    boxes: int = 9
    """Of each scene."""
    seed: int = 0
    """Of problems and configurations."""


def accelerator(config: AcceleratorConfig) -> None:
    """Measures, and adds a line to the file for each measurement."""
    least = min(*config.sizes, *config.problems, *config.roadmaps, config.turns, config.boxes)
    if least < 1:
        raise InputError(f"sizes, problems, roadmaps, turns and boxes: {least} is below 1")
    check_target(config.out)
    cache_compilations()
    robot = load_robot(config.robot)
    functions: dict[Part, Callable[[AcceleratorConfig, Robot], Iterator[Work]]] = {
        "kernels": _kernels,
        "mjx": _mjx,
        "labels": _labels,
        "pool": _pool,
        "abreast": _abreast,
    }
    with config.out.open("a") as file:
        for part in config.parts:
            for work in functions[part](config, robot):
                row = _timed(work, config.turns)
                line = json.dumps(
                    {"robot": robot.name, "device": jax.devices()[0].device_kind} | row
                )
                print(line, flush=True)
                file.write(line + "\n")
                file.flush()


class Work(NamedTuple):
    """Something to be timed."""

    what: str
    at_once: int
    function: Callable[..., Any]
    args: tuple[Any, ...]
    found: Callable[[Any], dict[str, float]] = lambda _: {}  # what to tell of its result


def _timed(work: Work, turns: int) -> dict[str, Any]:
    seconds = []
    for _ in range(turns + 1):
        begin = time.perf_counter()
        result = jax.block_until_ready(work.function(*work.args))
        seconds.append(time.perf_counter() - begin)
    first, *others = seconds
    rate = work.at_once / float(np.median(others))
    row = {"what": work.what, "at_once": work.at_once, "per_s": float(f"{rate:.4g}")}
    return row | {"first_s": round(first, 2)} | work.found(result)


def _configurations(config: AcceleratorConfig, robot: Robot, num: int) -> jax.Array:
    rng = np.random.default_rng(config.seed)
    drawn = rng.uniform(robot.joint_lower, robot.joint_upper, (num, robot.num_dof))
    # Rounding must not leave the limits.
    return jnp.asarray(np.clip(drawn.astype(np.float32), robot.joint_lower, robot.joint_upper))


def _scenes(config: AcceleratorConfig, robot: Robot) -> Scene:
    """Scenes of boxes that are taken for rotated."""
    home = jnp.asarray(robot.home)

    def clear(scene: Scene) -> jax.Array:
        return obstacles_clear(robot, scene, home)

    num = config.boxes
    keys = jax.random.split(jax.random.key(config.seed), _SCENES)
    drawn = [sample_scene(k, clear, max_obstacles=num, min_num=num, max_num=num) for k in keys]
    return jax.tree.map(lambda *x: jnp.stack(x), *drawn)


def _kernels(config: AcceleratorConfig, robot: Robot) -> Iterator[Work]:
    checker, scenes = make_checker(robot), _scenes(config, robot)
    placed = jax.jit(checker.place)(scenes)
    for num in config.sizes:
        q, owner = _configurations(config, robot, num), jnp.arange(num) % _SCENES
        if checker.levels is not None:
            first = jax.jit(checker.levels.first)
            yield Work("first level", num, first, (placed, owner, q[:, None]))
            second, number = jax.jit(checker.levels.second.clear_of_obstacles), owner % config.boxes
            wanted = jnp.ones(num, bool)
            yield Work("second level", num, second, (placed, owner, number, q, wanted))
        each = jax.jit(checker.check_each)
        yield Work("both levels", num, each, (placed, owner, q[:, None]), _share("free"))


def _mjx(config: AcceleratorConfig, robot: Robot) -> Iterator[Work]:
    scene = jax.tree.map(lambda x: x[0], _scenes(config, robot))
    check = jax.jit(make_checker(robot, "mjx").check_configurations)
    for num in config.sizes:
        q = _configurations(config, robot, num)
        yield Work("MJX", num, check, (scene, q), _share("free"))


def _share(name: str) -> Callable[[Any], dict[str, float]]:
    return lambda held: {name: round(float(np.mean(held)), 4)}


def _labels(config: AcceleratorConfig, robot: Robot) -> Iterator[Work]:
    draw = generate_labelled(robot, _NODES)
    for num in config.roadmaps:
        keys = problem_keys(config.seed, "train", 0, num)
        yield Work("labels", num, draw, (keys,))


def _problems(config: AcceleratorConfig, robot: Robot, num: int) -> Problem:
    drawn = generate_labelled(robot, 0)(problem_keys(config.seed, "test", 0, num))
    assert isinstance(drawn, Problem)
    return drawn


def _pool(config: AcceleratorConfig, robot: Robot) -> Iterator[Work]:
    planner = own_planner(robot, PlannerOptions())
    for num in config.problems:
        problems = _problems(config, robot, num)
        yield Work("pool", num, planner.plan_batch, (problems,), _solved)


def _solved(plans: list[Plan]) -> dict[str, float]:
    return {"success": round(float(np.mean([plan.success for plan in plans])), 4)}


def _abreast(config: AcceleratorConfig, robot: Robot) -> Iterator[Work]:
    options = PlannerOptions()
    checker = make_checker(robot, axis_aligned=True, resolution=options.resolution)
    strategy = Guided(robot, field_guide(robot), options)
    search = AbreastSearch(robot, strategy, checker, options.resolution)

    def found(candidates: Candidates) -> dict[str, float]:
        return {"success": round(float(np.mean(candidates.num[-1] > 0)), 4)}

    for num in config.problems:
        problems = _problems(config, robot, num)
        yield Work("abreast", num, search, (problems, 0), found)


if __name__ == "__main__":
    run_command(lambda: accelerator(parse_arguments(AcceleratorConfig)))
