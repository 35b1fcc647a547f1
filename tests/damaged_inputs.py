"""Valid inputs of each kind, damaged at random, and what reads them."""

import io
import json
import random
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tests.damage import dump, mutate_bytes, mutate_json, mutate_text


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
    from tests.conftest import TINY

    path = folder / "tiny.xml"
    path.write_text(TINY)
    return path


def arms(folder: Path) -> Callable[[random.Random, Path], Callable[[], object]]:
    import numpy as np

    from gnnjax.arm.robot import load_robot
    from gnnjax.arm.shipped import assets_dir
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
