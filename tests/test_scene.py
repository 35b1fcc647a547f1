"""Scenes: what is refused, padding, files written by hand, and the paper's distribution."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import gnnjax.scene.scene_file
from gnnjax.errors import InputError
from gnnjax.problems.problem import sample_scene
from gnnjax.scene.batches import stack_scenes
from gnnjax.scene.numbers import rotation_of
from gnnjax.scene.scene import (
    OBSTACLE_BUCKETS,
    Scene,
    is_axis_aligned,
    make_scene,
    obstacle_bucket,
    pad_scene,
    rotation_matrices,
)
from gnnjax.scene.scene_file import scene_from_json, scene_to_json
from gnnjax.scene.shapes import z_axis

BOX = {"center": [0.5, 0.0, 0.7], "half_extents": [0.1, 0.3, 0.2]}


def random_scene(num: int = 3) -> Scene:
    rng = np.random.default_rng(0)
    quats = Rotation.random(num, rng=rng).as_quat(scalar_first=True)
    return make_scene(rng.normal(size=(num, 3)), rng.uniform(0.1, 0.3, (num, 3)), quats)


def written(tmp_path, text: str):
    path = tmp_path / "scene.json"
    path.write_text(text, encoding="utf-8")
    return path


def test_boxes_come_first_and_padding_is_masked_but_has_a_size():
    scene = make_scene([[0, 0, 1], [1, 0, 1]], [[0.1, 0.2, 0.3]] * 2)
    assert scene.centers.shape == scene.half_extents.shape == (OBSTACLE_BUCKETS[0], 3)
    np.testing.assert_array_equal(scene.mask, np.arange(OBSTACLE_BUCKETS[0]) < 2)
    assert (scene.half_extents > 0).all()
    np.testing.assert_allclose(np.linalg.norm(scene.quats, axis=1), 1)
    assert all(x.dtype == np.float32 for x in scene[:3])


def test_a_scene_may_be_empty():
    scene = make_scene([], [])
    assert not scene.mask.any()
    assert is_axis_aligned(scene)


def test_quaternions_are_normalized():
    scene = make_scene([[0, 0, 1]], [[0.1] * 3], [[3.0, 0.0, 0.0, 4.0]])
    np.testing.assert_allclose(scene.quats[0], [0.6, 0, 0, 0.8], rtol=1e-6)


@pytest.mark.parametrize("size", [1e20, 1e200, 1e-2])
def test_a_quaternion_keeps_its_rotation_however_long_it_is(size):
    scene = make_scene([[0, 0, 1]], [[0.1] * 3], [[0.6 * size, 0.0, 0.0, 0.8 * size]])
    np.testing.assert_allclose(scene.quats[0], [0.6, 0, 0, 0.8], rtol=1e-6)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([[1e5, 0, 0]], [[1, 1, 1]]), r"box 0 .* centers \[100000.0, .* below 10000 m"),
        (([[1, 0, 0]], [[1, 1e30, 1]]), r"half_extents .* below 10000 m"),
        (([[1, 2]], [[1, 1, 1]]), r"centers of the scene have shape \(1, 2\)"),
        (([1, 2, 3], [1, 1, 1]), r"centers of the scene have shape \(3,\)"),
        (("abc", [[1, 1, 1]]), "centers of the scene are not numbers"),
        (([[1, 2, 3]], [[1, 1, 1]] * 2), "1 centers, 2 half_extents"),
        (([[1, np.inf, 3]], [[1, 1, 1]]), r"box 0 .* centers \[1.0, inf, 3.0\]"),
        (([[1, 1e39, 3]], [[1, 1, 1]]), "must be finite"),  # too large for float32
        (([[1, 2, 3]] * 2, [[1, 1, 1], [1, 0, 1]]), r"box 1 .* \[1.0, 0.0, 1.0\].* positive"),
        (([[1, 2, 3]], [[1, 1, -1]]), "must be positive"),
        (([[1, 2, 3]], [[1, 1, 1]], [[0, 0, 0, 0]]), "not zeros"),
        (([[1, 2, 3]], [[1, 1, 1]], [[1, 0, 0, np.nan]]), "must be finite"),
        (([[1, 2, 3]], [[1, 1, 1]], [[1, 0, 0]]), "give 4 numbers a box"),
        (([[1, 2, 3]] * 129, [[1, 1, 1]] * 129), "has 129 obstacles; at most 128"),
    ],
)
def test_bad_boxes_are_named(arguments, message):
    with pytest.raises(InputError, match=message):
        make_scene(*arguments)


@pytest.mark.parametrize(
    ("num", "bucket"), [(0, 10), (9, 10), (10, 10), (11, 16), (17, 32), (64, 64)]
)
def test_a_bucket_is_the_smallest_that_fits(num, bucket):
    assert obstacle_bucket(num) == bucket


def test_padding_keeps_the_boxes_of_a_batch():
    batch = jax.tree.map(lambda x: np.stack([x, x]), random_scene())
    padded = pad_scene(batch, 16)
    assert padded.mask.shape == (2, 16)
    for old, new in zip(*map(jax.tree.leaves, (batch, padded)), strict=True):
        np.testing.assert_array_equal(new[:, :10], old)
    assert not padded.mask[:, 10:].any()
    with pytest.raises(InputError, match="room for 10 obstacles, more than 4"):
        pad_scene(batch, 4)
    with pytest.raises(InputError, match="there are no scenes to stack"):
        stack_scenes([])


def test_rotation_matrices_agree_with_scipy():
    quats = Rotation.random(50, rng=np.random.default_rng(1)).as_quat(scalar_first=True)
    expected = Rotation.from_quat(quats, scalar_first=True).as_matrix()
    np.testing.assert_allclose(rotation_matrices(jnp.asarray(quats)), expected, atol=1e-6)
    np.testing.assert_allclose(z_axis(quats), expected[..., 2], atol=1e-12)
    np.testing.assert_allclose(rotation_of(3 * quats[0], "it"), expected[0], atol=1e-12)


def test_half_a_milliradian_is_a_rotation_and_a_missing_box_has_none():
    angle = 5e-4
    quat = [np.cos(angle / 2), np.sin(angle / 2), 0, 0]
    scene = make_scene([[0, 0, 1]] * 2, [[0.1] * 3] * 2, [[-1, 0, 0, 0], quat])
    assert not is_axis_aligned(scene)
    assert is_axis_aligned(scene._replace(mask=np.arange(10) < 1))


def test_a_scene_file_gives_back_what_was_written(tmp_path):
    scene = random_scene()
    scene_to_json(scene, tmp_path / "scene.json")
    again = scene_from_json(tmp_path / "scene.json")
    jax.tree.map(lambda old, new: np.testing.assert_allclose(new, old, atol=1e-7), scene, again)


def test_a_box_in_a_file_needs_no_quaternion(tmp_path):
    scene = scene_from_json(written(tmp_path, json.dumps({"boxes": [BOX]})))
    np.testing.assert_array_equal(scene.quats[0], [1, 0, 0, 0])
    assert scene.mask.sum() == 1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"center": [1, 2]}, r"box 1 .* center = \[1, 2\]; give a list of 3 numbers"),
        ({"center": [1, 2, None]}, "give a list of 3 numbers"),
        ({"center": [1, 2, "3"]}, "give a list of 3 numbers"),
        ({"center": [1, 2, True]}, "give a list of 3 numbers"),
        ({"center": [1, 2, float("nan")]}, r"box 1 .* \[1.0, 2.0, nan\]"),
        ({"center": [10**400, 0, 0]}, "not numbers"),
        ({"half_extents": None}, "half_extents = None"),
        ({"half_extents": [1, -2, 1]}, "must be positive"),
        ({"quat": [0, 0, 0, 0]}, "not zeros"),
        ({"quat": [1, 0, 0]}, "give a list of 4 numbers"),
        ({"quaternion": [1, 0, 0, 0]}, "quaternion.*if rotated, quat"),
    ],
)
def test_a_bad_box_in_a_file_is_named_in_one_line(tmp_path, change, message):
    path = written(tmp_path, json.dumps({"boxes": [BOX, {**BOX, **change}]}))
    with pytest.raises(InputError, match=message) as error:
        scene_from_json(path)
    assert "scene.json" in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("text", ["", "{", "[" * 100_000, "[]", "{}", '{"boxes": 3}'])
def test_a_file_that_holds_no_scene_is_an_input_error(tmp_path, text):
    with pytest.raises(InputError, match=r"scene\.json"):
        scene_from_json(written(tmp_path, text))


@pytest.mark.parametrize("further", ["cones", "mesh", "Boxes", "cylinder", "comment", "frame"])
def test_what_a_scene_file_holds_beside_obstacles_is_refused_and_named(tmp_path, further):
    path = written(tmp_path, json.dumps({"boxes": [BOX], further: []}))
    with pytest.raises(
        InputError, match=rf"scene\.json' has \['{further}'\], and there are only \['boxes'"
    ):
        scene_from_json(path)
    with pytest.raises(InputError, match=r"'clouds', 'meshes', 'height_fields', 'octomaps', 'al"):
        scene_from_json(path)


@pytest.mark.parametrize(
    ("text", "name"),
    [
        ('{"boxes": [{"center": [0.5, 0, 0.7], "half_extents": [1, 1, 1]}], "boxes": []}', "boxes"),
        (
            '{"boxes": [{"center": [1, 0, 0], "half_extents": [1, 1, 1], "center": [9, 0, 0]}]}',
            "center",
        ),
    ],
)
def test_what_comes_twice_in_a_scene_file_is_refused(tmp_path, text, name):
    with pytest.raises(InputError, match=f"'{name}' comes twice in one object"):
        scene_from_json(written(tmp_path, text))


def test_a_missing_file_and_too_many_boxes_are_input_errors(tmp_path):
    with pytest.raises(InputError, match="no scene file"):
        scene_from_json(tmp_path / "none.json")
    with pytest.raises(InputError, match=r"scene\.json' has 129 obstacles"):
        scene_from_json(written(tmp_path, json.dumps({"boxes": [BOX] * 129})))


def half_space_is_clear(scene: Scene):
    return scene.centers[:, 0] > 0.0


def test_a_folder_is_no_scene_file(tmp_path):
    with pytest.raises(InputError, match="is a folder; name a file"):
        scene_from_json(tmp_path)


def test_very_many_boxes_are_refused_before_each_is_looked_at(tmp_path, monkeypatch):
    text = "{}," * 49_999 + "{}"
    (tmp_path / "scene.json").write_text(f'{{"boxes": [{text}]}}')
    looked_at = []
    monkeypatch.setattr(gnnjax.scene.scene_file, "_checked", lambda *args: looked_at.append(args))
    with pytest.raises(InputError, match=r"has 50000 obstacles; at most 128 are supported"):
        scene_from_json(tmp_path / "scene.json")
    assert not looked_at


def test_a_value_of_a_megabyte_is_not_repeated(tmp_path):
    box = {**BOX, "quat": [1] * 300_000}
    (tmp_path / "scene.json").write_text(json.dumps({"boxes": [box]}))
    with pytest.raises(InputError, match=r"box 0 of .* give a list of 4 numbers") as error:
        scene_from_json(tmp_path / "scene.json")
    assert len(str(error.value)) < 300


def test_sampled_scenes_follow_the_paper_and_stay_clear_of_the_arm():
    keys = jax.random.split(jax.random.key(0), 2000)
    scenes = jax.jit(jax.vmap(lambda key: sample_scene(key, half_space_is_clear)))(keys)
    num = np.asarray(scenes.mask.sum(axis=1))
    # Eight draws all on the wrong side are one box in 256, so a few scenes have a box less.
    assert set(num) <= set(range(1, 10))
    shares = np.bincount(num, minlength=10)[2:] / len(num)
    np.testing.assert_allclose(shares, 1 / 8, atol=0.03)
    centers, half_extents = (np.asarray(x)[np.asarray(scenes.mask)] for x in scenes[:2])
    lower, upper = np.array([0, -1, 0.5]), np.array([1, 1, 1.3])
    assert ((centers >= lower) & (centers <= upper)).all()
    np.testing.assert_allclose(centers.mean(axis=0), (lower + upper) / 2, atol=0.02)
    assert ((half_extents >= 0.1) & (half_extents <= 0.3)).all()
    np.testing.assert_allclose(half_extents.mean(axis=0), 0.2, atol=0.003)
    assert is_axis_aligned(scenes)


def test_a_key_gives_the_same_scene_jitted_or_not():
    key = jax.random.key(3)
    eager = sample_scene(key, half_space_is_clear)
    jitted = jax.jit(lambda key: sample_scene(key, half_space_is_clear))(key)
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, atol=1e-6), eager, jitted)


def test_a_box_that_never_comes_clear_is_left_out():
    scene = sample_scene(jax.random.key(0), lambda scene: jnp.zeros(scene.mask.shape, bool))
    assert not scene.mask.any()
