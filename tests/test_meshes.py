"""Triangles that a viewer draws of arms and obstacles."""

import dataclasses

import mujoco
import numpy as np
import pytest

from gnnjax.arm.robot import load_robot
from gnnjax.scene.shapes import KINDS, box
from gnnjax.viewer.frames import Frames
from gnnjax.viewer.meshes import arm_pieces, geom_mesh, ghost_pieces, obstacle_mesh, shown_geoms
from gnnjax.viewer.session import sizes_of
from tests.viewed import SHAPES


def volume(mesh):
    """Of what triangles enclose; positive where their normals point out of it, m^3."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    return np.einsum("fi,fi->", a, np.cross(b, c)) / 6


def test_triangles_of_obstacles_enclose_what_these_do():
    sizes = {kind: sizes_of(shape) for kind, shape in zip(KINDS, SHAPES, strict=True)}
    ball = 4 / 3 * np.pi
    expected = {
        "box": 8 * 0.1 * 0.2 * 0.3,
        "sphere": ball * 0.1**3,
        "capsule": ball * 0.05**3 + np.pi * 0.05**2 * 0.2,
        "cylinder": np.pi * 0.1**2 * 0.3,
    }
    for kind, size in expected.items():
        mesh = obstacle_mesh(kind, sizes[kind].half_extents, sizes[kind].radii)
        assert volume(mesh) == pytest.approx(size, rel=0.03)
        assert np.abs(mesh.vertices[:, 2]).max() == pytest.approx(
            sizes[kind].half_extents[2] + sizes[kind].radii[1]
        )
    plane = sizes["half_space"]
    corners = obstacle_mesh("half_space", plane.half_extents, plane.radii).vertices
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, plane.quats)
    corners = corners @ turn.reshape(3, 3).T + plane.centers
    np.testing.assert_allclose((corners - [0, 0.1, -1.5]) @ [0, 0.6, 0.8], 0, atol=1e-9)


def test_triangles_of_geoms_lie_on_them_where_mujoco_has_them(tmp_path):
    (tmp_path / "arm.xml").write_text(
        """<mujoco><compiler autolimits="true"/><worldbody><body><joint range="-1 1"/>
        <geom type="capsule" size="0.05" fromto="0 0 0 0 0.3 0.2"/>
        <geom type="ellipsoid" size="0.1 0.05 0.2" pos="0.1 0 0" euler="20 0 40"/>
        <geom type="box" size="0.1 0.05 0.2" pos="0 0.1 0" euler="20 30 0"/>
        <geom type="cylinder" size="0.1 0.2" pos="0 0 0.1" euler="0 30 10"/>
        </body></worldbody></mujoco>"""
    )
    model = mujoco.MjSpec.from_file(str(tmp_path / "arm.xml")).compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    volumes = (
        np.pi * 0.05**2 * (np.sqrt(0.13) + 4 / 3 * 0.05),
        4 / 3 * np.pi * 0.1 * 0.05 * 0.2,
        8 * 0.1 * 0.05 * 0.2,
        np.pi * 0.1**2 * 0.4,
    )
    for g, size in enumerate(volumes):
        mesh = geom_mesh(model, g)
        assert volume(mesh) == pytest.approx(size, rel=0.03)
        middle, kind = data.geom_xpos[g], int(model.geom_type[g])
        for ray in mesh.vertices - middle + 1e-5:  # along an axis MuJoCo misses the near side
            # From afar towards the middle, the geom begins at the corner of a triangle.
            away = mujoco.mju_rayGeom(
                middle, data.geom_xmat[g], model.geom_size[g], middle + 3 * ray, -ray, kind
            )
            assert away == pytest.approx(2, abs=1e-3)


@pytest.mark.parametrize("name", ["kuka_iiwa14", "franka_panda", "kinova_gen3"])
def test_of_arms_all_that_moves_is_drawn(name):
    robot = load_robot(name)
    model = robot.mj_model
    moved = {part.body + 1 for part in robot.parts if model.body_weldid[part.body + 1]}
    assert moved == {piece.body for piece in ghost_pieces(robot, (1.0, 0.0, 0.0, 0.5))}
    assert moved <= {piece.body for piece in arm_pieces(robot)}
    # What has clothes of its own is not drawn as its hulls.
    assert not set(shown_geoms(robot)) & set(robot.part_geoms.tolist())


def test_what_an_arm_holds_is_drawn_and_so_is_an_arm_without_clothes(tiny):
    holding = tiny.attach("lower", [box([0.2, 0, 0], [0.02, 0.02, 0.1])])
    assert shown_geoms(tiny) == list(range(4))
    assert len(shown_geoms(holding)) == 5
    hidden = holding.mj_spec.copy()
    for geom in hidden.geoms:
        geom.group = 3
    bare = dataclasses.replace(holding, mj_model=hidden.compile())
    assert shown_geoms(bare) == shown_geoms(holding)


def test_bodies_and_hand_are_where_mujoco_has_them(tiny):
    data = mujoco.MjData(tiny.mj_model)
    data.qpos[:] = [0.3, -0.5, 0.7]
    mujoco.mj_forward(tiny.mj_model, data)
    frames = Frames(tiny)
    positions, quats = frames.bodies(np.array([0.3, -0.5, 0.7]))
    np.testing.assert_array_equal(positions, data.xpos)
    np.testing.assert_array_equal(quats, data.xquat)
    position, quat = frames.tip(np.array([0.3, -0.5, 0.7]))
    np.testing.assert_allclose(position, data.xpos[-1])
    np.testing.assert_allclose(quat, data.xquat[-1])
    kuka = load_robot("kuka_iiwa14")
    data = mujoco.MjData(kuka.mj_model)
    data.qpos[:] = kuka.home
    mujoco.mj_kinematics(kuka.mj_model, data)
    tool = kuka.mj_model.site("tool").id
    position, quat = Frames(kuka).tip(kuka.home)
    expected = np.zeros(4)
    mujoco.mju_mat2Quat(expected, data.site_xmat[tool])
    np.testing.assert_allclose(position, data.site_xpos[tool], atol=1e-12)
    assert abs(quat @ expected) == pytest.approx(1)
    np.testing.assert_array_equal(Frames(kuka).tips(kuka.home[None])[0], position)
