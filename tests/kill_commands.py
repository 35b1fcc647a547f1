"""The commands that `kill_points` kills: their real file code around a few cheap numbers."""

import contextlib
import json
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import jax
import numpy as np
from conftest import TINY
from flax import nnx

import gnnjax.evaluate
import gnnjax.generate
import gnnjax.measure.batches
import gnnjax.train
import gnnjax.train_motion
import gnnjax.training.weights
from gnnjax.arm.robot import load_robot
from gnnjax.errors import run_command
from gnnjax.evaluate import EvaluateConfig
from gnnjax.generate import GenerateConfig
from gnnjax.planning.query import Plan
from gnnjax.problems.file import save_problems
from gnnjax.problems.labelled import LabelledRoadmap
from gnnjax.problems.problem import Problem, ProblemSet
from gnnjax.roadmap.graph import Roadmap
from gnnjax.scene.scene import make_scene
from gnnjax.train import TrainConfig
from gnnjax.train_motion import TrainMotionConfig
from gnnjax.training.weights import load_network, read_metadata


class Command(NamedTuple):
    """A command that works inside of a folder."""

    prepare: Callable[[], object]  # makes what is there before the command
    run: Callable[[Path], None]
    look: Callable[[Path], dict[str, Any]]  # what has to be equal in the end


_ROBOT, _PROBLEMS = Path("tiny.xml"), Path("problems.npz")


def _arm() -> None:
    _ROBOT.write_text(TINY)


def _arm_and_problems() -> None:
    _arm()
    save_problems(_PROBLEMS, ProblemSet("tiny", numbered_problems(np.arange(4))))


def numbered_problems(numbers: np.ndarray) -> Problem:
    """Problems that are told apart by their numbers."""
    q = np.repeat(np.asarray(numbers, np.float32)[:, None] / 100, 3, axis=1)
    scene = make_scene([[1.0, 0.0, 0.5]], [[0.1, 0.2, 0.3]])
    scenes = jax.tree.map(lambda x: np.repeat(x[None], len(q), axis=0), scene)
    return Problem(q, -q, scenes)


def plain_keys(seed: int, split: str, first: int, num: int, family: str) -> np.ndarray:
    return np.arange(first, first + num)


@contextlib.contextmanager
def _without_jax():
    """Random keys that are plain numbers, and whatever else would start JAX for nothing."""
    with contextlib.ExitStack() as stack:
        for name, cheap in {
            "key": lambda seed: seed,
            "fold_in": lambda key, number: 1000 * key + number,
            "split": lambda key, num=2: np.arange(num) + 10 * key,
            "permutation": lambda key, num: np.random.default_rng(key).permutation(num),
        }.items():
            stack.enter_context(mock.patch.object(jax.random, name, cheap))
        stack.enter_context(mock.patch.object(nnx, "Rngs"))
        yield


def _finish(act: Callable[[], object]) -> None:
    """Runs as a command does, and comes back where it ends well."""
    try:
        run_command(lambda: act() and None)
    except SystemExit as error:
        if error.code:
            raise RuntimeError(f"status {error.code}") from None


def _generate(out: Path) -> None:
    config = GenerateConfig(robot=str(_ROBOT), num_problems=5, num_nodes=0, shard_size=2, out=out)
    with (
        mock.patch.object(gnnjax.generate, "generate_labelled", return_value=numbered_problems),
        mock.patch.object(gnnjax.generate, "problem_keys", plain_keys),
    ):
        _finish(lambda: gnnjax.generate.generate(config))


def _files(folder: Path) -> dict[str, Any]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


class _Planner:
    """Plans a straight line, at once."""

    radius = 1.0

    def __init__(self):
        self.robot = load_robot(_ROBOT)

    def warm_up(self, scene: Any, batch_size: int) -> None:
        pass

    def plan_batch(self, problems: Problem, seed: int) -> list[Plan]:
        plans = []
        for start, goal in zip(problems.start, problems.goal, strict=True):
            values = dict.fromkeys(Plan._fields, 1) | {
                "success": True,
                "reason": "",
                "path": np.stack([start, goal]),
                "cost": float(np.linalg.norm(goal - start)),
                "certified": True,
                "valid": True,
            }
            plans.append(Plan(**values))
        return plans


def _evaluate(folder: Path) -> None:
    config = EvaluateConfig(
        problems=_PROBLEMS, json=folder / "results.json", robot=str(_ROBOT), planner="lazysp"
    )
    hard = np.ones(4, bool)
    with (
        mock.patch.object(gnnjax.evaluate, "_WRITE_EVERY_S", -1.0),
        mock.patch.object(gnnjax.evaluate, "describe_machine", dict),
        mock.patch.object(gnnjax.measure.batches, "straight_line_blocked", return_value=hard),
    ):
        _finish(lambda: gnnjax.evaluate.evaluate(config, _Planner()))


def _results(folder: Path) -> dict[str, Any]:
    found = json.loads((folder / "results.json").read_text())
    return {"names": sorted(_files(folder)), **found}


class _Network(nnx.Module):
    """One weight vector."""

    def __init__(self, *args: Any, rngs: nnx.Rngs, **kwargs: Any):
        self.kernel = nnx.Param(np.zeros(3, np.float32))

    config: dict = {}  # noqa: RUF012


gnnjax.training.weights._KINDS[_Network.__name__] = (__name__, "nobody")

_OPTIMIZER = types.SimpleNamespace(init=lambda weights: {"count": np.int32(0)})


def _step(state: Any, *args: Any) -> tuple[Any, dict[str, Any]]:
    """Learns by adding one, so that a step too many or too few is seen."""
    weights = jax.tree.map(lambda x: np.asarray(x) + np.float32(1), state.weights)
    count = jax.tree.map(lambda x: np.asarray(x) + np.int32(1), state.optimizer)
    return type(state)(weights, count), {"loss": np.float32(count["count"])}


def _labelled(num: int) -> LabelledRoadmap:
    nothing = dict.fromkeys(Roadmap._fields)
    return LabelledRoadmap(
        Problem(np.zeros((num, 3)), None, None),
        Roadmap(**{**nothing, "node_mask": np.ones((num, 4), bool)}),
        None,
    )


def _train(folder: Path) -> None:
    config = TrainConfig(
        data=Path("."),
        robot=str(_ROBOT),
        out=folder,
        resume=True,
        epochs=3,
        batch_size=4,
        validate_every=2,
        validation_problems=0,
    )
    problems = ProblemSet("tiny", numbered_problems(np.arange(4)))
    with contextlib.ExitStack() as stack:
        stack.enter_context(_without_jax())
        for name, cheap in {
            "GuidanceNetwork": _Network,
            "SampledPlanner": lambda *args, **kwargs: None,
            "gnn": lambda *args: None,
            "load_problems": lambda *args: problems,
            "from_problem_set": lambda problems: _labelled(4),
            "make_optimizer": lambda *args: _OPTIMIZER,
            "make_step": lambda *args: _step,
        }.items():
            stack.enter_context(mock.patch.object(gnnjax.train, name, cheap))
        _finish(lambda: gnnjax.train.train(config))


def _train_motion(folder: Path) -> None:
    config = TrainMotionConfig(
        robots=(str(_ROBOT),), out=folder, resume=True, steps=4, save_every=1
    )
    scores = np.array([0.0, 1.0]), np.array([False, True])
    with contextlib.ExitStack() as stack:
        stack.enter_context(_without_jax())
        for name, cheap in {
            "MotionNetwork": _Network,
            "make_scene_batches": lambda *args: None,
            "warmed_adamw": lambda *args: _OPTIMIZER,
            "make_batches": lambda *args: lambda key: key,
            "make_step": lambda *args: _step,
            "make_validation": lambda *args: lambda weights, key: scores,
        }.items():
            stack.enter_context(mock.patch.object(gnnjax.train_motion, name, cheap))
        _finish(lambda: gnnjax.train_motion.train_motion(config))


def _timeless(record: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in record.items() if name != "seconds"}


def _run_folder(folder: Path) -> dict[str, Any]:
    """What a training leaves: names (but Orbax's own), log, metadata and weights."""
    names = {
        str(p.relative_to(folder)) for depth in ("*", "checkpoints/*") for p in folder.glob(depth)
    }
    log = [_timeless(json.loads(x)) for x in (folder / "log.jsonl").read_text().splitlines()]
    found: dict[str, Any] = {"names": sorted(names), "log": log}
    found["beside"] = sorted(p.name for p in folder.parent.iterdir())
    for name in ("weights.safetensors", *sorted(n for n in names if n.startswith("checkpoints/"))):
        meta = read_metadata(folder / name)
        meta["training"]["log"] = [_timeless(x) for x in meta["training"].get("log", [])]
        meta["log"] = [_timeless(x) for x in meta.get("log", [])]
        found[name] = meta
    found["kernel"] = np.asarray(load_network(folder / "weights.safetensors").kernel[...]).tolist()
    events = [p.read_bytes() for p in (folder / "tensorboard").iterdir()]
    found["events"] = len(events), sum(data.count(b"loss") for data in events)
    return found


COMMANDS = {
    "generate": Command(_arm, lambda folder: _generate(folder / "set"), _files),
    "generate_file": Command(_arm, lambda folder: _generate(folder / "set.npz"), _files),
    "evaluate": Command(_arm_and_problems, _evaluate, _results),
    "train": Command(_arm, _train, _run_folder),
    "train_motion": Command(_arm, _train_motion, _run_folder),
}
