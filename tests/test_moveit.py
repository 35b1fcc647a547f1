"""MoveIt's planning scenes: what stands where, and what is refused."""

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from gnnjax import scene_from_moveit
from gnnjax.errors import InputError
from gnnjax.scene.messages import read_message
from gnnjax.scene.scene import Scene
from gnnjax.scene.shapes import KINDS, kind_of
from tests.moveit_messages import SCENE, put, read


@pytest.fixture
def message():
    return yaml.safe_load(SCENE)


def existing(scene: Scene) -> dict[str, np.ndarray]:
    """Of each kind, the centres and what follows."""
    kinds = np.where(scene.mask, kind_of(scene.half_extents, scene.radii), -1)
    columns = np.concatenate([np.asarray(x) for x in scene[:4]], axis=-1)
    return {kind: columns[kinds == number] for number, kind in enumerate(KINDS)}


def test_full_edges_heights_and_quaternions_become_ours(tmp_path, message):
    found = existing(read(tmp_path, message))
    #                              centre       half extents     w x y z           disc, ball
    box = [0, 1, 0, 0.4, 0.2, 0.01, 0.8, 0.6, 0, 0, 0, 0]
    ball = [1e-5, -1, 2, 0, 0, 0, 1, 0, 0, 0, 0, 0.2]
    can = [0.5, 0.1, 0.3, 0, 0, 0.07, 0.8, 0, 0, 0.6, 0.03, 0]
    np.testing.assert_allclose(found["box"], [box], atol=1e-7)
    np.testing.assert_allclose(found["sphere"], [ball], atol=1e-7)
    np.testing.assert_allclose(found["cylinder"], [can], atol=1e-7)


def test_types_by_number_fields_by_name_and_a_second_document_are_read(tmp_path, message):
    expected = read(tmp_path, message)
    world = message["world"]["collision_objects"]
    for each, numbers in zip(world, ([3], [1, 2]), strict=True):
        for primitive, number in zip(each["primitives"], numbers, strict=True):
            primitive["type"] = number
        each |= {"operation": 0, "header": {"frame_id": "world"}, "meshes": [], "plane_poses": []}
        for pose in each["primitive_poses"]:
            for name, axes in (("position", "xyz"), ("orientation", "xyzw")):
                pose[name] = dict(zip(axes, pose[name], strict=True))
    message["world"]["octomap"] = {"octomap": {"id": "", "data": [], "resolution": 0.0}}
    echoed = yaml.safe_dump(message) + "\n---\n"
    for mine, theirs in zip(read(tmp_path, echoed), expected, strict=True):
        np.testing.assert_array_equal(mine, theirs)


def random_pose(rng):
    return rng.uniform(-1, 1, 3), Rotation.random(rng=rng)


def as_fields(pose, names=("position", "orientation")):
    return {names[0]: pose[0].tolist(), names[1]: pose[1].as_quat().tolist()}


def test_the_poses_of_frame_object_primitive_and_robot_are_composed(tmp_path, message):
    rng = np.random.default_rng(0)
    frame, thing, primitive, robot = (random_pose(rng) for _ in range(4))
    message["fixed_frame_transforms"].append(
        {"child_frame_id": "camera", "transform": as_fields(frame, ("translation", "rotation"))}
    )
    message["robot_state"]["multi_dof_joint_state"]["transforms"] = [
        as_fields(robot, ("translation", "rotation"))
    ]
    message["world"]["collision_objects"] = [
        {
            "id": 7,
            "header": {"frame_id": "camera"},
            "pose": as_fields(thing),
            "primitives": [{"type": "box", "dimensions": [0.2, 0.4, 0.6]}],
            "primitive_poses": [as_fields(primitive)],
            "planes": [{"coef": [1.0, 2.0, 2.0, 3.0]}],
            "plane_poses": [as_fields(primitive)],
        }
    ]
    found = existing(read(tmp_path, message))
    corners = rng.uniform(-1, 1, (5, 3)) * [0.1, 0.2, 0.3]

    def to_base(points):
        for position, rotation in (primitive, thing, frame):
            points = rotation.apply(points) + position
        return robot[1].inv().apply(points - robot[0])

    (row,) = found["box"]
    seen = Rotation.from_quat(row[6:10], scalar_first=True).apply(corners) + row[:3]
    np.testing.assert_allclose(seen, to_base(corners), atol=1e-6)
    # The plane: what is on it is on the face of the half-space, which the base is not in.
    on = np.array([[-3.0, 0, 0], [0, -1.5, 0], [0, 0, -1.5]])
    (row,) = found["half_space"]
    local = Rotation.from_quat(row[6:10], scalar_first=True).inv()
    np.testing.assert_allclose(local.apply(to_base(on) - row[:3])[:, 2], row[5], atol=1e-4)
    assert local.apply(-row[:3])[2] > row[5]


@pytest.mark.parametrize(
    ("coef", "top"),
    [
        ([0, 0, 1, 0.5], -0.5),
        ([0, 0, -2, -1.0], -0.5),
        ([0, 0, 1, 0], 0),
        ([0, 0, -1, 0], 0),
        ([0, 0, -1, 1e-8], 0),
        ([0.1, 0.2, -0.97, 0], 0),
    ],
)
def test_a_plane_leaves_the_arm_on_the_side_of_its_base_or_above_it(tmp_path, message, coef, top):
    message["world"]["collision_objects"] = [
        {
            "id": "floor",
            "planes": [{"coef": coef}],
            "plane_poses": [{"position": [0, 0, 0], "orientation": [0, 0, 0, 1]}],
        }
    ]
    (row,) = existing(read(tmp_path, message))["half_space"]
    up = Rotation.from_quat(row[6:10], scalar_first=True).apply([0, 0, 1])
    np.testing.assert_allclose((row[:3] + row[5] * up)[2], top, atol=1e-5)
    assert up[2] > 0


def test_a_frame_is_the_same_with_and_without_a_slash(tmp_path, message):
    transform = {"translation": [1, 2, 3], "rotation": [0, 0, 0, 1]}
    message["fixed_frame_transforms"].append({"child_frame_id": "/camera", "transform": transform})
    message["world"]["collision_objects"][0]["header"] = {"frame_id": "/camera"}
    found = existing(read(tmp_path, message))["cylinder"]
    np.testing.assert_allclose(found[0, :3], [1.5, 2.1, 3.3], rtol=1e-6)


def test_an_object_may_have_the_pose_of_its_only_shapes(tmp_path, message):
    table = message["world"]["collision_objects"][0]
    pose = table.pop("primitive_poses")[0]
    table["pose"] = pose
    np.testing.assert_allclose(
        existing(read(tmp_path, message))["cylinder"][0, :3], [0.5, 0.1, 0.3]
    )
    # As fields have that nobody set.
    table |= {"pose": {"position": [0] * 3, "orientation": [0] * 4}, "primitive_poses": [pose]}
    np.testing.assert_allclose(
        existing(read(tmp_path, message))["cylinder"][0, :3], [0.5, 0.1, 0.3]
    )


def test_one_frame_that_nothing_else_names_is_the_planning_frame(tmp_path, message):
    del message["fixed_frame_transforms"]
    objects = message["world"]["collision_objects"]
    for each in objects:
        each["header"] = {"frame_id": "base_link"}
    assert read(tmp_path, message).mask.sum() == 3
    objects[1]["header"] = {"frame_id": "camera"}
    with pytest.raises(InputError, match=r"is in the frame 'base_link', and there are \[''\]"):
        read(tmp_path, message)


FIRST = ("world", "collision_objects", 0)
TABLE = ("world", "collision_objects", 1)


def test_meshes_are_enclosed_where_they_stand(tmp_path, message):
    corners = [[0, 0, 0], [0.2, 0, 0], [0, 0.2, 0], [0, 0, 0.2]]
    vertices = [dict(zip("xyz", corner, strict=True)) for corner in corners]
    triangles = [{"vertex_indices": x} for x in ([0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3])]
    thing = message["world"]["collision_objects"][0]
    thing["meshes"] = [{"vertices": vertices, "triangles": triangles}]
    # Turned by 180 degrees about z.
    thing["mesh_poses"] = [{"position": [0.5, 0, 0.1], "orientation": [0, 0, 1, 0]}]
    scene, before = read(tmp_path, message), read(tmp_path, yaml.safe_load(SCENE))
    assert before.cloud is None
    assert scene.mask.sum() == before.mask.sum()
    assert scene.cloud is not None
    points = scene.cloud.points[: scene.cloud.num]
    # The frame of what else the object has, without the mesh's own pose.
    thing["meshes"], thing["mesh_poses"] = [], []
    thing["primitives"], thing["primitive_poses"] = (
        [{"type": "sphere", "dimensions": [0.01]}] * 4,
        [{"position": [0.5 - x, -y, 0.1 + z], "orientation": [0, 0, 0, 1]} for x, y, z in corners],
    )
    spheres = read(tmp_path, message)
    expected = spheres.centers[spheres.mask & (np.abs(spheres.radii[:, 1] - 0.01) < 1e-6)]
    assert len(expected) == 4
    apart = np.linalg.norm(points - expected[:, None], axis=2).min(axis=1)
    assert (apart <= scene.cloud.radius + 1e-6).all()
    assert (points >= expected.min(axis=0) - 0.01).all()
    assert (points <= expected.max(axis=0) + 0.01).all()
    thing["meshes"] = [{"vertices": vertices, "triangles": [{"vertex_indices": [0, 1, 4]}]}]
    thing["mesh_poses"] = thing["primitive_poses"][:1]
    with pytest.raises(InputError, match=r"triangle 0 of .* are \[0, 1, 4\]; there are 4 vertices"):
        read(tmp_path, message)


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        (put(*FIRST, "primitives", 0, "type", "cone"), "type 'cone'; there are .* enclose it"),
        (put(*FIRST, "primitives", 0, "type", 4), "type 'cone'"),
        (put(*FIRST, "primitives", 0, "type", "torus"), r"type 'torus'; there are \['box'"),
        (put(*FIRST, "primitives", 0, "type", 9), "type 9"),
        (put(*FIRST, "primitives", 0, "dimensions", [0.1]), "height, radius.* list of 2 finite"),
        (put(*TABLE, "primitives", 0, "dimensions", [1, 1, -1]), "object 'table'.* positive"),
        (put(*FIRST, "primitives", 0, "dimensions", 3), "dimensions .* give a list of 2"),
        (put(*FIRST, "primitives", 0, "polygon", [1]), None),
        (put(*FIRST, "primitive_poses", []), "0 primitive_poses for 1 primitives"),
        (put(*FIRST, "primitive_poses", 0, "position", dict.pop), "position .* list of 3 finite"),
        (put(*FIRST, "primitive_poses", 0, "position", [0, float("nan"), 0]), "3 finite numbers"),
        (put(*FIRST, "primitive_poses", 0, "position", [True, 0, 0]), "3 finite numbers"),
        (put(*FIRST, "primitive_poses", 0, "position", ["far", 0, 0]), "3 finite numbers"),
        (put(*FIRST, "primitive_poses", 0, "orientation", [0, 0, 1]), "list of 4 finite numbers"),
        (put(*FIRST, "primitive_poses", 0, "orientation", [0] * 4), "zeros; give a rotation"),
        (put(*FIRST, "primitives", [{"type": "box", "dimensions": [1e5] * 3}]), "below 10000 m"),
        (put(*FIRST, "meshes", [{"vertices": []}]), "has 0 mesh_poses for 1 meshes; give each one"),
        (put(*FIRST, "primitives", []), "1 primitive_poses for 0 primitives"),
        (put(*FIRST, {"id": "nothing"}), "object 'nothing' .* no primitives, planes or meshes"),
        (put(*FIRST, "planes", [{"coef": [0, 0, 0, 1]}]), "0 plane_poses for 1 planes"),
        (put(*FIRST, "operation", "move"), "operation 'move'"),
        (put(*FIRST, "operation", 1), "operation 1"),
        (put(*FIRST, "header", {"frame_id": "hand"}), r"frame 'hand', and there are \['', 'world'"),
        (put(*FIRST, "hulls", [1]), r"a collision object .* has \['hulls'\]"),
        (put(*FIRST, "a string"), "a collision object of .* is 'a string'"),
        (put("world", "octomap", {"octomap": {"data": [0, 1]}}), "has binary = None; give true"),
        (put("world", "octomap", {"octomap": {"data": [0, 300]}}), "give bytes, -128 to 255"),
        (put("world", "collision_objects", 3), "collision_objects = 3; give a list"),
        (put("world", "voxels", 3), r"world of .* has \['voxels'\]"),
        (put("world", dict.pop), "has no world; give what stands there"),
        (put(*FIRST, "primitive_poses", 0, "position", [0, 1e39, 0]), "3 finite numbers"),
        (put("fixed_frame_transforms", 0, "child_frame_id", dict.pop), "has no child_frame_id"),
        (put("is_diff", True), "is a difference to another"),
        (put("link_padding", [{"link_name": "hand", "padding": 0.01}]), "link_padding 0.01"),
        (put("link_scale", [{"link_name": "hand", "scale": 1.0}]), None),
        (
            put("robot_state", "attached_collision_objects", [{}]),
            "object attached to '' in .* frame",
        ),
        (
            put("robot_state", "multi_dof_joint_state", "joint_names", ["a", "b"]),
            r"1 transforms for the joints \['a', 'b'\]",
        ),
        (
            put("fixed_frame_transforms", 0, "transform", "rotation", [0, 0, 0, 0]),
            "rotation of a transform of fixed_frame_transforms",
        ),
        (put("meshes", []), r"has \['meshes'\], which is not known here"),
    ],
)
def test_what_cannot_be_read_is_refused_in_a_sentence(tmp_path, message, change, fault):
    change(message)
    if fault is None:
        assert read(tmp_path, message).mask.sum() == 3
        return
    with pytest.raises(InputError, match=fault) as found:
        read(tmp_path, message)
    assert "scene.yaml" in str(found.value)
    assert "\n" not in str(found.value)


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("a: [1", "is no YAML"),
        ("name: a\nname: b", "'name' comes twice in one mapping"),
        ("world: {}\n---\nworld: {}\n", "holds 2 messages; give a file with one"),
        ("", "holds 0 messages"),
        ("- 1", r"is \[1\]; it should have fields"),
        ("name: !!python/object/apply:os.getcwd []", "is no YAML"),
    ],
)
def test_files_that_hold_no_message_are_refused(tmp_path, text, fault):
    with pytest.raises(InputError, match=fault):
        read(tmp_path, text)


def test_missing_files_are_named(tmp_path):
    with pytest.raises(InputError, match=r"no planning scene '.*none.yaml'; check the path"):
        scene_from_moveit(tmp_path / "none.yaml")
    with pytest.raises(InputError, match="is a folder"):
        scene_from_moveit(tmp_path)
    path = tmp_path / "latin.yaml"
    path.write_bytes(b"name: \xe9\xff")
    with pytest.raises(InputError, match="is no YAML"):
        read_message(path, "planning scene", ["name"])
