"""Every consumer of obstacles has an entry for every kind, or cannot be imported."""

import importlib
import inspect
import re
from pathlib import Path

import mujoco
import numpy as np
import pytest

from gnnjax.errors import InputError
from gnnjax.plot import _obstacle_faces
from gnnjax.problems.file import save_problems
from gnnjax.problems.problem import Problem, ProblemSet
from gnnjax.scene import shapes
from gnnjax.scene.batches import stack_scenes
from gnnjax.scene.cloud import Balls
from gnnjax.scene.mujoco_world import build_world, place_obstacles
from gnnjax.scene.numbers import check_shapes
from gnnjax.scene.scene import inflated, obstacle_name, scene_from_shapes
from gnnjax.scene.scene_file import scene_from_json, scene_to_json
from gnnjax.scene.shapes import (
    KINDS,
    TABLES,
    Shape,
    box,
    capsule,
    cylinder,
    for_every_kind,
    half_space,
    sphere,
)
from gnnjax.viewer.answers import Query
from gnnjax.viewer.session import Session

# Whatever meets obstacles; a new one belongs here.
CONSUMERS = {
    "scene file": "gnnjax.scene.scene_file",
    "MuJoCo world": "gnnjax.scene.mujoco_world",
    "MJX backend": "gnnjax.collision.mjx",
    "problem file": "gnnjax.problems.arrays",
    "picture": "gnnjax.plot",
    "change of frame": "gnnjax.scene.pose",
    "held object": "gnnjax.scene.held",
    "viewer": "gnnjax.viewer.meshes",
    "new obstacle": "gnnjax.viewer.session",
    "judge": "experiments.judge",
    "campaign": "experiments.campaign_edges",
}


@pytest.mark.parametrize(("consumer", "module"), CONSUMERS.items())
def test_every_consumer_has_all_kinds_and_could_not_do_without_one(consumer, module, monkeypatch):
    loaded = importlib.import_module(module)
    assert TABLES[consumer] == KINDS
    monkeypatch.setattr(shapes, "KINDS", (*KINDS, "cone"))
    # As if its source were read anew; the module that others hold stays as it is.
    spec = importlib.util.find_spec(module)
    again = importlib.util.module_from_spec(spec)
    with pytest.raises(TypeError, match=f"the {consumer} has no entry for .* kinds \\['cone'\\]"):
        spec.loader.exec_module(again)
    assert loaded is importlib.import_module(module)


# What reads the sizes of obstacles and knows no clouds, as another module adds them.
_WITHOUT_CLOUDS = {
    "collision/mjx.py",  # `collision/cloud.py` adds them to every backend's tests
    "collision/placed.py",
    "problems/camera.py",  # sees boxes, for a family that has nothing else
}


def test_whoever_reads_shapes_of_scenes_reads_their_clouds():
    package = Path(shapes.__file__).parents[1]
    reads = re.compile(r"scenes?\.(half_extents|radii)\b")
    found = {
        str(file.relative_to(package))
        for file in package.rglob("*.py")
        if reads.search(text := file.read_text()) and not re.search(r"\bclouds?\b", text)
    }
    assert found == _WITHOUT_CLOUDS


def test_there_are_no_other_tables():
    for module in CONSUMERS.values():
        importlib.import_module(module)
    assert set(TABLES) == {*CONSUMERS, "description", "form"}  # in shapes.py


def test_an_entry_that_is_no_kind_is_refused():
    with pytest.raises(TypeError, match=r"the cook has entries for \['pie'\], which are no"):
        for_every_kind("cook", **dict.fromkeys(KINDS, 1), pie=2)


@pytest.mark.parametrize(
    ("shapes", "clouds", "message"),
    [
        (
            [Shape("cone", {"center": [0, 0, 1]})],
            (),
            "has a 'cone'; there are only .'box', 'sphere'",
        ),
        (
            [Balls(np.zeros((1, 3)), 0.1)],
            (),
            "shapes is .Balls.*; give a list of box.* as clouds of",
        ),
        (sphere([0, 0, 1], 0.1), (), "shapes is Shape.*; give a list of box"),
        (
            [],
            Balls(np.zeros((1, 3)), 0.1),
            "clouds of the scene is Balls.*; give a list of point_c",
        ),
        (
            [],
            [sphere([0, 0, 1], 0.1)],
            "clouds of the scene is .Shape.*; give a list of point_cloud",
        ),
    ],
)
def test_what_is_no_shape_or_no_cloud_is_not_left_out_of_a_scene(shapes, clouds, message):
    with pytest.raises(InputError, match=message):
        scene_from_shapes(shapes, clouds=clouds)


@pytest.mark.parametrize("once", [(x for x in [sphere([0, 0, 1], 0.1)]), map(str, [1]), iter([])])
def test_what_can_be_gone_through_once_is_no_list(once):
    with pytest.raises(InputError, match=r"shapes is <.*; give a list of box"):
        inspect.unwrap(check_shapes)(once, "shapes")


def test_a_box_of_the_size_that_stands_for_half_spaces_stays_a_box(tmp_path):
    scene = scene_from_shapes([box([50.9, 0, 0], [50, 50, 50]), half_space([0, 0, -1], [0, 0, 1])])
    scene_to_json(scene, tmp_path / "wall.json")
    again = scene_from_json(tmp_path / "wall.json")
    np.testing.assert_array_equal(again.mask, scene.mask)
    np.testing.assert_allclose(again.centers[:2], scene.centers[:2], atol=1e-4)
    np.testing.assert_allclose(again.half_extents[:2], scene.half_extents[:2], atol=1e-4)
    assert obstacle_name(scene, 0) == "box 0"


def placed_in_mujoco(scene, tiny, file):
    model = build_world(tiny, len(scene.mask))
    place_obstacles(model, mujoco.MjData(model), scene)


def saved_as_problems(scene, tiny, file):
    ends = np.zeros((1, 3), np.float32)
    problems = Problem(ends, ends, stack_scenes([scene]))
    save_problems(file, ProblemSet("tiny", problems))


def edited(scene, tiny, file):
    Session(tiny, Query(scene, np.zeros(3), np.zeros(3)), solve=None, reach=None)


@pytest.mark.parametrize(
    "consumer",
    [
        placed_in_mujoco,
        saved_as_problems,
        edited,
        lambda scene, tiny, file: _obstacle_faces(scene),
        lambda scene, tiny, file: scene_to_json(scene, file),
    ],
)
def test_a_box_that_a_margin_has_rounded_is_of_no_kind(tiny, tmp_path, monkeypatch, consumer):
    monkeypatch.setattr(Session, "__init__", inspect.unwrap(Session.__init__))
    scene = scene_from_shapes([box([0.5, 0, 0.5], [0.1, 0.1, 0.1]), sphere([0, 0.5, 0.5], 0.1)])
    consumer(scene, tiny, tmp_path / "scene")
    with pytest.raises(InputError, match=r"obstacle 0 of (the scene|problem 0) is of no kind of"):
        consumer(inflated(scene, 0.02), tiny, tmp_path / "scene")
    ball = scene_from_shapes([sphere([0, 0.5, 0.5], 0.1)])
    consumer(inflated(ball, 0.02), tiny, tmp_path / "scene")  # which is a larger one


def area(faces):
    halves = (np.cross(faces[:, i] - faces[:, 0], faces[:, i + 1] - faces[:, 0]) for i in (1, 2))
    return sum(np.linalg.norm(half, axis=1).sum() for half in halves) / 2


def test_pictures_show_the_whole_surface_in_pieces_that_can_be_told_apart():
    scene = scene_from_shapes(
        [
            box([0.5, 0, 0.5], [0.3, 0.1, 0.2], quat=[0.5, 0.5, 0.5, -0.5]),
            capsule([0, 0.6, 0.5], 0.1, 0.3),
            cylinder([0, -0.6, 0.5], 0.1, 0.3),
        ]
    )
    expected = [
        8 * (0.3 * 0.1 + 0.1 * 0.2 + 0.2 * 0.3),
        4 * np.pi * 0.1 * (0.1 + 0.3),
        2 * np.pi * 0.1 * (0.1 + 0.6),
    ]
    for (faces, colors), whole in zip(_obstacle_faces(scene), expected, strict=True):
        assert 0.93 * whole < area(faces) < 1.001 * whole
        assert np.linalg.norm(faces - np.roll(faces, 1, axis=1), axis=2).max() < 0.081
        assert colors.shape == (len(faces), 4)
