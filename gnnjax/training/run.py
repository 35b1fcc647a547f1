"""The loop of all trainings, and a run's folder: checkpoints, log, events and, at last, weights.

What is trained, and on what, are arguments: a `Training`.
"""

import contextlib
import dataclasses
import json
import struct
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import nnx
from jax.sharding import Mesh
from rich.console import Console
from tensorboardX.proto.event_pb2 import Event
from tensorboardX.proto.summary_pb2 import Summary
from tensorboardX.record_writer import masked_crc32c

from gnnjax.errors import InputError, check_seed, needs_extra
from gnnjax.files import as_json, atomic_write, check_target, locked
from gnnjax.progress_bar import progress_bar
from gnnjax.training.checkpoint import TrainingCheckpoints
from gnnjax.training.parallel import everywhere, here
from gnnjax.training.weights import save_network

# What both trainings advise after an interruption.
AGAIN = "start the same command again with --resume"


class TrainState(NamedTuple):
    """All that changes while training; a checkpoint holds it."""

    weights: Any
    optimizer: optax.OptState


class Training(NamedTuple):
    """What is trained, and how; a run is so many units of so many steps."""

    network: nnx.Module  # what the weights are of
    state: TrainState
    unit: str  # what records count: "epoch" or "step"
    num_units: int
    steps: int  # of a unit
    record_every: int  # units between records
    validate_every: int  # units between validations and checkpoints
    # `(state, unit, number) -> (state, losses)`: a step of a unit, the same whenever it runs.
    step: Callable[[TrainState, int, int], tuple[TrainState, dict[str, jax.Array]]]
    # `state -> (entries of the record, the same in words)`.
    validate: Callable[[TrainState], tuple[dict[str, float], str]]
    mesh: Mesh | None = None  # of the devices that take a step together


def run_training(training: Training, config: Any) -> Path:
    """Trains, or goes on with what an interrupted run has left; returns the file of the weights.

    Args:
        training: what to do.
        config: of the command; its `out` and `resume` say where and whether to go on, its `figure`
            where a picture of the curves goes.
    """
    unit, steps, mesh = training.unit, training.steps, training.mesh
    run = TrainingRun(
        *(config.out, training.network, settings_of(config), unit, steps), figure=config.figure
    )
    console = Console(quiet=not _is_first())
    with run, progress_bar(console) as progress:
        first, state = run.begin(training.state, config.resume)
        state = everywhere(state, mesh)
        total = training.num_units * steps
        bar = progress.add_task("compiling", total=total, completed=first * steps)
        progress.console.print("compiling; the first step takes up to a minute")
        sums, since, begin = {}, first, time.perf_counter()
        for number in range(first, training.num_units):
            for i in range(steps):
                state, losses = training.step(state, number, i)
                losses = here(losses, mesh)
                sums = jax.tree.map(jnp.add, sums, losses) if sums else losses
                progress.update(bar, advance=1, description=f"{unit} {number + 1}")
            done = number + 1
            last = done == training.num_units
            if done % training.record_every and not last:
                continue
            record: dict[str, Any] = {unit: done}
            record |= {name: float(x) / (steps * (done - since)) for name, x in sums.items()}
            record["seconds"] = time.perf_counter() - begin
            if last or done % training.validate_every == 0:
                found, words = training.validate(here(state, mesh))
                record |= found
                progress.console.print(f"{unit} {done}: loss {record['loss']:.4f}{words}")
                run.add(record, state)
            else:
                run.add(record)
            sums, since, begin = {}, done, time.perf_counter()
        return run.finish(here(state.weights, mesh))


def check_bounds(config: Any, least: dict[str, int]) -> None:
    """Refuses numbers that nothing can be trained with, before anything is computed.

    Args:
        config: of the command.
        least: by option, the least that makes sense.
    """
    for name, bound in least.items():
        value = getattr(config, name)
        if not bound <= value < float("inf"):  # NaN fails this, too
            raise InputError(f"{name} is {value}; it must be at least {bound}, and finite")
    check_seed(config.seed)
    check_target(config.out / "log.jsonl")
    if config.figure is not None:
        with needs_extra("--figure", "viz"):
            from gnnjax.plot import check_picture
        check_picture(config.figure)


def settings_of(config: Any) -> dict[str, Any]:
    """A configuration as JSON, without what may differ when a run goes on."""
    settings = as_json(dataclasses.asdict(config))
    for name in ("resume", "out", "cluster", "figure"):
        del settings[name]
    return settings


def _is_first() -> bool:
    """Whether this is the process, of several, that writes."""
    return jax.process_index() == 0


class TrainingRun(contextlib.ExitStack):
    """Keeps what a training comes to, and goes on with what an interrupted one has left.

    The log is part of the checkpoint: a run that goes on has the records up to its checkpoint,
    wherever the one before was killed. Of several processes, the first one writes; all of them save
    a checkpoint together.

    Args:
        out: folder of the run; nobody else may write there meanwhile.
        network: what is trained.
        settings: of the run, as JSON; a run goes on only with the same ones.
        unit: what records count: "step" or "epoch".
        steps: of a unit.
        figure: where a picture of the records goes with each checkpoint.
    """

    def __init__(
        self,
        out: Path,
        network: nnx.Module,
        settings: dict[str, Any],
        unit: str,
        steps: int = 1,
        figure: Path | None = None,
    ):
        super().__init__()
        self._figure = figure
        self.out, self.records = out, []
        self._network, self._settings, self._unit, self._steps = network, settings, unit, steps
        self._events = _next_events(out / "tensorboard")

    def __enter__(self) -> "TrainingRun":
        super().__enter__()
        with contextlib.ExitStack() as stack:
            if _is_first():
                stack.enter_context(locked(self.out / "log.jsonl"))
            folder = self.out / "checkpoints"
            self._checkpoints = TrainingCheckpoints(folder, self._network, self._settings)
            self.push(stack.pop_all())
        return self

    def begin(self, state: Any, resume: bool) -> tuple[int, Any]:
        """How far the run has come, and its state there.

        Raises:
            InputError: there is a run and none should be resumed, or it has other settings.
        """
        done = 0
        if self._checkpoints.latest() is not None:
            if not resume:
                raise InputError(
                    f"{str(self.out)!r} holds a run already; add --resume to go on with it, or "
                    "choose another --out"
                )
            done, state, log = self._checkpoints.restore(state)
            # A checkpoint of before the log was part of it has it beside itself.
            own = self.out / "log.jsonl"
            self.records = _read_log(own, self._unit, done) if log is None else log
            self._write_log()
        if _is_first():
            for old in self._events.parent.glob("events.out.tfevents.*"):
                old.unlink()
        for record in self.records:
            self._append_event(record)
        return done, state

    def add(self, record: dict[str, Any], state: Any = None) -> None:
        """Keeps a record and, if there is one, the state it belongs to."""
        self.records.append(record)
        if state is not None:
            self._checkpoints.save(record[self._unit], state, self.records)
            self._draw()
        self._write_log()
        self._append_event(record)

    def finish(self, weights: Any) -> Path:
        """Writes the weights and returns their file."""
        nnx.update(self._network, weights)
        training = {**self._settings, "log": self.records[-1:]}
        path = self.out / "weights.safetensors"
        if _is_first():
            save_network(path, self._network, training)
            self._draw()
            print(f"weights in {path}")
        return path

    def _append_event(self, record: dict[str, Any]) -> None:
        if _is_first():
            _append_event(self._events, record, record[self._unit] * self._steps)

    def _draw(self) -> None:
        if self._figure is not None and _is_first():
            from gnnjax.training.figure import draw_training

            draw_training(self.records, self._unit, self.out.name, self._figure)

    def _write_log(self) -> None:
        if not _is_first():
            return
        text = "".join(json.dumps(record) + "\n" for record in self.records)
        atomic_write(self.out / "log.jsonl", lambda file: file.write_text(text, encoding="utf-8"))


def _read_log(path: Path, unit: str, done: int) -> list[dict[str, Any]]:
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    return [record for record in map(json.loads, lines) if record[unit] <= done]


def _next_events(folder: Path) -> Path:
    """A file that TensorBoard, which looks for later names only, finds after those that are there,
    also where the clock that named them was ahead."""
    stamps = [path.name.split(".")[3] for path in folder.glob("events.out.tfevents.*")]
    last = max((int(stamp) for stamp in stamps if stamp.isdecimal()), default=0)
    return folder / f"events.out.tfevents.{max(int(time.time()), last + 1)}.gnnjax"


def _append_event(path: Path, record: dict[str, Any], step: int) -> None:
    """Adds a record to a file that TensorBoard reads.

    Not by tensorboardX's `SummaryWriter`: its thread dies on a full disk, and then the run waits
    for it without end.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    events = [] if path.exists() else [Event(wall_time=time.time(), file_version="brain.Event:2")]
    values = [Summary.Value(tag=name, simple_value=value) for name, value in record.items()]
    events.append(Event(wall_time=time.time(), step=step, summary=Summary(value=values)))
    with open(path, "ab", buffering=0) as file:
        for event in events:
            data = event.SerializeToString()
            size = struct.pack("<Q", len(data))
            file.write(size + _checksum(size) + data + _checksum(data))


def _checksum(data: bytes) -> bytes:
    return struct.pack("<I", masked_crc32c(data))
