"""The folder of a training run: checkpoints, log, TensorBoard's events and, at last, weights."""

import contextlib
import json
import struct
import time
from pathlib import Path
from typing import Any

from flax import nnx
from tensorboardX.proto.event_pb2 import Event
from tensorboardX.proto.summary_pb2 import Summary
from tensorboardX.record_writer import masked_crc32c

from gnnjax.errors import InputError
from gnnjax.files import atomic_write, locked
from gnnjax.training.checkpoint import TrainingCheckpoints
from gnnjax.training.weights import save_network

# What both trainings advise after an interruption.
AGAIN = "start the same command again with --resume"


class TrainingRun(contextlib.ExitStack):
    """Keeps what a training comes to, and goes on with what an interrupted one has left.

    The log is part of the checkpoint: a run that goes on has the records up to its checkpoint,
    wherever the one before was killed.

    Args:
        out: folder of the run; nobody else may write there meanwhile.
        network: what is trained.
        settings: of the run, as JSON; a run goes on only with the same ones.
        unit: what records count: "step" or "epoch".
        steps: of a unit.
    """

    def __init__(
        self, out: Path, network: nnx.Module, settings: dict[str, Any], unit: str, steps: int = 1
    ):
        super().__init__()
        self.out, self.records = out, []
        self._network, self._settings, self._unit, self._steps = network, settings, unit, steps
        self._events = out / "tensorboard" / f"events.out.tfevents.{int(time.time())}.gnnjax"

    def __enter__(self) -> "TrainingRun":
        super().__enter__()
        with contextlib.ExitStack() as stack:
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
        self._write_log()
        self._append_event(record)

    def finish(self, weights: Any) -> Path:
        """Writes the weights and returns their file."""
        nnx.update(self._network, weights)
        training = {**self._settings, "log": self.records[-1:]}
        path = self.out / "weights.safetensors"
        save_network(path, self._network, training)
        print(f"weights in {path}")
        return path

    def _append_event(self, record: dict[str, Any]) -> None:
        _append_event(self._events, record, record[self._unit] * self._steps)

    def _write_log(self) -> None:
        text = "".join(json.dumps(record) + "\n" for record in self.records)
        atomic_write(self.out / "log.jsonl", lambda file: file.write_text(text, encoding="utf-8"))


def _read_log(path: Path, unit: str, done: int) -> list[dict[str, Any]]:
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    return [record for record in map(json.loads, lines) if record[unit] <= done]


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
