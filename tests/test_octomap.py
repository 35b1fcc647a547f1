"""OctoMap's files and messages: which voxels are occupied, and where."""

import struct

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from gnnjax.arm.robot import load_robot
from gnnjax.errors import InputError
from gnnjax.scene.any_file import read_scene
from gnnjax.scene.moveit import scene_from_moveit
from gnnjax.scene.octomap import octomap, scene_from_octomap, voxels
from gnnjax.scene.scene_file import scene_from_json

HEADER = b"# Octomap OcTree%s file\n# a comment\n#\nid OcTree\nsize 49\nres 0.1\ndata\n"
# As OctoMap 1.10 wrote it, of two voxels that are occupied and one that is free.
WRITTEN = bytes.fromhex(
    "00fc300030003000300030003000300030003000300030003000c000000301000c000c000c000c00"
    "0c000c000c000c000c000c000c00000c0c0000038000030003000300030003000300030003000300"
    "030003000300030003000200"
)
OCCUPIED = [[0.05, 0.05, 0.05], [-0.25, 0.15, 1.05]]


def bits(**states):
    """A node of the binary form, of the states of its children by number."""
    return struct.pack("<H", sum(state << 2 * int(name[1:]) for name, state in states.items()))


FREE, FULL, INNER = 1, 2, 3


def chain(depth, last):
    """Down from the root along the lower corner of x > 0, y > 0, z > 0."""
    return bits(c7=INNER) + bits(c0=INNER) * (depth - 1) + last


def as_sorted(points):
    return np.array(sorted(np.round(points, 9).tolist()))


def test_what_octomap_wrote_is_read(tmp_path):
    (tmp_path / "a.bt").write_bytes(HEADER % b" binary" + WRITTEN)
    balls = octomap(tmp_path / "a.bt")
    np.testing.assert_allclose(as_sorted(balls.points), as_sorted(OCCUPIED), atol=1e-9)
    assert balls.radius == pytest.approx(0.05 * np.sqrt(3))
    quat, center = [0.5, 0.5, -0.5, 0.5], [0.1, 0.2, 0.3]
    moved = octomap(tmp_path / "a.bt", center, quat).points
    wanted = Rotation.from_quat(quat, scalar_first=True).apply(balls.points) + center
    np.testing.assert_allclose(moved, wanted, atol=1e-12)
    scene = scene_from_octomap(tmp_path / "a.bt", center=center, quat=quat)
    (tmp_path / "scene.json").write_text(
        f'{{"octomaps": [{{"file": "a.bt", "center": {center}, "quat": {quat}}}]}}'
    )
    again = scene_from_json(tmp_path / "scene.json")
    np.testing.assert_array_equal(scene.cloud.points, again.cloud.points)
    assert scene.cloud.num == 2


def test_larger_leaves_become_voxels_and_children_are_where_their_bits_say():
    # Two levels above the voxels: child 6 is y and z up, and in it one voxel of x up, and one free.
    tree = chain(14, bits(c0=FULL, c5=FREE, c6=INNER) + bits(c1=FULL, c2=FREE))
    points = voxels(tree, True, "OcTree", 1.0, "it").points
    cube = np.stack(np.meshgrid(*[[0.5, 1.5]] * 3), axis=-1).reshape(-1, 3)
    wanted = np.concatenate([cube, [[1.5, 2.5, 2.5]]])
    np.testing.assert_array_equal(as_sorted(points), as_sorted(wanted))
    assert not len(voxels(b"", True, "OcTree", 1.0, "it").points)
    assert not len(voxels(bits(c0=FREE), True, "OcTree", 1.0, "it").points)


@pytest.mark.parametrize("kind", ["OcTree", "ColorOcTree"])
def test_the_full_form_tells_occupied_leaves_by_their_odds(kind, tmp_path):
    color = b"rgb" if kind == "ColorOcTree" else b""

    def node(odds, children=0):
        return struct.pack("<f", odds) + color + bytes([children])

    # What is above a leaf is no leaf, whatever its odds; even odds are occupied.
    tree = node(3.0, 1 << 7) + node(3.0, 1) * 14 + node(3.0, 0b1011)
    tree += node(-0.1) + node(0.0) + node(2.0)
    header = (HEADER % b"").replace(b"id OcTree", f"id {kind}".encode())
    (tmp_path / "a.ot").write_bytes(header + tree)
    points = octomap(tmp_path / "a.ot").points
    wanted = [[0.15, 0.05, 0.05], [0.15, 0.15, 0.05]]
    np.testing.assert_allclose(as_sorted(points), as_sorted(wanted), atol=1e-9)


def test_commands_take_maps_by_their_ending(tiny_path, tmp_path):
    (tmp_path / "a.bt").write_bytes(HEADER % b" binary" + WRITTEN)
    assert read_scene(tmp_path / "a.bt", load_robot(tiny_path)).cloud.num == 2


@pytest.mark.parametrize("form", ["list", "bytes"])
def test_octomaps_of_planning_scenes_are_read_where_they_are(form, tmp_path):
    signed = struct.unpack(f"{len(WRITTEN)}b", WRITTEN)
    tree = {"binary": True, "id": "OcTree", "resolution": 0.1}
    tree["data"] = WRITTEN if form == "bytes" else list(signed)
    turn, shift = Rotation.from_quat([0, 0, 0.6, 0.8]), np.array([0.1, -0.2, 0.3])
    origin = {"position": [0.5, 0, 0], "orientation": [0, 0, 0, 0]}
    camera = {"translation": shift.tolist(), "rotation": [0, 0, 0.6, 0.8]}
    message = {
        "fixed_frame_transforms": [
            {"header": {"frame_id": "map"}, "child_frame_id": "camera", "transform": camera}
        ],
        "world": {"octomap": {"header": {"frame_id": "camera"}, "origin": origin, "octomap": tree}},
    }
    (tmp_path / "scene.yaml").write_text(yaml.safe_dump(message))
    cloud = scene_from_moveit(tmp_path / "scene.yaml").cloud
    wanted = turn.apply(np.array(OCCUPIED) + np.array([0.5, 0, 0])) + shift
    np.testing.assert_allclose(as_sorted(cloud.points[:2]), as_sorted(wanted), atol=1e-6)
    assert cloud.num == 2
    tree["resolution"] = 10**400
    (tmp_path / "scene.yaml").write_text(yaml.safe_dump(message))
    with pytest.raises(InputError, match=r"octomap of .* has the resolution 10+.*; give an edge"):
        scene_from_moveit(tmp_path / "scene.yaml")
    tree["resolution"] = 0.1
    tree["data"] = [int(x) for x in bits(c0=FREE)]
    (tmp_path / "scene.yaml").write_text(yaml.safe_dump(message))
    assert scene_from_moveit(tmp_path / "scene.yaml").cloud is None


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"hello", "does not begin as a .bt or .ot file does"),
        (HEADER % b" binary" + WRITTEN[:-1], "ends in the middle of its tree; save it anew"),
        (HEADER % b"" + WRITTEN, "no octree|ends in the middle"),
        (HEADER % b" binary" + WRITTEN + b"x", "is no octree .1 bytes are left over.; save it"),
        (HEADER % b" binary" + chain(16, bits(c0=FULL)), "deeper than 16 levels"),
        (HEADER % b" binary" + bits(c0=FREE), "has no occupied voxel; check what was mapped"),
        (HEADER % b" binary" + chain(8, bits(c0=FULL)), "has 2097152 occupied voxels; at most"),
        ((HEADER % b"").replace(b"id OcTree", b"id Rough"), "of the kind 'Rough'; save it in the"),
        ((HEADER % b"").replace(b"res 0.1", b"res -1"), "the resolution '-1'; give an edge in m"),
    ],
)
def test_what_is_no_map_is_refused_in_a_sentence(content, message, tmp_path):
    (tmp_path / "a.bt").write_bytes(content)
    with pytest.raises(InputError, match=message):
        octomap(tmp_path / "a.bt")


def test_a_missing_map_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"no octomap .*none.bt'; check the path"):
        octomap(tmp_path / "none.bt")
    with pytest.raises(InputError, match="is a folder; name a file"):
        octomap(tmp_path)
