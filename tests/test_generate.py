"""Generated problem sets: reproducible, resumable, and right."""

import json
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

from gnnjax.arm.robot import load_robot
from gnnjax.collision.certify import configuration_clearance
from gnnjax.errors import InputError
from gnnjax.generate import GenerateConfig, from_problem_set, generate
from gnnjax.problems.problem import load_problems, read_manifest


@pytest.fixture(scope="module")
def labelled(tiny_path, tmp_path_factory):
    """Five labelled problems in shards of two."""
    out = tmp_path_factory.mktemp("sets") / "train"
    config = GenerateConfig(
        robot=str(tiny_path), num_problems=5, num_nodes=24, shard_size=2, out=out
    )
    generate(config)
    return config


def test_the_same_seed_gives_the_same_files_also_after_an_interruption(labelled, tmp_path):
    manifest = read_manifest(labelled.out)
    assert [shard["problems"] for shard in manifest["shards"]] == [2, 2, 1]
    again = GenerateConfig(
        robot=labelled.robot, num_problems=5, num_nodes=24, shard_size=2, out=tmp_path / "again"
    )
    generate(again)
    # As if killed after the first shard, with the second written but not yet entered.
    cut = read_manifest(again.out)
    cut["shards"] = cut["shards"][:1]
    (again.out / "manifest.json").write_text(json.dumps(cut))
    (again.out / "shard_00002.npz").unlink()
    generate(again)
    robot = load_robot(labelled.robot)
    first, second = (load_problems(c.out, robot) for c in (labelled, again))
    np.testing.assert_array_equal(first.problems.start, second.problems.start)
    for name, value in first.extras.items():
        np.testing.assert_array_equal(value, second.extras[name])


def test_a_killed_run_goes_on_where_it_stopped(tiny_path, labelled, tmp_path):
    command = [sys.executable, "-m", "gnnjax.generate", "--robot", str(tiny_path), "--num-nodes"]
    command += ["24", "--num-problems", "4000", "--shard-size", "2", "--out", str(tmp_path / "set")]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) as process:
        manifest = tmp_path / "set" / "manifest.json"
        while not manifest.exists():
            assert process.poll() is None, process.stderr.read()
            time.sleep(0.05)
        process.send_signal(signal.SIGKILL)
    kept = read_manifest(tmp_path / "set")["shards"]
    robot = load_robot(tiny_path)
    survived = load_problems(tmp_path / "set", robot)  # checks every checksum
    assert len(survived) == 2 * len(kept)
    np.testing.assert_array_equal(
        survived.problems.start[:2], load_problems(labelled.out, robot).problems.start[:2]
    )


def test_problems_are_valid_and_labels_exact(labelled):
    robot = load_robot(labelled.robot)
    data = from_problem_set(load_problems(labelled.out, robot))
    for i in range(5):
        nodes = data.roadmap.nodes[i]
        np.testing.assert_array_equal(nodes[0], data.problem.start[i])
        np.testing.assert_array_equal(nodes[1], data.problem.goal[i])
        scene = type(data.problem.scene)(*(x[i] for x in data.problem.scene))
        mask = data.roadmap.node_mask[i]
        assert mask.sum() == 24
        for q in nodes[mask]:
            assert configuration_clearance(robot, scene, q) > 0
        valid = data.labels.edge_valid[i]
        assert not (valid & ~data.roadmap.neighbor_mask[i]).any()
        matrix = np.zeros((len(nodes), len(nodes)))
        for a, k in zip(*np.nonzero(valid), strict=True):
            matrix[a, data.roadmap.neighbors[i, a, k]] = data.roadmap.lengths[i, a, k]
        np.testing.assert_array_equal(matrix, matrix.T)
        expected = dijkstra(csr_matrix(matrix), indices=1)
        np.testing.assert_allclose(data.labels.cost_to_go[i], expected, rtol=1e-5)


def test_splits_and_seeds_differ_and_a_set_can_be_one_file(tiny_path, tmp_path):
    starts = []
    for name, split, seed in (("a", "test", 0), ("b", "validation", 0), ("c", "test", 1)):
        out = tmp_path / f"{name}.npz"
        config = GenerateConfig(
            split=split, robot=str(tiny_path), num_problems=2, num_nodes=0, seed=seed, out=out
        )
        generate(config)
        starts.append(load_problems(out, load_robot(tiny_path)).problems.start)
    assert len({s.tobytes() for s in starts}) == 3
    assert [p.name for p in tmp_path.iterdir() if "parts" in p.name] == []
    with pytest.raises(InputError, match=r"a.npz' exists; remove it"):
        generate(
            GenerateConfig(
                robot=str(tiny_path), num_problems=2, num_nodes=0, out=tmp_path / "a.npz"
            )
        )


def test_problems_without_labels_cannot_be_trained_on(tiny_path, tmp_path):
    generate(
        GenerateConfig(robot=str(tiny_path), num_problems=1, num_nodes=0, out=tmp_path / "p.npz")
    )
    with pytest.raises(InputError, match="lacks the roadmaps or labels"):
        from_problem_set(load_problems(tmp_path / "p.npz", load_robot(tiny_path)))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"num_nodes": 1}, "num_nodes is 1; give 0 for problems alone"),
        ({"num_problems": 0}, "num_problems is 0"),
        ({"seed": 7}, "was generated with seed 0, not 7"),
        ({"num_nodes": 30}, "was generated with settings"),
        # Nothing is left to draw, and still it is not the set that was asked for.
        ({"num_problems": 5, "seed": 7}, "was generated with seed 0, not 7"),
        ({"num_problems": 3}, "holds 5 problems, more than 3"),
        ({"seed": -1}, "seed is -1; choose 0 to"),
    ],
)
def test_bad_settings_are_refused(labelled, change, message):
    settings = {"num_problems": 7, "num_nodes": 24, "shard_size": 2} | change
    with pytest.raises(InputError, match=message):
        generate(GenerateConfig(robot=labelled.robot, out=labelled.out, **settings))
    assert len(load_problems(labelled.out, load_robot(labelled.robot))) == 5


def test_a_folder_of_other_things_is_left_alone(tiny_path, tmp_path):
    (tmp_path / "p.parts").mkdir()
    (tmp_path / "p.parts" / "notes.txt").write_text("kept")
    (tmp_path / "file").write_text("kept")
    for out, message in (
        (tmp_path / "p.npz", r"holds 'notes.txt' and no problem set"),
        (tmp_path / "file", "is a file; name a folder"),
        (tmp_path / "file" / "p.npz", "is a file; name a folder"),
    ):
        with pytest.raises(InputError, match=message):
            generate(GenerateConfig(robot=str(tiny_path), num_problems=1, num_nodes=0, out=out))
    assert (tmp_path / "p.parts" / "notes.txt").read_text() == "kept"
    assert (tmp_path / "file").read_text() == "kept"
