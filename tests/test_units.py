"""Scenes in millimetres are wondered at, and others are not."""

import pytest

from gnnjax.planning.query import check_query
from gnnjax.scene.scene import scene_from_shapes
from gnnjax.scene.shapes import box, half_space, sphere
from gnnjax.scene.units import doubtful_units

FLOOR = half_space([0.0, 0.0, -600.0], [0.0, 0.0, 1.0])


@pytest.mark.parametrize(
    "shapes",
    [
        [],
        [FLOOR],
        [half_space([0, 0, -0.3], [0, 0, 1])],
        [box([0.6, 0.0, 0.0], [0.1, 0.1, 0.1]), sphere([900.0, 0.0, 0.0], 1.0)],
        [sphere([2.5, 0.0, 0.0], 0.01)],
        [box([0.0, 0.0, -11.0], [10.0, 10.0, 10.0])],
    ],
)
def test_scenes_in_metres_are_not_wondered_at(tiny, shapes):
    assert doubtful_units(tiny, scene_from_shapes(shapes)) is None


@pytest.mark.parametrize(
    ("shapes", "said"),
    [
        ([box([600.0, 0.0, 0.0], [100.0, 100.0, 100.0]), FLOOR], "is 427 m or more from tiny"),
        ([sphere([0.0, 0.0, 900.0], 50.0)], "is 85"),
        ([box([0.0, 0.0, -300.5], [300.0, 300.0, 300.0])], "is larger than 300 m"),
    ],
)
def test_scenes_in_millimetres_are(tiny, shapes, said, caplog):
    scene = scene_from_shapes(shapes)
    assert said in doubtful_units(tiny, scene)
    check_query(tiny, scene, [0.0, 0.0, 0.0], [1.0, 0.0, 0.0])
    (record,) = caplog.records
    assert "is the scene in millimetres? lengths are in metres" in record.message
