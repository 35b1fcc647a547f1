"""Weights on disk: one safetensors file with a network's weights, and how they came about.

Checkpoints of a training run (`checkpoint.py`, by Orbax) hold the state of the optimizer, too, and
can be planned with as well. Planning with weights loads no Orbax.
"""

import hashlib
import importlib
import json
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import safetensors
from flax import nnx
from safetensors.numpy import load_file, save_file

from gnnjax.errors import InputError, brief, one_line
from gnnjax.files import atomic_write, code_version

# Kinds of networks, where they are, and the planners that take them. Imported when asked for: the
# default planner loads none but its own.
_KINDS = {
    "MotionNetwork": ("gnnjax.guide.motion", "'guided'"),
    "GuidanceNetwork": ("gnnjax.paper.network", "'gnn' and 'gnn_lazy'"),
}
_Kind = TypeVar("_Kind", bound=nnx.Module)

# Of what is stored; raised when an older reader could no longer make sense of it.
FORMAT = 2
SUFFIX = ".safetensors"


def find_weights(weights: str | Path) -> Path:
    """A file of weights or the folder of a checkpoint: its path, or the name of shipped weights.

    Raises:
        InputError: there is neither, or it is the folder of a whole training.
    """
    shipped = Path(__file__).parents[1] / "weights"
    for path in (Path(weights), shipped / f"{weights}{SUFFIX}"):
        if (path / "checkpoints").is_dir():
            raise InputError(
                f"{str(path)!r} is the folder of a training; name its 'weights{SUFFIX}', which are "
                "there at its end, or the folder of one of its checkpoints"
            )
        if path.exists():
            return path
    known = sorted(file.stem for file in shipped.glob(f"*{SUFFIX}"))
    raise InputError(
        f"no weights {str(weights)!r}; train some (python -m gnnjax.train_motion, or "
        f"gnnjax.train), or name some of {known}"
    )


def default_weights(robot: str) -> str:
    """The shipped guidance network for a robot: its own, or the Kuka's, which serves others."""
    shipped = Path(__file__).parents[1] / "weights"
    return robot if (shipped / f"{robot}{SUFFIX}").is_file() else "kuka_iiwa14"


def metadata(network: Any, training: dict[str, Any]) -> dict[str, Any]:
    """What weights say of themselves: enough to rebuild the network without being told anything.

    Args:
        network: whose constructor arguments are kept.
        training: the configuration of the run, as JSON.
    """
    return {
        "format": FORMAT,
        "version": code_version(),
        "network": type(network).__name__,
        "model": network.config,
        "training": training,
    }


def save_network(path: str | Path, network: Any, training: dict[str, Any]) -> None:
    """Writes the weights of a network; replaces the file only when all is written.

    Args:
        path: of the file.
        network: what to keep.
        training: the configuration of the run and its results, as JSON.
    """
    state = nnx.to_pure_dict(nnx.state(network, nnx.Param))
    arrays = {name: np.asarray(array) for name, array in _named(state).items()}
    meta = {**metadata(network, training), "sha256": _sha256(arrays)}
    texts = {"gnnjax": json.dumps(meta)}
    atomic_write(path, lambda file: save_file(arrays, file, metadata=texts))


def read_metadata(weights: str | Path) -> dict[str, Any]:
    """Reads and checks what weights say of themselves.

    Raises:
        InputError: none there, damaged ones, or of another format.
    """
    path = find_weights(weights)
    if path.is_dir():
        from gnnjax.training.checkpoint import checkpoint_metadata

        return check_format(path, checkpoint_metadata(path))
    try:
        with safetensors.safe_open(path, framework="numpy") as file:
            meta = json.loads((file.metadata() or {})["gnnjax"])
    except (safetensors.SafetensorError, ValueError, KeyError, RecursionError) as error:
        raise _damaged(path, error) from None
    return check_format(path, meta)


def check_format(path: Path, meta: Any) -> dict[str, Any]:
    """Returns metadata that this version can read, or says which could."""
    if not isinstance(meta, dict) or meta.get("format") != FORMAT:
        found = meta.get("format") if isinstance(meta, dict) else meta
        version = meta.get("version", "unknown") if isinstance(meta, dict) else "unknown"
        raise InputError(
            f"{str(path)!r} has format {brief(found)} (version {brief(version)}), this one reads "
            f"format {FORMAT}; train again, or install the version that wrote it"
        )
    return meta


def load_network(weights: str | Path) -> Any:
    """Rebuilds a network from its weights.

    Args:
        weights: a file, folder of a checkpoint, or the name of shipped weights.

    Raises:
        InputError: none there, damaged ones, or of another format.
    """
    path = find_weights(weights)
    meta = read_metadata(path)
    try:
        kind = getattr(importlib.import_module(_KINDS[meta["network"]][0]), meta["network"])
        # Shapes alone: drawing initial weights to throw them away takes seconds.
        blank = nnx.eval_shape(lambda: kind(**meta["model"], rngs=nnx.Rngs(0)))
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{str(path)!r} describes no network of this version ({error}); train again"
        ) from None
    graphdef, shapes = nnx.split(blank)
    wanted = nnx.to_pure_dict(shapes)
    if path.is_dir():
        from gnnjax.training.checkpoint import restore_weights

        state = restore_weights(path, wanted)
    else:
        state = _read_arrays(path, meta, wanted)
    nnx.replace_by_pure_dict(shapes, state)
    return nnx.merge(graphdef, shapes)


def load_network_as(kind: type[_Kind], weights: str | Path, planner: str) -> _Kind:
    """`load_network` for a planner that takes one kind of network.

    Raises:
        InputError: another kind; says which, and what loads it.
    """
    network = load_network(weights)
    if not isinstance(network, kind):
        found = type(network).__name__
        raise InputError(
            f"planner {planner!r} takes a {kind.__name__}, and {str(weights)!r} is a {found}, for "
            f"{_KINDS[found][1]}; name other weights or another planner"
        )
    return network


def _read_arrays(path: Path, meta: dict[str, Any], wanted: dict[str, Any]) -> dict[str, Any]:
    try:
        arrays = load_file(path)
    except (safetensors.SafetensorError, ValueError) as error:
        raise _damaged(path, error) from None
    shapes = {name: array.shape for name, array in arrays.items()}
    named = _named(wanted)
    if _sha256(arrays) != meta.get("sha256") or shapes != {k: x.shape for k, x in named.items()}:
        raise _damaged(path, ValueError("its arrays are not those that were written"))
    leaves = [jnp.asarray(arrays[name]) for name in named]
    return jax.tree.unflatten(jax.tree.structure(wanted), leaves)


def _named(state: dict[str, Any]) -> dict[str, Any]:
    """The arrays of nested dictionaries by their paths, in the order of `jax.tree.leaves`."""
    return {
        jax.tree_util.keystr(path, simple=True, separator="/"): leaf
        for path, leaf in jax.tree.leaves_with_path(state)
    }


def _damaged(path: Path, error: Exception) -> InputError:
    reason = one_line(str(error), 120)
    return InputError(
        f"{str(path)!r} is damaged or no file of weights ({reason}); train again, or copy it anew"
    )


def _sha256(arrays: dict[str, np.ndarray]) -> str:
    digest = hashlib.sha256()
    for name in sorted(arrays):
        digest.update(name.encode())
        digest.update(np.ascontiguousarray(arrays[name]).tobytes())
    return digest.hexdigest()
