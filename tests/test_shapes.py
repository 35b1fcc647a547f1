"""Every consumer of obstacles has an entry for every kind, or cannot be imported."""

import importlib
import re
from pathlib import Path

import pytest

from gnnjax.scene import shapes
from gnnjax.scene.shapes import KINDS, TABLES, for_every_kind

# Whatever meets obstacles; a new one belongs here.
CONSUMERS = {
    "scene file": "gnnjax.scene.scene_file",
    "MuJoCo world": "gnnjax.scene.mujoco_world",
    "MJX backend": "gnnjax.collision.mjx",
    "problem file": "gnnjax.problems.file",
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
    "collision/spheres.py",
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
