"""COLLADA meshes are in the unit that their file names, in arms and in scenes."""

import re

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from gnnjax.arm.robot import load_robot
from gnnjax.errors import InputError
from gnnjax.scene.surfaces import mesh

SIZE = np.array([0.2, 0.1, 0.3])  # m
CORNERS = np.array([(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)]) - 0.5
COLLADA = """<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
  <asset><created>2026-01-01</created><modified>2026-01-01</modified>UNIT</asset>
  <library_geometries><geometry id="box"><mesh>
    <source id="corners"><float_array id="numbers" count="24">NUMBERS</float_array>
      <technique_common><accessor source="#numbers" count="8" stride="3">
        <param name="X" type="float"/><param name="Y" type="float"/><param name="Z" type="float"/>
      </accessor></technique_common></source>
    <vertices id="vertices"><input semantic="POSITION" source="#corners"/></vertices>
    <triangles count="12"><input semantic="VERTEX" source="#vertices" offset="0"/>
      <p>FACES</p></triangles>
  </mesh></geometry></library_geometries>
  <library_visual_scenes><visual_scene id="all"><node><instance_geometry url="#box"/></node>
  </visual_scene></library_visual_scenes>
  <scene><instance_visual_scene url="#all"/></scene>
</COLLADA>"""
ARM = """<robot name="arm"><link name="base"/><link name="upper"><collision><geometry>
  <mesh filename="box.dae"/></geometry></collision></link>
  <joint name="turn" type="revolute"><parent link="base"/><child link="upper"/>
  <axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>"""


def written(folder, unit, meters):
    """A box of that size, in the unit that is so many metres; and an arm of it."""
    faces = ConvexHull(CORNERS).simplices
    text = COLLADA.replace("UNIT", unit).replace("FACES", " ".join(map(str, faces.ravel())))
    numbers = " ".join(f"{x:.9g}" for x in (CORNERS * SIZE / meters).ravel())
    (folder / "box.dae").write_text(text.replace("NUMBERS", numbers))
    (folder / "arm.urdf").write_text(ARM)
    return folder


UNITS = [
    ("", 1.0),
    ('<unit name="inch" meter="0.0254"/>', 0.0254),
    ('<unit name="millimeter" meter="0.001"/>', 0.001),
]


@pytest.mark.parametrize(("unit", "meters"), UNITS)
def test_an_arms_meshes_are_in_metres(tmp_path, unit, meters):
    (part,) = load_robot(written(tmp_path, unit, meters) / "arm.urdf").parts
    assert len(part.vertices) == 8
    np.testing.assert_allclose(np.abs(part.vertices), np.tile(SIZE / 2, (8, 1)), atol=1e-6)


@pytest.mark.parametrize(("unit", "meters"), UNITS)
def test_meshes_of_scenes_are_in_metres(tmp_path, unit, meters):
    file = written(tmp_path, unit, meters) / "box.dae"
    for scale in (1.0, 0.5):
        balls = mesh(file, center=[0.5, 0, 0], scale=scale, voxel=0.01, solid=True)
        reach = np.abs(balls.points - [0.5, 0, 0]).max(axis=0)
        np.testing.assert_allclose(reach, scale * SIZE / 2, atol=1e-6)


@pytest.mark.parametrize("meters", ["inch", "0", "-1", "nan", "inf"])
def test_a_unit_that_is_no_length_is_refused(tmp_path, meters):
    file = written(tmp_path, f'<unit meter="{meters}"/>', 1.0) / "box.dae"
    message = re.escape(f"box.dae' is in units of '{meters}' m; give a length")
    for read in (lambda: mesh(file), lambda: load_robot(tmp_path / "arm.urdf")):
        with pytest.raises(InputError, match=f"{message}|cannot be read"):
            read()
