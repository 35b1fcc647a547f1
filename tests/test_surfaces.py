"""Meshes and height fields enclosed by points, and the scene files that hold them."""

import jax
import numpy as np
import pytest
import trimesh

from gnnjax.errors import InputError
from gnnjax.scene.cloud import BUCKETS
from gnnjax.scene.scene_file import scene_from_json, scene_to_json
from gnnjax.scene.surfaces import (
    INSIDE,
    enclosed,
    height_field,
    mesh,
    scene_from_height_field,
    scene_from_mesh,
)
from tests.clouds import brute_force


def boxy(file, size=(0.4, 0.3, 0.2), flaw=None):
    made = trimesh.creation.box(size)
    if flaw == "open":
        made.update_faces(np.arange(len(made.faces)) > 1)
    made.export(file)
    return file


@pytest.mark.parametrize("form", ["stl", "obj", "ply"])
def test_a_closed_mesh_is_enclosed_and_filled(form, tmp_path):
    rng = np.random.default_rng(6)
    quat = [np.cos(0.3), 0, 0, np.sin(0.3)]
    turn = np.array([[np.cos(0.6), -np.sin(0.6), 0], [np.sin(0.6), np.cos(0.6), 0], [0, 0, 1]])
    file = boxy(tmp_path / f"box.{form}", np.array((0.4, 0.3, 0.2)) * 1000)
    balls = mesh(file, [0.5, 0, 0.2], quat, scale=0.001, voxel=0.01, solid=True)
    half = np.array([0.2, 0.15, 0.1])
    surface = rng.uniform(-1, 1, (300, 3))
    axis = rng.integers(3, size=300)
    surface[np.arange(300), axis] = np.sign(surface[np.arange(300), axis])
    placed = surface * half @ turn.T + [0.5, 0, 0.2]
    assert brute_force(balls.points, placed).max() <= balls.radius
    inside = rng.uniform(-1, 1, (300, 3)) * half @ turn.T + [0.5, 0, 0.2]
    assert brute_force(balls.points, inside).max() <= balls.radius + INSIDE
    own = np.abs((balls.points - [0.5, 0, 0.2]) @ turn) - half
    assert own.max() < 1e-9
    assert balls.radius <= 0.01 * 1.2
    hollow = mesh(file, [0.5, 0, 0.2], quat, scale=0.001, voxel=0.01, solid=False)
    assert brute_force(hollow.points, np.array([[0.5, 0, 0.2]]))[0] > 0.09


def test_an_open_mesh_is_its_surface_and_refused_as_a_solid(tmp_path):
    file = boxy(tmp_path / "open.stl", flaw="open")
    balls = mesh(file, voxel=0.01)
    assert brute_force(balls.points, np.zeros((1, 3)))[0] > 0.09
    with pytest.raises(InputError, match="is not closed, so that it has no inside"):
        mesh(file, solid=True)


def test_a_height_field_is_filled_down_to_its_depth():
    rng = np.random.default_rng(7)
    x = np.linspace(-0.5, 0.5, 21)
    heights = 0.1 * np.sin(6 * x)[None, :] + 0.05 * x[:11, None]
    balls = height_field(heights, (1.0, 0.4), [0, 0, 1], depth=0.2, voxel=0.01)
    across, along = rng.uniform(-0.5, 0.5, 200), rng.uniform(-0.2, 0.2, 200)
    row, column = (along + 0.2) / 0.04, (across + 0.5) / 0.05
    lattice = np.stack(np.meshgrid(np.arange(11), np.arange(21), indexing="ij"), -1).reshape(-1, 2)
    at = np.stack([x[lattice[:, 1]], -0.2 + 0.04 * lattice[:, 0]], axis=1)
    nodes = np.c_[at, 1 + heights.reshape(-1)]
    assert brute_force(balls.points, nodes).max() <= balls.radius
    below = 1 + heights[np.round(row).astype(int), np.round(column).astype(int)] - 0.08
    under = np.stack([across, along, below], axis=1)
    assert brute_force(balls.points, under).max() <= balls.radius + INSIDE
    assert balls.points[:, 2].min() == pytest.approx(1 + heights.min() - 0.2, abs=0.01)
    assert balls.points[:, 2].max() <= 1 + heights.max() + 1e-9


def test_many_triangles_take_no_longer_than_their_surface(tmp_path):
    ball = trimesh.creation.icosphere(subdivisions=7, radius=0.2)  # 327,680 faces
    balls = enclosed(ball.vertices, ball.faces, 0.01)
    assert len(balls.points) < BUCKETS[3]
    outside = np.linalg.norm(balls.points, axis=1) + balls.radius
    assert 0.2 <= outside.max() <= 0.2 + 0.02


def test_scene_files_hold_clouds_meshes_and_height_fields(tmp_path):
    np.save(tmp_path / "seen.npy", np.random.default_rng(9).uniform(0.3, 0.6, (100, 3)))
    boxy(tmp_path / "box.stl")
    (tmp_path / "scene.json").write_text(
        '{"boxes": [{"center": [1, 0, 0], "half_extents": [0.1, 0.1, 0.1]}],'
        ' "clouds": [{"points": "seen.npy", "radius": 0.02, "voxel": 0.01},'
        '            {"points": [[0.9, 0.9, 0.9]]}],'
        ' "meshes": [{"file": "box.stl", "center": [1, 0, 1], "voxel": 0.02}],'
        ' "height_fields": [{"heights": [[0, 0.1], [0, 0.1]], "size": [0.2, 0.2],'
        ' "center": [-1, 0, 0], "voxel": 0.02}]}'
    )
    scene = scene_from_json(tmp_path / "scene.json")
    points = scene.cloud.points[: scene.cloud.num]
    for wanted in ([0.9, 0.9, 0.9], [1.2, 0.15, 1.1], [-1, 0, 0.05]):
        assert brute_force(points, np.array([wanted]))[0] <= scene.cloud.radius
    assert scene.mask.sum() == 1
    scene_to_json(scene, tmp_path / "again.json")
    jax.tree.map(np.testing.assert_array_equal, scene, scene_from_json(tmp_path / "again.json"))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"clouds": [{"radius": 1}]}', r"clouds 0 of .* has \['radius'\]; give points"),
        ('{"clouds": [{"points": "no.npy"}]}', "no file of points .*no.npy"),
        ('{"clouds": [{"points": [[1, 2]]}]}', r"shape \(1, 2\); give \[K, 3\]"),
        ('{"clouds": [{"points": [[1, 2, "x"]]}]}', "are not numbers"),
        ('{"clouds": [{"points": [[1, 2, 3]], "radius": "1"}]}', "radius = '1'; give a number"),
        ('{"clouds": [{"points": [[1, 2, 3]], "radus": 1}]}', "radus"),
        ('{"meshes": [{"file": 3}]}', "has file = 3; give the name of a file"),
        ('{"meshes": [{"file": "no.stl"}]}', "no mesh .*no.stl"),
        ('{"meshes": [{"file": "no.stl", "solid": 3}]}', "solid = 3; give true or false"),
        ('{"height_fields": [{"heights": "no.npy", "size": [1, 1]}]}', "which is no .npy file"),
        ('{"height_fields": [{"heights": [[1, 2]], "size": [1, 1]}]}', r"give \[R, C\], 2 x 2"),
        (
            '{"clouds": [{"points": [[1, 2, 3]], "radius": HUGE}]}',
            "has radius = 10+.*give a number",
        ),
        ('{"clouds": [{"points": [[1, 2, HUGE]]}]}', "are not numbers"),
        ('{"height_fields": [{"heights": [[HUGE, 2], [1, 2]], "size": [1, 1]}]}', "not numbers"),
        (
            '{"height_fields": [{"heights": [[1, 1], [1, 1]], "size": [1, 1], "center": '
            "[HUGE, 0, 0]}]}",
            "center of the height field is .*; give 3 finite numbers",
        ),
    ],
)
def test_broken_scene_files_are_refused_in_a_sentence(text, message, tmp_path):
    (tmp_path / "scene.json").write_text(text.replace("HUGE", "1" + "0" * 400))
    with pytest.raises(InputError, match=message):
        scene_from_json(tmp_path / "scene.json")


@pytest.mark.parametrize(
    ("name", "form"), [("a.ply", {"encoding": "ascii"}), ("a.off", {}), ("a.stl", {})]
)
def test_meshes_of_text_that_end_too_early_are_refused(tmp_path, name, form):
    kind = {"a.stl": "stl_ascii"}.get(name, name[2:])
    made = trimesh.creation.box((0.1, 0.1, 0.1)).export(file_type=kind, **form)
    text = made if isinstance(made, bytes) else made.encode()
    (tmp_path / name).write_bytes(text)
    assert scene_from_mesh(tmp_path / name).cloud is not None
    cut = text.rstrip()[: -len(text.rstrip().split(b"\n")[-1])]  # without the last line
    (tmp_path / name).write_bytes(cut)
    with pytest.raises(InputError, match=f"{name}' ends too early; export it again"):
        scene_from_mesh(tmp_path / name)


TETRAHEDRON = "v 0 0 0\nv .1 0 0\nv 0 1e-1 0\nv 0 0 0.1\nf 1 2 3\nf 1/1 2/1 4/1\nf 1//1 3//1 4//1\n"


@pytest.mark.parametrize(
    ("ends", "message"),
    [
        ("f 2 3 4", None),
        ("f 2/1/1 3/1/1 4/1/1 \r\n# made by hand", None),
        ("v 0.3 0 0", None),
        ("o nothing", None),
        ("f 2 3", "ends too early; export it again"),
        ("f", "ends too early"),
        ("f 2/1 3/1 4/", "ends too early"),
        ("v 0.3 0", "ends too early"),
        ("v 0.3 0 -", "ends too early"),
        ("f 2 3 9", "cannot be read"),
        ("f 2 3 0", "numbers below 1, which are misread"),
        ("f -3 -2 -1", "numbers below 1, which are misread"),
        ("f 2 3 -1\nv 0 0 1", "numbers below 1, which are misread"),
    ],
)
def test_what_is_told_of_an_obj_that_is_not_whole(tmp_path, ends, message):
    file = tmp_path / "a.obj"
    file.write_text(TETRAHEDRON + ends, newline="")
    if message is None:
        assert scene_from_mesh(file, solid=False).cloud is not None
        return
    with pytest.raises(InputError, match=message):
        scene_from_mesh(file)


def test_other_bad_meshes_and_height_fields_are_refused(tmp_path):
    for content in (b"", b"solid nothing\nendsolid nothing\n"):
        (tmp_path / "bad.stl").write_bytes(content)
        with pytest.raises(InputError, match=r"mesh .*bad.stl' (cannot be read|has no faces)"):
            scene_from_mesh(tmp_path / "bad.stl")
    with pytest.raises(InputError, match="no mesh"):
        scene_from_mesh(tmp_path / "none.stl")
    with pytest.raises(InputError, match=r"scale of .* is 0"):
        scene_from_mesh(boxy(tmp_path / "box.stl"), scale=0.0)
    with pytest.raises(InputError, match=r"quat of .* is .*; give a rotation"):
        scene_from_mesh(tmp_path / "box.stl", quat=[0, 0, 0, 0])
    with pytest.raises(InputError, match="choose a larger voxel, or check its unit"):
        scene_from_mesh(tmp_path / "box.stl", scale=1000.0)
    with pytest.raises(InputError, match="must be finite"):
        scene_from_height_field([[0, np.nan], [0, 0]], (1, 1))
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 nan 0\nf 1 2 3\nf 2 3 4\n")
    with pytest.raises(InputError, match=r"a.obj' has vertices that are not finite"):
        scene_from_mesh(tmp_path / "a.obj")
