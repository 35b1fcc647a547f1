"""Commands in two processes of two devices each come to what one process comes to."""

import dataclasses
import json
import os
import shutil
import socket
import subprocess
import sys

import jax
import numpy as np
import pytest

from gnnjax.evaluate import EvaluateConfig, evaluate
from gnnjax.generate import GenerateConfig, generate
from gnnjax.train import PRESETS, train
from gnnjax.training.weights import load_network

pytestmark = pytest.mark.whole

DEVICES = {"JAX_NUM_CPU_DEVICES": "2"}


def run_two(command, options, codes=None):
    """Runs a command in two processes; their exit statuses, and the last line of each's errors.

    Args:
        command: a module.
        options: of it, but for those of the processes.
        codes: what runs in place of the command, by process.
    """
    started = []
    for index in range(2):
        what = ["-c", codes[index]] if codes and index in codes else ["-m", f"gnnjax.{command}"]
        place = ["--distributed", "--process-id", str(index), "--process-count", "2"]
        started.append(
            subprocess.Popen(
                [sys.executable, *what, *map(str, options), *place],
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                text=True,
                env=os.environ | DEVICES,
            )
        )
    said = [process.communicate()[1].splitlines() for process in started]
    return [process.returncode for process in started], [lines[-1:] for lines in said]


KILLED_AFTER_ITS_FIRST_SHARD = """
import os, signal
import gnnjax.generate as command
save = command.save_shard
def save_and_die(*args, **kwargs):
    save(*args, **kwargs)
    os.kill(os.getpid(), signal.SIGKILL)
command.save_shard = save_and_die
command.generate(command.parse_arguments(command.GenerateConfig))
"""


def test_a_set_is_the_same_from_any_number_of_processes_one_of_them_killed(tiny_path, tmp_path):
    config = GenerateConfig(
        robot=str(tiny_path), num_problems=9, num_nodes=24, shard_size=2, out=tmp_path / "one"
    )
    generate(config)
    two = tmp_path / "two"
    options = ["--robot", tiny_path, "--num-problems", 9, "--num-nodes", 24, "--shard-size", 2]
    options += ["--out", two, "--patience", 2]
    status, said = run_two("generate", options, {1: KILLED_AFTER_ITS_FIRST_SHARD})
    assert status == [2, -9]
    ((sentence,), _) = said
    assert sentence.startswith("error: process 1 of 2 ")
    assert sentence.endswith("after 2 s; start all of them again to go on") or sentence.endswith(
        "has not been heard of for 2 s; start all of them again to go on"
    )
    # Nothing that was made is lost: shards 0, 2 and 4 of the one, and shard 1 of the other.
    made = {path.name: path.stat().st_mtime_ns for path in two.glob("*.npz")}
    assert sorted(made) == [f"shard_0000{i}.npz" for i in (0, 1, 2, 4)]
    assert not (two / "manifest.json").exists()
    generate(dataclasses.replace(config, out=two))
    files = {path.name: path.read_bytes() for path in config.out.iterdir()}
    assert {path.name: path.read_bytes() for path in two.iterdir()} == files
    assert all((two / name).stat().st_mtime_ns == then for name, then in made.items())


@pytest.fixture(scope="module")
def problems(tiny_path, tmp_path_factory):
    """A folder of eleven problems, in shards that are no whole batches."""
    out = tmp_path_factory.mktemp("problems") / "set"
    generate(
        GenerateConfig(
            robot=str(tiny_path), num_problems=11, num_nodes=0, seed=3, shard_size=4, out=out
        )
    )
    return out


def without_times(rows):
    return [{k: v for k, v in row.items() if not k.endswith("_s")} for row in rows]


def test_results_are_the_same_from_any_number_of_processes(tiny_path, problems, tmp_path):
    config = EvaluateConfig(
        robot=str(tiny_path),
        problems=problems,
        json=tmp_path / "one.json",
        planner="lazysp",
        num_nodes=40,
        max_roadmaps=2,
        batch_size=3,
    )
    one = evaluate(config)
    # What one process has done before it was cut off, and one of several: rows 0 to 3 and 9 to 10.
    two = dataclasses.replace(config, json=tmp_path / "two.json")
    cut = {"problems": one["problems"][:4], "complete": False, "summary": {}}
    two.json.write_text(json.dumps(one | cut))
    folder = tmp_path / "two.json.parts"
    folder.mkdir()
    (folder / "rows_00003.json").write_text(json.dumps(one | {"problems": one["problems"][9:]}))
    options = ["--robot", tiny_path, "--problems", problems, "--json", two.json]
    options += ["--planner", "lazysp", "--num-nodes", 40, "--max-roadmaps", 2, "--batch-size", 3]
    status, said = run_two("evaluate", options)
    assert status == [0, 0], said
    found = json.loads(two.json.read_text())
    assert found["settings"] == one["settings"]
    assert found["machine"]["processes"] == 2
    assert without_times(found["problems"]) == without_times(one["problems"])
    for kept in (slice(3), slice(9, 11)):  # times too: nothing was redone
        assert found["problems"][kept] == one["problems"][kept]
    assert found["summary"]["all"]["edge_checks"] == one["summary"]["all"]["edge_checks"]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["one.json", "two.json"]

    # For more rows than memory holds, files of some stay, beside what they come to.
    apart = dataclasses.replace(config, json=tmp_path / "apart.json", keep_parts=True)
    kept = evaluate(apart)
    folder = tmp_path / "apart.json.parts"
    files = [folder / name for name in kept["parts"]]
    rows = [row for file in files for row in json.loads(file.read_text())["problems"]]
    assert without_times(rows) == without_times(one["problems"])
    assert kept["problems"] == []
    assert kept["summary"]["all"]["cost"] == one["summary"]["all"]["cost"]
    joined = evaluate(dataclasses.replace(apart, keep_parts=False))
    assert joined["problems"] == rows
    assert not folder.exists()


def free_port():
    with socket.socket() as server:
        server.bind(("localhost", 0))
        return server.getsockname()[1]


def records(out):
    return [json.loads(line) for line in (out / "log.jsonl").read_text().splitlines()]


def test_two_processes_of_two_devices_go_on_with_a_training_of_one(tiny_path, tmp_path):
    data, one, two = tmp_path / "data", tmp_path / "one", tmp_path / "two"
    generate(
        GenerateConfig(robot=str(tiny_path), num_problems=8, num_nodes=12, shard_size=8, out=data)
    )
    # The smallest network.
    options = {"batch_size": 4, "epochs": 4, "validate_every": 2, "validation_problems": 0}
    options |= {"channels": 4, "max_walk": 2, "num_dof": 3}
    config = dataclasses.replace(
        PRESETS["paper"], robot=str(tiny_path), data=data, out=one, **options
    )
    train(config)
    shutil.copytree(one, two)
    shutil.rmtree(two / "checkpoints" / "4")
    (two / "weights.safetensors").unlink()
    words = ["--preset", "paper", "--robot", tiny_path, "--data", data, "--out", two, "--resume"]
    words += [x for key, value in options.items() for x in (f"--{key.replace('_', '-')}", value)]
    status, said = run_two("train", [*words, "--coordinator", f"localhost:{free_port()}"])
    assert status == [0, 0], said
    for expected, found in zip(records(one), records(two), strict=True):
        assert expected.keys() == found.keys()
        del expected["seconds"], found["seconds"]
        np.testing.assert_allclose(
            list(found.values()), list(expected.values()), rtol=1e-5, err_msg=str(expected)
        )
    assert sorted(path.name for path in (two / "checkpoints").iterdir()) == ["2", "4"]
    first, second = (
        jax.tree.leaves(jax.tree.map(np.asarray, dict(enumerate(leaves_of(out)))))
        for out in (one, two)
    )
    for a, b in zip(first, second, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5)
    assert [path.name for path in tmp_path.iterdir() if path.name.startswith(".")] == []


def leaves_of(out):
    return jax.tree.leaves(load_network(out / "weights.safetensors"))
