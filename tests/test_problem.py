"""Problem sets: what is written is read, and what is damaged is named."""

import functools
import json
import zipfile

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gnnjax.arm.robot import load_robot
from gnnjax.errors import InputError
from gnnjax.problems.file import save_problems
from gnnjax.problems.problem import Problem, ProblemSet, draw_problem, sample_problem
from gnnjax.problems.shards import MANIFEST, load_problems, read_manifest, save_shard
from gnnjax.scene.scene import box_scene


@pytest.fixture(scope="module")
def robot(tiny_path):
    return load_robot(tiny_path)


def random_set(num: int = 6, size: int = 10, seed: int = 0) -> ProblemSet:
    """Problems whose boxes lie anywhere among the slots, not first."""
    rng = np.random.default_rng(seed)
    quats = rng.normal(size=(num, size, 4))
    scene = box_scene(
        rng.normal(size=(num, size, 3)).astype(np.float32),
        rng.uniform(0.1, 0.3, (num, size, 3)).astype(np.float32),
        (quats / np.linalg.norm(quats, axis=-1, keepdims=True)).astype(np.float32),
        rng.random((num, size)) < 0.5,
    )
    ends = rng.uniform(-1, 1, (2, num, 3)).astype(np.float32)
    extras = {"index": np.arange(num), "source": np.array("random")}
    return ProblemSet("tiny", Problem(*ends, scene), extras)


def arrays_of(path) -> dict[str, np.ndarray]:
    with np.load(path, allow_pickle=False) as file:
        return {name: file[name] for name in file.files}


def assert_same_problems(one: ProblemSet, other: ProblemSet):
    assert one.robot == other.robot
    np.testing.assert_array_equal(one.problems.start, other.problems.start)
    np.testing.assert_array_equal(one.problems.goal, other.problems.goal)
    for row in range(len(one)):
        for a, b in zip(one.problems.scene[:3], other.problems.scene[:3], strict=True):
            boxes = a[row][one.problems.scene.mask[row]], b[row][other.problems.scene.mask[row]]
            np.testing.assert_allclose(*boxes, atol=1e-6)
    assert one.extras.keys() == other.extras.keys()
    for name, value in one.extras.items():
        np.testing.assert_array_equal(value, other.extras[name])


@pytest.mark.parametrize("size", [1, 10, 13])
def test_a_problem_file_gives_back_what_was_written(tmp_path, robot, size):
    saved = random_set(size=size)
    save_problems(tmp_path / "set.npz", saved)
    loaded = load_problems(tmp_path / "set.npz", robot)
    assert_same_problems(saved, loaded)
    assert loaded.problems.scene.mask.shape[1] in (10, 16)
    assert (loaded.problems.scene.half_extents > 0).all()


def test_taking_problems_cuts_the_extras_that_have_one_row_a_problem():
    problem_set = random_set()
    few = problem_set.take(slice(2))
    assert len(few) == len(few.problems.scene.mask) == len(few.extras["index"]) == 2
    assert few.extras["source"] == "random"
    chosen = problem_set.take(np.array([4, 1]))
    np.testing.assert_array_equal(chosen.extras["index"], [4, 1])
    np.testing.assert_array_equal(chosen.problems.goal, problem_set.problems.goal[[4, 1]])


def test_objects_are_never_pickled(tmp_path):
    problem_set = random_set()
    problem_set.extras["notes"] = np.array([{}, []], dtype=object)
    with pytest.raises(InputError, match="'notes' holds Python objects"):
        save_problems(tmp_path / "set.npz", problem_set)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["start", "goal", "robot", "format", "file"])
def test_an_extra_whose_name_is_taken_is_not_written(tmp_path, name):
    problem_set = random_set()
    problem_set.extras[name] = np.zeros(6)
    with pytest.raises(InputError, match=f"extra is called '{name}', a name that is taken"):
        save_problems(tmp_path / "set.npz", problem_set)
    assert not (tmp_path / "set.npz").exists()


@pytest.mark.parametrize(
    ("extras", "message"),
    [
        ({7: np.zeros(6)}, "an extra is called 7; give it a name"),
        ({"a\0b": np.zeros(6)}, "an extra is called .*; give it a name"),
        ({"ragged": [[1], [2, 3]]}, "extra 'ragged' is no array"),
    ],
)
def test_extras_that_would_not_come_back_are_not_written(tmp_path, extras, message):
    bad = object.__new__(ProblemSet)  # whose types nobody checks, as outside of tests
    for name, value in (vars(random_set()) | {"extras": extras}).items():
        object.__setattr__(bad, name, value)
    with pytest.raises(InputError, match=message):
        save_problems(tmp_path / "set.npz", bad)
    assert not list(tmp_path.iterdir())


def test_no_problems_are_not_written(tmp_path):
    with pytest.raises(InputError, match="holds no problems"):
        save_problems(tmp_path / "set.npz", random_set().take(slice(0, 0)))


def test_what_is_no_problem_set_is_not_written(tmp_path, robot):
    good = random_set()
    start, goal, scene = good.problems
    lost = start.copy()
    lost[2, 1] = np.nan
    vast = start.astype(float)
    vast[3, 0] = 1e300
    bad = object.__new__(ProblemSet)  # whose types nobody checks, as outside of tests
    for changes, message in (
        ({"robot": robot}, "has a Robot and a Problem; give the arm's name"),
        ({"problems": Problem(start, goal, [scene])}, r"of its scenes \(\); they are"),
        ({"problems": Problem(start[:5], goal[:5], scene)}, r"scenes \(6, 10\); they are"),
        ({"problems": Problem(start, lost, scene)}, r"goal of problem 2 is .*must be finite"),
        ({"problems": Problem([[0.0], [0.0, 1.0]], goal, scene)}, "are no numbers"),
        ({"problems": Problem(vast, goal, scene)}, r"start of problem 3 is .*must be finite"),
    ):
        for name, value in ({"extras": {}} | vars(good) | changes).items():
            object.__setattr__(bad, name, value)
        with pytest.raises(InputError, match=message):
            save_problems(tmp_path / "set.npz", bad)


def test_anything_on_padding_is_harmless(tmp_path, robot):
    save_problems(tmp_path / "set.npz", random_set())
    arrays = arrays_of(tmp_path / "set.npz")
    padding = np.arange(10) >= arrays["num_boxes"][:, None]
    for name in ("box_centers", "box_half_extents", "box_quats"):
        arrays[name][padding] = np.nan
    np.savez(tmp_path / "nan.npz", **arrays)
    loaded = load_problems(tmp_path / "nan.npz", robot)
    assert all(np.isfinite(x).all() for x in loaded.problems.scene[:3])
    assert_same_problems(load_problems(tmp_path / "set.npz", robot), loaded)


@pytest.mark.parametrize(
    "name",
    [
        "cone_centers",
        "num_cones",
        "box_radii",
        "sphere_quats",
        "cylinder_half_extents",
        "meshes",
        "blob_quats",
        "Obstacles",
        "half_spaces",
        "height_fields",
        "cuboids",
        "cuboid_dims",
        "blocks",
        "balls",
        "obb",
        "pillars",
        "aabb-2",
    ],
)
def test_an_array_that_names_obstacles_is_refused_read_or_written(tmp_path, robot, name):
    problem_set = random_set()
    save_problems(tmp_path / "set.npz", problem_set)
    np.savez(tmp_path / "more.npz", **arrays_of(tmp_path / "set.npz"), **{name: np.zeros((6, 2))})
    with pytest.raises(InputError, match=f"array '{name}', which names obstacles"):
        load_problems(tmp_path / "more.npz", robot)
    problem_set.extras[name] = np.zeros((6, 2))
    with pytest.raises(InputError, match=f"array '{name}', which names obstacles"):
        save_problems(tmp_path / "other.npz", problem_set)


def test_further_arrays_are_kept(tmp_path, robot):
    problem_set = random_set()
    problem_set.extras["ground_truth_cost"] = np.arange(6.0)
    save_problems(tmp_path / "set.npz", problem_set)
    found = load_problems(tmp_path / "set.npz", robot).extras
    np.testing.assert_array_equal(found["ground_truth_cost"], np.arange(6.0))


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_an_array_that_comes_twice_is_refused(tmp_path, robot):
    save_problems(tmp_path / "set.npz", random_set())
    with zipfile.ZipFile(tmp_path / "set.npz", "a") as archive:
        archive.writestr("num_boxes.npy", archive.read("num_boxes.npy"))
    with pytest.raises(InputError, match=r"array 'num_boxes' of .*: it is there twice"):
        load_problems(tmp_path / "set.npz", robot)


def test_a_long_quaternion_keeps_its_rotation(tmp_path, robot):
    save_problems(tmp_path / "set.npz", random_set())
    arrays = arrays_of(tmp_path / "set.npz")
    arrays["box_quats"] *= np.float32(1e20)
    np.savez(tmp_path / "long.npz", **arrays)
    assert_same_problems(
        load_problems(tmp_path / "set.npz", robot), load_problems(tmp_path / "long.npz", robot)
    )


def changed(name: str, change):
    def apply(arrays):
        arrays[name] = change(arrays[name].copy())

    return apply


def put(value, *where):
    def change(array):
        array[where] = value
        return array

    return change


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda arrays: arrays.pop("goal"), r"lacks \['goal'\]"),
        (changed("robot", lambda _: np.array("panda")), "for robot 'panda', not 'tiny'"),
        (changed("start", lambda x: x[:, :2]), r"start .* shape \(6, 2\), not \(6, 3\)"),
        (changed("goal", lambda x: x[:4]), r"goal .* shape \(4, 3\), not \(6, 3\)"),
        (changed("start", lambda x: x[0, 0]), r"start .* shape \(\)"),
        (changed("box_quats", lambda x: x[..., :3]), "box_quats .* shape"),
        (changed("start", lambda x: x.astype(complex)), "start .* complex128, not real"),
        (changed("goal", lambda x: x.astype(str)), "goal .* not real numbers"),
        (changed("start", lambda x: x.astype(object)), "array 'start' of .* cannot be read"),
        (changed("goal", lambda x: x.astype(float) * 1e200), "goal .* must be finite"),
        (changed("start", put(np.nan, 2, 1)), r"start of problem 2 in .* nan"),
        (changed("num_boxes", lambda x: x + 0.5), "num_boxes .* not integers"),
        (changed("num_boxes", lambda x: -x - 1), "num_boxes .* goes from -"),
        (changed("num_boxes", lambda x: x + 10), "room for 0 to 10 boxes"),
        (changed("box_centers", put(np.inf, 1, 0)), r"problem 1 \(box 0\)"),
        (changed("box_half_extents", put(0, 1, 0, 2)), "must be positive"),
        (changed("box_quats", put(0, 1, 0)), "must be a rotation"),
        (changed("box_centers", put(2e4, 1, 0)), "must be below 10000 m"),
        (changed("box_half_extents", put(2e4, 1, 0)), "must be below 10000 m"),
        (changed("format", lambda x: x + 1), "has format 3, this one reads format 2; generate it"),
    ],
)
def test_wrong_arrays_are_named_with_their_file(tmp_path, robot, damage, message):
    save_problems(tmp_path / "set.npz", random_set())
    arrays = arrays_of(tmp_path / "set.npz")
    damage(arrays)
    np.savez(tmp_path / "bad.npz", **arrays)
    with pytest.raises(InputError, match=message) as error:
        load_problems(tmp_path / "bad.npz", robot)
    assert "bad.npz" in str(error.value)
    assert "\n" not in str(error.value)


def test_damaged_files_are_refused_or_harmless(tmp_path, robot):
    save_problems(tmp_path / "set.npz", random_set())
    whole, rng = (tmp_path / "set.npz").read_bytes(), np.random.default_rng(0)
    bad = tmp_path / "bad.npz"
    for length in range(0, len(whole), 97):
        bad.write_bytes(whole[:length])
        with pytest.raises(InputError, match=r"bad\.npz"):
            load_problems(bad, robot)
    refused = 0
    for _ in range(150):
        data = bytearray(whole)
        data[rng.integers(len(data))] ^= int(rng.integers(1, 256))
        bad.write_bytes(data)
        try:  # a changed date in the archive does no harm
            assert len(load_problems(bad, robot)) == 6
        except InputError:
            refused += 1
    assert refused > 100


def header(shape: str) -> bytes:
    text = f"{{'descr': '<f4', 'fortran_order': False, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY\x01\0" + len(text).to_bytes(2, "little") + text + b"\0" * 84


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"text", "array 'start' of .* cannot be read"),
        (header("(1099511627776, 7)"), "promises 30786325577728 bytes, and there are 84; generate"),
        (header("(-3, -7)"), "cannot be read"),
        (header("(" * 9000), "cannot be read"),
        (b"\x93NUMPY\x01\0\x10\0" + b"(" * 16, "cannot be read"),
    ],
)
def test_what_is_no_array_is_named_as_a_broken_file(tmp_path, robot, data, message):
    save_problems(tmp_path / "set.npz", random_set())
    with zipfile.ZipFile(tmp_path / "set.npz") as archive:
        entries = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(tmp_path / "bad.npz", "w") as archive:
        for name, value in {**entries, "start.npy": data}.items():
            archive.writestr(name, value)
    with pytest.raises(InputError, match=message):
        load_problems(tmp_path / "bad.npz", robot)


def test_other_files_are_input_errors(tmp_path, robot):
    np.save(tmp_path / "bad.npy", np.zeros(3))
    (tmp_path / "bad.txt").write_text("hello")
    for name in ("bad.npy", "bad.txt"):
        with pytest.raises(InputError, match="cannot be read as a problem set"):
            load_problems(tmp_path / name, robot)
    with pytest.raises(InputError, match="no problem file"):
        load_problems(tmp_path / "none.npz", robot)


def save_two_shards(folder):
    settings = {"num_problems": 6, "ranges": (0.1, 0.3)}
    save_shard(folder, 1, random_set(4, 13, seed=1), seed=7, settings=settings)
    save_shard(folder, 0, random_set(6, 10, seed=2), seed=7, settings=settings)
    return settings


def test_shards_are_read_in_their_order_as_one_set(tmp_path, robot):
    settings = save_two_shards(tmp_path / "set")
    loaded = load_problems(tmp_path / "set", robot)
    assert len(loaded) == 10
    assert_same_problems(loaded.take(slice(6)), random_set(6, 10, seed=2))
    assert_same_problems(loaded.take(slice(6, 10)), random_set(4, 13, seed=1))
    manifest = read_manifest(tmp_path / "set")
    assert manifest["seed"] == 7
    assert manifest["settings"] == {**settings, "ranges": [0.1, 0.3]}
    assert [shard["problems"] for shard in manifest["shards"]] == [6, 4]


def test_numbers_of_numpy_are_settings_too(tmp_path):
    settings = {"num_nodes": np.int64(3), "share": np.float32(0.5)}
    save_shard(tmp_path, 0, random_set(), seed=7, settings=settings)
    manifest = read_manifest(tmp_path)
    assert manifest["seed"] == 7
    assert manifest["settings"] == {"num_nodes": 3, "share": 0.5}
    save_shard(tmp_path, 1, random_set(), seed=7, settings=manifest["settings"])


def test_a_shard_written_again_replaces_the_first(tmp_path, robot):
    settings = save_two_shards(tmp_path)
    save_shard(tmp_path, 1, random_set(2, seed=3), seed=7, settings=settings)
    assert len(load_problems(tmp_path, robot)) == 8


def test_a_folder_takes_shards_of_one_origin_only(tmp_path):
    settings = save_two_shards(tmp_path)
    with pytest.raises(InputError, match="generated with seed 7, not 8"):
        save_shard(tmp_path, 2, random_set(), seed=8, settings=settings)
    with pytest.raises(InputError, match="generated with settings"):
        save_shard(tmp_path, 2, random_set(), seed=7, settings={})
    assert not (tmp_path / "shard_00002.npz").exists()


def test_a_shard_that_changed_or_vanished_is_refused(tmp_path, robot):
    save_two_shards(tmp_path)
    save_problems(tmp_path / "shard_00001.npz", random_set(4, seed=9))
    with pytest.raises(InputError, match=r"shard_00001\.npz.* SHA-256 differs"):
        load_problems(tmp_path, robot)
    (tmp_path / "shard_00001.npz").unlink()
    with pytest.raises(InputError, match=r"shard_00001\.npz.* missing"):
        load_problems(tmp_path, robot)


@pytest.mark.parametrize(
    "text",
    [
        "{",
        "[]",
        '{"shards": []}',
        '{"shards": [{"file": "a.npz"}]}',
        json.dumps({"shards": [{"file": "../a.npz", "sha256": ""}]}),
        "[" * 100_000 + "]" * 100_000,
        *(
            json.dumps({"shards": [{"file": name, "problems": 1, "sha256": ""}]})
            for name in ("a" * 400, "", ".", "..", "a\0b", "\ud800")
        ),
    ],
)
def test_a_broken_manifest_is_an_input_error(tmp_path, robot, text):
    (tmp_path / MANIFEST).write_text(text)
    with pytest.raises(InputError, match=r"manifest\.json") as error:
        load_problems(tmp_path, robot)
    assert len(str(error.value)) < 300


def test_a_folder_without_manifest_is_an_input_error(tmp_path, robot):
    with pytest.raises(InputError, match=r"has no manifest\.json"):
        load_problems(tmp_path, robot)


def test_sampled_problems_have_the_ends_and_boxes_that_the_checks_admit(robot):
    def check(scene, q):
        return q[:, 0] * scene.centers[0, 0] > 0.0  # half of the configurations, by the scene

    def clear(scene):
        return scene.centers[:, 1] > 0.0

    keys = jax.random.split(jax.random.key(0), 64)
    problems = jax.jit(jax.vmap(lambda key: sample_problem(key, robot, check, clear)))(keys)
    start, goal, scene = problems
    assert jax.vmap(check)(scene, jnp.stack([start, goal], axis=1)).all()
    assert (jax.vmap(clear)(scene) | ~scene.mask).all()
    for ends in (start, goal):
        assert ((ends >= robot.joint_lower) & (ends <= robot.joint_upper)).all()
        assert len(np.unique(ends, axis=0)) == 64
    assert (start != goal).any(axis=1).all()


def test_an_end_that_is_not_found_is_within_limits_and_told(robot):
    key, upright = jax.random.key(0), np.clip(0, robot.joint_lower, robot.joint_upper)

    def clear(scene):
        return jnp.ones(scene.mask.shape, bool)

    for share in (0.0, 1.0):  # of the draws that are free
        draw = functools.partial(draw_problem, key, robot, obstacles_clear=clear)
        problem, found = draw(
            check_configurations=lambda scene, q, s=share: jnp.full(len(q), s > 0)
        )
        assert found.tolist() == 2 * [share > 0]
        assert np.array_equal(problem.goal, upright) == (share == 0)
