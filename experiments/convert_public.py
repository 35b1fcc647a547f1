"""Converts the public Kuka problems to a problem set of this repository.

    python -m experiments.convert_public kukas_7_3000.pkl kuka_iiwa14_public.npz

The source is `maze_files/kukas_7_3000.pkl` of gnn-motion-planning by Yu and Gao (MIT license): a
pickled list of `(obstacles, start, goal, path)` with obstacles `(half_extents, center)`, which are
axis-aligned boxes in m around an arm whose base is the origin. Its paths are left out.
"""

import dataclasses
import pickle
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from gnnjax.arguments import parse_arguments
from gnnjax.errors import InputError, run_command
from gnnjax.problems.file import save_problems
from gnnjax.problems.problem import Problem, ProblemSet
from gnnjax.scene.scene import box_scene


@dataclasses.dataclass(frozen=True)
class ConvertConfig:
    """Convert the public Kuka problems to a problem set."""

    source: tyro.conf.Positional[Path]
    """The pickle, such as kukas_7_3000.pkl."""
    out: tyro.conf.Positional[Path]
    """The problem set to write, .npz."""
    robot: str = "kuka_iiwa14"
    """The robot that the problems are for."""


def convert(config: ConvertConfig) -> int:
    """Writes the problem set and returns the number of problems in it."""
    entries = read_pickle(config.source)
    if not isinstance(entries, list | tuple) or not entries:
        raise InputError(f"{str(config.source)!r} holds no list of problems; is it the right file?")
    save_problems(config.out, ProblemSet(config.robot, problems_of(entries, config.source)))
    return len(entries)


def problems_of(entries: Sequence[Any], source: Path) -> Problem:
    """Stacks the P entries `(obstacles, start, goal, ...)` of a source, in their order."""
    boxes, ends = [], []
    for row, entry in enumerate(entries):
        try:
            obstacles, start, goal = entry[:3]
            boxes.append(np.asarray(list(obstacles), np.float32).reshape(-1, 2, 3))
            ends.append(np.asarray([start, goal], np.float32))
        except (TypeError, ValueError) as error:
            raise InputError(
                f"problem {row} of {str(source)!r} is not (obstacles, start, goal, path) with "
                f"obstacles (half_extents, center): {error}"
            ) from None
        if ends[-1].ndim != 2 or ends[-1].shape != ends[0].shape:
            raise InputError(
                f"start and goal of problem {row} of {str(source)!r} are of shape "
                f"{ends[-1].shape[1:]}; each must be a configuration as long as the first problem's"
            )
        if not (np.isfinite(boxes[-1]).all() and np.isfinite(ends[-1]).all()):
            raise InputError(f"problem {row} of {str(source)!r} holds numbers that are not finite")
        if not (boxes[-1][:, 0] > 0).all():
            raise InputError(
                f"problem {row} of {str(source)!r} has half extents that are not positive"
            )
    num_boxes = np.array([len(b) for b in boxes])
    mask = np.arange(num_boxes.max()) < num_boxes[:, None]
    centers = np.zeros((*mask.shape, 3), np.float32)
    half_extents = np.full_like(centers, 0.1)  # of padding: a box that no kernel chokes on
    half_extents[mask], centers[mask] = np.concatenate(boxes).swapaxes(0, 1)
    quats = np.tile(np.array([1, 0, 0, 0], np.float32), (*mask.shape, 1))
    starts, goals = np.stack(ends, axis=1)
    return Problem(starts, goals, box_scene(centers, half_extents, quats, mask))


def read_pickle(path: Path) -> Any:
    """Reads lists, tuples, numbers and NumPy arrays from a pickle, and refuses all else.

    Raises:
        InputError: no such file, no pickle, or one that names anything but NumPy's constructors.
    """
    try:
        with open(path, "rb") as file:
            return _ArrayUnpickler(file).load()
    except FileNotFoundError:
        raise InputError(f"no file {str(path)!r}; download it from gnn-motion-planning") from None
    except (InputError, OSError):
        raise
    except Exception as error:  # damaged pickles raise nearly anything
        raise InputError(f"{str(path)!r} is not a pickle of problems: {error!r}") from None


def _latin1(text: str, encoding: str) -> bytes:
    # Protocols up to 2 have no bytes and write them as text to be encoded.
    if encoding != "latin1":
        raise InputError(
            f"the pickle wants encoding {encoding!r}; arrays are written as latin1 only"
        )
    return text.encode("latin1")


# Taken from NumPy's own reductions, which are public, unlike the modules they lie in.
_ARRAY = {
    "_reconstruct": np.zeros(1).__reduce__()[0],
    "scalar": np.float64(0).__reduce__()[0],
}
_ADMITTED = {
    ("numpy", "ndarray"): np.ndarray,
    ("numpy", "dtype"): np.dtype,
    ("_codecs", "encode"): _latin1,
    # NumPy 1 and 2 have the same functions at different places.
    **{(f"numpy.{c}.multiarray", name): f for c in ("core", "_core") for name, f in _ARRAY.items()},
    **{
        (f"numpy.{c}.numeric", "_frombuffer"): np.zeros(1).__reduce_ex__(5)[0]
        for c in ("core", "_core")
    },
}


class _ArrayUnpickler(pickle.Unpickler):
    """Looks names up in a fixed table, so that a pickle can import and call nothing else."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _ADMITTED:
            raise InputError(
                f"the pickle names {module}.{name}; only NumPy arrays are read, since other "
                "pickles can run code: get the file from its original place"
            )
        return _ADMITTED[module, name]


def main() -> None:
    config = parse_arguments(ConvertConfig)
    print(f"wrote {convert(config)} problems to {config.out}")


if __name__ == "__main__":
    run_command(main)
