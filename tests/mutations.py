"""Damages valid inputs at random and reads them: success or one clear line, nothing else.

    python -m tests.mutations --number 1000 --seed 0

Each kind of input is read in a process of its own, so that a crash inside of a parser written in C
or reading without end is seen as what it is.
"""

import argparse
import io
import json
import os
import random
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))

_LIMIT_S = 20  # for one input
_MEMORY = 12 * 2**30  # of addresses; JAX reserves a few GiB

_ODD_NUMBERS = "nan inf -inf 0 -1 1e-300 1e39 1e400 99999999999999999999 2147483648 0x10".split()
_ODD_VALUES: list[Any] = [
    None, True, -1, 0, 10**400, 0.5, float("nan"), float("inf"), "", "x", "x" * 100_000,
    "\n\x1b[2J", "\ud800", "../..", "a\0b", [], [[]], [1] * 100_000, {}, {"a": {"b": []}}, 2**63,
]  # fmt: skip


class Deep:
    """Stands for brackets without end, which `json.dumps` would not write."""

    text = "[" * 100_000 + "]" * 100_000


def mutate_bytes(rng: random.Random, data: bytes) -> bytes:
    """Flips, cuts, repeats or replaces some bytes."""
    at, length = rng.randrange(len(data) + 1), rng.choice([1, 2, 8, 100])
    kind = rng.randrange(6)
    if kind == 0:
        return data[:at]
    if kind == 1:
        return data[:at] + data[at + length :]
    if kind == 2:
        return data[:at] + rng.randbytes(length) + data[at:]
    if kind == 3:
        return data[:at] + data[max(0, at - length) : at] * 3 + data[at:]
    if kind == 4:
        return rng.choice([b"", b"\0", b"\xff" * 50, b"[" * 100_000, b"PK\x03\x04" + data[40:]])
    changed = bytearray(data)
    for _ in range(rng.choice([1, 1, 3, 30])):
        if changed:
            changed[rng.randrange(len(changed))] = rng.randrange(256)
    return bytes(changed)


def mutate_json(rng: random.Random, value: Any) -> Any:
    """Replaces, removes, renames or repeats something in a value that JSON holds."""
    if isinstance(value, dict) and value and rng.random() < 0.8:
        name = rng.choice(list(value))
        kind = rng.randrange(6)
        if kind == 0:
            return {k: v for k, v in value.items() if k != name}
        if kind == 1:
            return {(k + "s" if k == name else k): v for k, v in value.items()}
        if kind == 2:
            return {**value, rng.choice(["quats", "x" * 1000, "\n", "cylinders"]): value[name]}
        return {**value, name: mutate_json(rng, value[name])}
    if isinstance(value, list) and value and rng.random() < 0.8:
        at = rng.randrange(len(value))
        kind = rng.randrange(6)
        if kind == 0:
            return value[:at] + value[at + 1 :]
        if kind == 1:
            return value[:at] + [value[at]] * rng.choice([2, 3, 100]) + value[at:]
        return [*value[:at], mutate_json(rng, value[at]), *value[at + 1 :]]
    return Deep() if rng.random() < 0.05 else rng.choice(_ODD_VALUES)


def dump(value: Any) -> bytes:
    """JSON, with surrogates, NaN and brackets without end as they come."""
    text = json.dumps(value, default=lambda deep: "DEEP")
    return text.replace('"DEEP"', Deep.text).encode()


def mutate_text(rng: random.Random, text: str) -> str:
    """Changes numbers, names, attributes or tags of XML."""
    numbers = [m.span() for m in re.finditer(r"(?<=[ \"])-?[\d.]+(?=[ \"])", text)]
    attributes = [m.span() for m in re.finditer(r' [a-z]+="[^"]*"', text)]
    tags = [m.span() for m in re.finditer(r"</?[a-z]+", text)]
    words = [m.span() for m in re.finditer(r'(?<=")[a-z]+(?=")', text)]
    # What is left of a text after other changes may have nothing of a kind.
    kind = rng.randrange(8) if all((numbers, attributes, tags, words)) else 7
    if kind <= 1:
        begin, end = rng.choice(numbers)
        return text[:begin] + rng.choice([*_ODD_NUMBERS, "", "1 2 3 4 5", "a"]) + text[end:]
    if kind == 2:
        begin, end = rng.choice(attributes)
        return text[:begin] + text[end:]
    if kind == 3:
        begin, end = rng.choice(attributes)
        other = text[slice(*rng.choice(attributes))]
        return text[:begin] + other + text[end:]
    if kind == 4:
        begin, end = rng.choice(tags)
        return (
            text[:begin] + rng.choice(["<joint", "<body", "<geom", "</body", "<mesh"]) + text[end:]
        )
    if kind == 5:
        begin, end = rng.choice(words)
        kinds = ["mesh", "plane", "box", "capsule", "free", "ball", "slide", "x" * 5000, "&#0;"]
        return text[:begin] + rng.choice(kinds) + text[end:]
    if kind == 6:
        lines = text.split("\n")
        at = rng.randrange(len(lines))
        return "\n".join(lines[:at] + lines[at + 1 :] * rng.choice([1, 2]))
    data = mutate_bytes(rng, text.encode(errors="surrogateescape"))
    return data.decode(errors="surrogateescape")


def _write(path: Path, data: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)


def scenes(folder: Path) -> Callable[[random.Random, Path], Callable[[], object]]:
    from gnnjax.scene.scene_file import scene_from_json

    box = {"center": [0.5, 0, 0.5], "half_extents": [0.1, 0.2, 0.3], "quat": [1, 0, 0, 0]}
    good = {"boxes": [box, {**box, "quat": [0.6, 0, 0.8, 0]}, {**box, "center": [1, 1, 1]}]}

    def make(rng: random.Random, path: Path) -> Callable[[], object]:
        path = path / "scene.json"
        kind = rng.randrange(20)
        if kind == 0:
            path.mkdir(parents=True)
        elif kind < 7:
            _write(path, mutate_bytes(rng, dump(good)))
        else:
            value: Any = good
            for _ in range(rng.choice([1, 1, 2, 3])):
                value = mutate_json(rng, value)
            _write(path, dump(value))
        return lambda: scene_from_json(path)

    return make


def _problem_file(folder: Path) -> Path:
    import numpy as np

    from gnnjax.problems.file import save_problems
    from gnnjax.problems.problem import Problem, ProblemSet
    from gnnjax.scene.scene import box_scene

    rng = np.random.default_rng(0)
    scene = box_scene(
        rng.normal(size=(3, 10, 3)).astype(np.float32),
        rng.uniform(0.1, 0.3, (3, 10, 3)).astype(np.float32),
        np.tile(np.float32([1, 0, 0, 0]), (3, 10, 1)),
        np.arange(10) < np.array([[2], [9], [5]]),
    )
    q = rng.normal(size=(3, 3)).astype(np.float32)
    path = folder / "good.npz"
    save_problems(path, ProblemSet("tiny", Problem(q, -q, scene), {"source": np.array("here")}))
    return path


def _array_bytes(array: Any) -> bytes:
    import numpy as np

    stream = io.BytesIO()
    np.lib.format.write_array(stream, array, allow_pickle=True)
    return stream.getvalue()


def _mutate_npz(rng: random.Random, good: Path, path: Path) -> None:
    """An archive with arrays added, removed, renamed, or of another shape, type or header."""
    import zipfile

    import numpy as np

    with np.load(good) as file:
        arrays = dict(file)
    entries = {f"{name}.npy": _array_bytes(value) for name, value in arrays.items()}
    name = rng.choice(list(entries))
    array = arrays[name.removesuffix(".npy")]
    kind = rng.randrange(9)
    if kind == 0:
        del entries[name]
    elif kind == 1:
        entries[rng.choice(["x", "start", "box_quats.npy", "cylinder_radii.npy"])] = entries.pop(
            name
        )
    elif kind == 2:
        entries[name] = rng.choice(
            [b"", b"text", b"\x93NUMPY", b"\x93NUMPY\x09\0", b"\x80\x04K\x01."]
        )
    elif kind == 3:
        dtypes = ["f2", "f8", "i8", "u1", "c16", "U5", "S3", "M8[s]", "?", "O", "V8"]
        with np.errstate(all="ignore"):
            try:
                entries[name] = _array_bytes(array.astype(rng.choice(dtypes)))
            except ValueError:
                entries[name] = _array_bytes(np.zeros(3, "i4,f8"))
    elif kind == 4:
        rows = np.atleast_1d(array)
        shapes = [rows[..., None], rows[:1], rows.reshape(-1), rows[..., :0], rows.T, rows[0]]
        entries[name] = _array_bytes(np.asarray(rng.choice(shapes)))
    elif kind == 5 and array.dtype.kind == "f":
        array.flat[rng.randrange(array.size)] = float(rng.choice(["nan", "inf", "-1e38", "0"]))
        entries[name] = _array_bytes(array)
    elif kind == 6:
        shape = rng.choice(
            ["(1099511627776, 7)", "(-1, 7)", "(3,)", "7", "('a',)", "(" * 5000, "(2**9,)", "None"]
        )
        header = f"{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}, }}\n".encode()
        entries[name] = b"\x93NUMPY\x01\0" + len(header).to_bytes(2, "little") + header + b"\0" * 84
    elif kind == 7:
        entries[name] = mutate_bytes(rng, entries[name])
    else:
        array = arrays["num_boxes"].copy()
        array[rng.randrange(3)] = rng.choice([0, 10, 11, -1, 2**31 - 1])
        entries["num_boxes.npy"] = _array_bytes(array.astype(rng.choice(["i4", "i8", "u8"])))
    path.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(path, "w") as archive:
        for entry, data in entries.items():
            archive.writestr(entry, data)


def problem_files(folder: Path) -> Callable[[random.Random, Path], Callable[[], object]]:
    from gnnjax.arm.robot import load_robot
    from gnnjax.problems.shards import load_problems

    good, robot = _problem_file(folder), load_robot(_arm(folder))

    def make(rng: random.Random, path: Path) -> Callable[[], object]:
        path = path / "set.npz"
        if rng.random() < 0.4:
            _write(path, mutate_bytes(rng, good.read_bytes()))
        else:
            _mutate_npz(rng, good, path)
        return lambda: load_problems(path, robot)

    return make


def manifests(folder: Path) -> Callable[[random.Random, Path], Callable[[], object]]:
    from gnnjax.arm.robot import load_robot
    from gnnjax.problems.shards import (
        MANIFEST,
        check_origin,
        load_problems,
        read_manifest,
        save_shard,
    )

    robot = load_robot(_arm(folder))
    problems = load_problems(_problem_file(folder), robot)
    for index in range(3):
        save_shard(folder / "set", index, problems, seed=0, settings={"split": "train"})
    good = read_manifest(folder / "set")
    ours = {name: value for name, value in good.items() if name != "shards"}

    def make(rng: random.Random, path: Path) -> Callable[[], object]:
        shutil.copytree(folder / "set", path)
        kind = rng.randrange(12)
        if kind == 0:
            (path / MANIFEST).unlink()
            (path / MANIFEST).mkdir()
        elif kind == 1:
            shard = path / rng.choice(good["shards"])["file"]
            shard.write_bytes(mutate_bytes(rng, shard.read_bytes()))
        elif kind < 5:
            (path / MANIFEST).write_bytes(mutate_bytes(rng, dump(good)))
        else:
            value: Any = good
            for _ in range(rng.choice([1, 1, 2])):
                value = mutate_json(rng, value)
            if kind == 5:
                value = json.loads(json.dumps(good))
                value["shards"][1]["file"] = rng.choice(["x" * 400, "a/b", "..", ".", "", "\ud800"])
            (path / MANIFEST).write_bytes(dump(value))

        def read() -> None:
            check_origin(path, read_manifest(path), ours)
            load_problems(path, robot)

        return read

    return make


def _arm(folder: Path) -> Path:
    from conftest import TINY

    path = folder / "tiny.xml"
    path.write_text(TINY)
    return path


def arms(folder: Path) -> Callable[[random.Random, Path], Callable[[], object]]:
    import numpy as np

    from gnnjax.arm.robot import assets_dir, load_robot
    from gnnjax.collision.certify import certify_path
    from gnnjax.collision.checker import make_checker
    from gnnjax.scene.scene import make_scene

    # Its meshes are found from anywhere.
    kuka = (assets_dir() / "kuka_iiwa14.xml").read_text()
    kuka = kuka.replace('file="meshes', f'file="{assets_dir().resolve()}/meshes')
    good = [_arm(folder).read_text(), kuka]
    scene = make_scene([[0.5, 0.5, 0.5]], [[0.1, 0.1, 0.1]])

    def make(rng: random.Random, path: Path) -> Callable[[], object]:
        path = path / "arm.xml"
        text = rng.choice(good)
        for _ in range(rng.choice([1, 1, 2, 4])):
            text = mutate_text(rng, text)
        _write(path, text.encode(errors="surrogateescape"))

        def read() -> None:
            robot = load_robot(path)
            make_checker(robot)
            q = np.stack([robot.joint_lower, robot.home])
            certify_path(robot, scene, q[[1, 1]])

        return read

    return make


def checkpoints(folder: Path) -> Callable[[random.Random, Path], Callable[[], object]]:
    from flax import nnx

    from gnnjax.guide.motion import MotionNetwork
    from gnnjax.training.checkpoint import TrainingCheckpoints
    from gnnjax.training.run import TrainState
    from gnnjax.training.weights import load_network, save_network

    network = MotionNetwork(2, 4, rngs=nnx.Rngs(0))
    training = {"seed": 0, "log": [{"loss": 1.0}]}
    save_network(folder / "good.safetensors", network, training)
    weights = (folder / "good.safetensors").read_bytes()
    state = TrainState(nnx.state(network, nnx.Param), {})
    TrainingCheckpoints(folder / "run", network, training).save(1, state, [])

    def make(rng: random.Random, path: Path) -> Callable[[], object]:
        if rng.random() < 0.5:
            file = path.with_suffix(".safetensors")
            data = weights
            if rng.random() < 0.5:  # its description
                size = 8 + int.from_bytes(weights[:8], "little")
                head = dump(mutate_json(rng, json.loads(weights[8:size])))
                data = len(head).to_bytes(8, "little") + head + weights[size:]
            file.write_bytes(data if data != weights else mutate_bytes(rng, weights))
            return lambda: load_network(file)
        shutil.copytree(folder / "run" / "1", path)
        files = sorted(p for p in path.rglob("*") if p.is_file())
        file = rng.choice(files)
        kind = rng.randrange(6)
        if kind == 0:
            file.unlink()
        elif kind == 1:
            file.unlink()
            file.mkdir()
        elif kind < 4:
            meta = path / "meta" / "metadata"
            meta.write_bytes(dump(mutate_json(rng, json.loads(meta.read_text()))))
        else:
            file.write_bytes(mutate_bytes(rng, file.read_bytes()))
        return lambda: load_network(path)

    return make


KINDS = {
    "scenes": (scenes, 0.25),
    "problem_files": (problem_files, 0.25),
    "manifests": (manifests, 0.15),
    "arms": (arms, 0.2),
    "checkpoints": (checkpoints, 0.15),
}


def judge(read: Callable[[], object]) -> str:
    """ "read", "refused", or what is wrong with how the input was taken."""
    from gnnjax.errors import InputError

    begin = time.perf_counter()
    try:
        read()
        outcome = "read"
    except InputError as error:
        text = str(error)
        line = len(text) < 300 and len(text.splitlines()) == 1 and text.isprintable()
        outcome = "refused" if line else f"{len(text)} characters: {text[:200]!r}"
    except BaseException as error:
        where = traceback.extract_tb(error.__traceback__)[-1]
        outcome = f"{type(error).__name__} at {where.filename}:{where.lineno}: {str(error)[:200]!r}"
    seconds = time.perf_counter() - begin
    return outcome if seconds < _LIMIT_S / 2 else f"{outcome} after {seconds:.1f} s"


def read_kind(kind: str, numbers: range, seed: int) -> None:
    """Reads some mutated inputs of a kind; a line each, begun before it is read."""
    resource.setrlimit(resource.RLIMIT_AS, (_MEMORY, _MEMORY))
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        make = KINDS[kind][0](folder)
        os.chdir(folder)  # where MuJoCo writes its log
        for number in numbers:
            rng = random.Random(f"{kind} {seed} {number}")
            path = folder / f"input{number}"
            read = make(rng, path)
            print(json.dumps([number, "begun"]), flush=True)
            signal.alarm(_LIMIT_S)
            with tempfile.TemporaryFile() as words:
                terminal = os.dup(2)
                os.dup2(words.fileno(), 2)
                outcome = judge(read)
                os.dup2(terminal, 2)
                os.close(terminal)
                words.seek(0)
                if said := words.read():  # by a library, past the error
                    outcome += f" and said {said[:300]!r}"
            signal.alarm(0)
            print(json.dumps([number, outcome]), flush=True)
            shutil.rmtree(path, ignore_errors=True)
        os.chdir("/")


def try_kind(kind: str, number: int, seed: int) -> dict[int, str]:
    """What became of each of `number` inputs; begins anew after one that ends the process."""
    outcomes: dict[int, str] = {}
    first = 0
    while first < number:
        command = [sys.executable, __file__, "--kind", kind, "--first", str(first)]
        command += ["--number", str(number), "--seed", str(seed)]
        done = subprocess.run(command, capture_output=True, text=True, errors="replace")
        rows = [json.loads(x) for x in done.stdout.splitlines() if x.startswith("[")]
        if not rows:
            raise RuntimeError(f"{kind}: nothing was read\n{done.stderr[-2000:]}")
        outcomes |= dict(rows)
        last = rows[-1][0]
        if outcomes[last] == "begun":
            outcomes[last] = f"the process ended with {done.returncode}: {done.stderr[-300:]!r}"
        first = last + 1
    return outcomes


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--number", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kind", choices=list(KINDS), help="read this kind here, for debugging")
    parser.add_argument("--first", type=int, default=0, help="with --kind: the first input")
    arguments = parser.parse_args()
    if arguments.kind:
        read_kind(arguments.kind, range(arguments.first, arguments.number), arguments.seed)
        return 0
    wrong = 0
    for kind, (_, share) in KINDS.items():
        outcomes = try_kind(kind, round(share * arguments.number), arguments.seed)
        counts = [sum(x == y for x in outcomes.values()) for y in ("read", "refused")]
        print(f"{kind}: {len(outcomes)} inputs, {counts[0]} read, {counts[1]} refused", flush=True)
        for number, outcome in outcomes.items():
            if outcome not in ("read", "refused"):
                print(f"  {number}: {outcome}")
                wrong += 1
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
