"""Generated problem sets: reproducible, resumable, and right."""

import dataclasses
import json
from pathlib import Path

import jax
import numpy as np
import pytest
from kill_commands import numbered_problems, plain_keys
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import dijkstra

import gnnjax.generate
from gnnjax.arm.robot import load_robot
from gnnjax.collision.clearances import configuration_clearance
from gnnjax.errors import InputError
from gnnjax.generate import GenerateConfig, generate
from gnnjax.problems.labelled import from_problem_set
from gnnjax.problems.shards import load_problems, read_manifest


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
    files = {path.name: path.read_bytes() for path in labelled.out.iterdir()}
    assert {path.name: path.read_bytes() for path in again.out.iterdir()} == files


def test_problems_are_valid_and_labels_exact(labelled):
    robot = load_robot(labelled.robot)
    data = from_problem_set(load_problems(labelled.out, robot))
    for i in range(5):
        nodes = data.roadmap.nodes[i]
        np.testing.assert_array_equal(nodes[0], data.problem.start[i])
        np.testing.assert_array_equal(nodes[1], data.problem.goal[i])
        scene = jax.tree.map(lambda x, i=i: x[i], data.problem.scene)
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
        ({"seed": -1}, "seed is -1; choose an integer from 0 to"),
    ],
)
def test_bad_settings_are_refused(labelled, change, message):
    settings = {"num_problems": 7, "num_nodes": 24, "shard_size": 2} | change
    with pytest.raises(InputError, match=message):
        generate(GenerateConfig(robot=labelled.robot, out=labelled.out, **settings))
    assert len(load_problems(labelled.out, load_robot(labelled.robot))) == 5


def test_a_set_of_an_arm_that_was_edited_since_is_not_gone_on_with(labelled, tmp_path):
    edited = tmp_path / "tiny.xml"
    edited.write_text(Path(labelled.robot).read_text().replace('range="-2 2"', 'range="-2 2.1"'))
    with pytest.raises(InputError, match=r"was generated with settings \['robot_sha256'\]"):
        generate(dataclasses.replace(labelled, robot=str(edited), num_problems=7))


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


@pytest.fixture
def cheap(monkeypatch, tiny_path):
    """Makes `out -> GenerateConfig` of five problems that cost nothing, in shards of two."""
    monkeypatch.setattr(gnnjax.generate, "generate_labelled", lambda *args: numbered_problems)
    monkeypatch.setattr(gnnjax.generate, "problem_keys", plain_keys)
    settings = {"robot": str(tiny_path), "num_problems": 5, "num_nodes": 0, "shard_size": 2}
    return lambda out, **changes: GenerateConfig(out=out, **{**settings, **changes})


def numbers(path, tiny_path):
    """Which problems a set holds."""
    return np.round(100 * load_problems(path, load_robot(tiny_path)).problems.start[:, 0]).tolist()


def test_labels_are_those_of_the_checker_that_is_asked_for(cheap, tmp_path, monkeypatch):
    asked = []

    def noted(robot, num_nodes, checker, family):
        asked.append(checker)
        return numbered_problems

    monkeypatch.setattr(gnnjax.generate, "generate_labelled", noted)
    generate(cheap(tmp_path / "mjx", checker="mjx"))
    generate(cheap(tmp_path / "fused"))
    assert asked == ["mjx", "fused"]


@pytest.mark.parametrize("name", ["set.npz", "set"])
def test_of_two_generators_of_one_set_the_second_is_refused(
    cheap, tiny_path, tmp_path, monkeypatch, name
):
    out, refusals = tmp_path / name, []

    def interrupted_by_another(keys):
        if keys[0] == 2:  # one shard is there
            with pytest.raises(InputError) as error:
                generate(cheap(out))
            refusals.append(str(error.value))
        return numbered_problems(keys)

    monkeypatch.setattr(gnnjax.generate, "generate_labelled", lambda *args: interrupted_by_another)
    generate(cheap(out))
    assert numbers(out, tiny_path) == [0, 1, 2, 3, 4]
    (refusal,) = refusals
    assert "is being written by process" in refusal
    assert [path.name for path in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize(
    "damage",
    [
        lambda shard: shard.unlink(),
        lambda shard: shard.write_bytes(shard.read_bytes()[:-50]),
        lambda shard: shard.write_bytes(b""),
    ],
)
def test_a_shard_that_was_lost_or_cut_is_made_again(cheap, tiny_path, tmp_path, damage):
    out = tmp_path / "set"
    generate(cheap(out))
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    damage(out / "shard_00001.npz")
    generate(cheap(out))
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before
    assert numbers(out, tiny_path) == [0, 1, 2, 3, 4]


def test_a_run_killed_at_its_first_manifest_goes_on(cheap, tiny_path, tmp_path):
    out = tmp_path / "set"
    generate(cheap(tmp_path / "whole"))
    out.mkdir()
    for name in ("shard_00000.npz", ".manifest.json.lock", ".manifest.part-abcdefgh.json"):
        (out / name).write_bytes(b"half")
    generate(cheap(out))
    names = {path.name for path in (tmp_path / "whole").iterdir()}
    assert {path.name for path in out.iterdir()} == names
    assert numbers(out, tiny_path) == [0, 1, 2, 3, 4]


@pytest.mark.parametrize("removed", [0, 1, 3])
def test_a_run_killed_after_its_last_rename_takes_its_parts_away(
    cheap, tiny_path, tmp_path, monkeypatch, removed
):
    out = tmp_path / "set.npz"
    monkeypatch.setattr(gnnjax.generate, "_remove_parts", lambda folder: None)
    generate(cheap(out))
    monkeypatch.undo()
    for index in range(removed):
        (tmp_path / "set.parts" / f"shard_{index:05d}.npz").unlink()
    generate(cheap(out))
    assert [path.name for path in tmp_path.iterdir()] == ["set.npz"]
    assert numbers(out, tiny_path) == [0, 1, 2, 3, 4]


def test_a_file_that_is_done_is_done(cheap, tmp_path, capsys):
    out = tmp_path / "set.npz"
    generate(cheap(out))
    before = out.stat().st_mtime_ns
    generate(cheap(out))
    assert out.stat().st_mtime_ns == before
    assert capsys.readouterr().out.count("5 problems in") == 2
    for change in ({"seed": 1}, {"num_problems": 4}, {"num_nodes": 20}):
        with pytest.raises(InputError, match=r"set.npz' exists; remove it"):
            generate(cheap(out, **change))
    assert out.stat().st_mtime_ns == before
