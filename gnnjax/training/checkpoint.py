"""Checkpoints of training runs, by Orbax: weights, optimizer and settings, to go on with."""

import errno
import json
import os
import shutil
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp
import tensorstore
from flax import nnx
from jax.experimental import multihost_utils

from gnnjax.errors import InputError, brief, one_line
from gnnjax.training.weights import metadata, read_metadata

# What Orbax adds to the name of a folder until all is written.
_UNFINISHED = ".orbax-checkpoint-tmp"


def checkpoint_metadata(folder: Path) -> Any:
    """What a checkpoint says of itself, unchecked."""
    return _restore(folder.resolve(), meta=ocp.args.JsonRestore())["meta"]


def restore_weights(folder: Path, shapes: Any) -> Any:
    """The weights of a checkpoint alone, as arrays of the given shapes."""
    target = _on_this_device(shapes)
    return _restore(folder.resolve(), weights=ocp.args.StandardRestore(target))["weights"]


def _on_this_device(shapes: Any) -> Any:
    """Says where restored arrays go, wherever they were when they were saved."""
    sharding = jax.sharding.SingleDeviceSharding(jax.local_devices()[0])
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=sharding), shapes)


class TrainingCheckpoints:
    """The checkpoints of a training run, one folder an epoch; the last two are kept. Processes that
    train together make and call it together.

    Args:
        folder: made if missing.
        network: of the run, for its description.
        settings: of the run, as JSON; a run goes on only with the same ones.
    """

    def __init__(self, folder: str | Path, network: nnx.Module, settings: dict[str, Any]):
        self.folder = Path(folder).resolve()
        self._meta = metadata(network, settings)
        if jax.process_index() == 0:
            _remove_unfinished(self.folder, "*")
        self._remove_old()

    def latest(self) -> int | None:
        """The epoch of the last checkpoint."""
        latest = max(self._epochs(), default=-1)
        if jax.process_count() > 1:  # others may see the folder as it was a while ago
            latest = int(multihost_utils.broadcast_one_to_all(np.int32(latest)))
        return None if latest < 0 else latest

    def save(self, epoch: int, state: Any, log: list[dict[str, Any]]) -> None:
        """Writes `state` (weights, optimizer) after an epoch, and the log so far."""
        items = ocp.args.Composite(
            weights=ocp.args.StandardSave(nnx.to_pure_dict(state.weights)),
            optimizer=ocp.args.StandardSave(_by_number(state.optimizer)),
            meta=ocp.args.JsonSave({**self._meta, "log": log}),
        )
        _write(self.folder / str(epoch), (state.weights, state.optimizer), items)
        self._remove_old()

    def _epochs(self) -> list[int]:
        """Those of which there is a checkpoint; what is unfinished has another name."""
        return sorted(int(path.name) for path in self.folder.glob("[0-9]*") if path.name.isdigit())

    def _remove_old(self) -> None:
        # Not by Orbax's manager, which removes a folder bit by bit under its own name.
        for epoch in self._epochs()[:-2] if jax.process_index() == 0 else ():
            rest = self.folder / f"{epoch}{_UNFINISHED}"
            (self.folder / str(epoch)).rename(rest)
            shutil.rmtree(rest, ignore_errors=True)

    def restore(self, state: Any) -> tuple[int, Any, list[dict[str, Any]] | None]:
        """The last epoch written, and `state` and the log (None: not kept) as they were then.

        Raises:
            InputError: there is none, it is damaged, or it is of a run with other settings.
        """
        epoch = self.latest()
        if epoch is None:
            raise InputError(f"no checkpoint in {str(self.folder)!r}; train one first")
        folder = self.folder / str(epoch)
        meta = read_metadata(folder)
        ours, theirs = json.loads(json.dumps(self._meta["training"])), meta["training"]
        for name in sorted(ours.keys() | theirs.keys()):
            # What was no option yet when the run began is off, whatever that looks like.
            if (ours.get(name) or None) != (theirs.get(name) or None):
                raise InputError(
                    f"the run in {str(self.folder)!r} has {name} {brief(theirs.get(name))}, not "
                    f"{brief(ours.get(name))}; go on with the same settings"
                )
        shapes = _on_this_device((nnx.to_pure_dict(state.weights), _by_number(state.optimizer)))
        items = _restore(
            folder,
            weights=ocp.args.StandardRestore(shapes[0]),
            optimizer=ocp.args.StandardRestore(shapes[1]),
        )
        log = meta.get("log")
        if log is not None and not (isinstance(log, list) and all(type(x) is dict for x in log)):
            raise InputError(f"checkpoint {str(folder)!r} is damaged (its log); train again")
        structure = jax.tree.structure(state.optimizer)
        leaves = [items["optimizer"][str(i)] for i in range(structure.num_leaves)]
        restored = jax.tree.map(lambda x: x, state.weights)
        nnx.replace_by_pure_dict(restored, items["weights"])
        optimizer = jax.tree.unflatten(structure, leaves)
        # Restored arrays are bound to a device, and JAX would compile all that is done with them
        # anew.
        restored, optimizer = jax.tree.map(
            lambda x: jnp.asarray(np.asarray(x)), (restored, optimizer)
        )
        return epoch, state._replace(weights=restored, optimizer=optimizer), log


def _by_number(state: Any) -> dict[str, Any]:
    """The arrays of an optimizer's state, and how many they are: plain SGD has none, and Orbax
    refuses to write nothing."""
    leaves = jax.tree.leaves(state)
    return {"num_leaves": np.asarray(len(leaves), np.int32)} | {
        str(i): x for i, x in enumerate(leaves)
    }


def _remove_unfinished(folder: Path, name: str) -> None:
    """Removes what killed runs left of a checkpoint; Orbax would warn, or leave it there."""
    for rest in folder.glob(f"{name}{_UNFINISHED}*"):
        shutil.rmtree(rest, ignore_errors=True)


def _write(folder: Path, arrays: Any, items: ocp.args.Composite) -> None:
    """Writes a checkpoint, or says why it cannot be written."""
    # On a full disk Orbax fills the terminal with the failures of its threads. It writes arrays
    # twice, and dozens of small files.
    needed = 2 * sum(x.nbytes for x in jax.tree.leaves(arrays)) + 2**22
    place = next(parent for parent in folder.parents if parent.exists())
    if shutil.disk_usage(place).free < needed:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(folder))
    try:
        with ocp.Checkpointer(ocp.CompositeCheckpointHandler()) as checkpointer:
            checkpointer.save(folder, args=items, force=True)
    except ValueError as error:  # what TensorStore makes of a failed write
        reason = one_line(str(error), 200)
        raise InputError(
            f"checkpoint {str(folder)!r} cannot be written ({reason}); make room and start again"
        ) from None


def _restore(folder: Path, **items: Any) -> Any:
    try:
        for name, item in items.items():
            if isinstance(item, ocp.args.StandardRestore):
                _read_through(folder / name, item.item)
        with ocp.Checkpointer(ocp.CompositeCheckpointHandler()) as checkpointer:
            return checkpointer.restore(folder, args=ocp.args.Composite(**items))
    except Exception as error:  # a damaged folder raises nearly anything
        reason = one_line(str(error), 120)
        raise InputError(
            f"checkpoint {str(folder)!r} is damaged or no checkpoint ({reason}); "
            "train again, or copy it anew"
        ) from None


def _read_through(folder: Path, target: Any) -> None:
    """Raises where an array of `target` cannot be read, or has another shape.

    Orbax reads all arrays at once; when one fails it leaves, and what the others then report
    reaches nobody but the terminal.
    """
    for file in (folder / "array_metadatas").glob("*"):
        json.loads(file.read_text(encoding="utf-8"))
    store = tensorstore.KvStore.open({"driver": "ocdbt", "base": folder.as_uri()}).result()
    for key in store.list().result():
        store.read(key).result()
    for path, leaf in jax.tree_util.tree_flatten_with_path(target)[0]:
        name = ".".join(str(part.key) for part in path)
        place = {**store.spec().to_json(), "path": f"{name}/"}
        spec = {"driver": "zarr", "kvstore": place, "fill_missing_data_reads": False}
        array = tensorstore.open(spec).result()
        if array.shape != leaf.shape:
            raise ValueError(f"array {name} has shape {array.shape}, not {leaf.shape}")
        array.read().result()
