"""Arms that hold something: whoever knows the arm knows what it holds."""

import functools
import inspect
import json
import re

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from gnnjax.arm.blocks import box_cover, cylinder_cover
from gnnjax.arm.robot import load_robot
from gnnjax.collision.certify import certify_path
from gnnjax.collision.checker import make_checker
from gnnjax.collision.clearances import clearances
from gnnjax.errors import InputError
from gnnjax.guide.field import field_guide
from gnnjax.planning.query import check_queries
from gnnjax.plot import draw_plan
from gnnjax.pose.goal import tool_frame
from gnnjax.problems.file import save_problems
from gnnjax.problems.problem import Problem, ProblemSet
from gnnjax.problems.shards import load_problems
from gnnjax.scene.allowed import allow_contacts, last_link
from gnnjax.scene.holding import attach, attach_from_json
from gnnjax.scene.mujoco_world import build_world, deepest_contact, place_obstacles
from gnnjax.scene.pose import Pose
from gnnjax.scene.scene import make_scene, scene_from_shapes
from gnnjax.scene.shapes import box, capsule, cylinder, half_space, sphere
from tests.conftest import TINY
from tests.draws import random_configurations

NUM = 300  # configurations in every batch: kernels are compiled once
TURNED = np.array([0.8, 0.0, 0.6, 0.0])
# Far enough from each other that each meets something where the others do not.
THINGS = {
    "box": box([0.3, 0.02, 0.0], [0.1, 0.02, 0.06], TURNED),
    "sphere": sphere([0.2, 0.3, 0.0], 0.06),
    "cylinder": cylinder([0.2, -0.3, 0.0], 0.05, 0.08, TURNED),
    "capsule": capsule([0.5, 0.0, 0.0], 0.03, 0.2, [0.7071, 0, 0.7071, 0]),
}


@pytest.fixture(scope="module")
def holding(tiny):
    return tiny.attach("lower", list(THINGS.values()), mass=2.0)


@pytest.fixture(scope="module")
def scene():
    rng = np.random.default_rng(3)
    return make_scene(rng.uniform(-0.9, 0.9, (8, 3)), rng.uniform(0.05, 0.25, (8, 3)))


def depths(robot, scene, q):
    contacts = [deepest_contact(robot, scene, x) for x in q]
    return np.array([contact.depth if contact else 0.0 for contact in contacts])


@functools.cache
def kernel(robot, backend):
    return jax.jit(make_checker(robot, backend).check_configurations)


def test_kernel_and_certificate_agree_with_mujoco_on_what_is_held(tiny, holding, scene):
    q = random_configurations(np.random.default_rng(0), holding, NUM)
    clear = clearances(holding, scene, q, most=0.0) > 0
    valid = np.asarray(kernel(holding, "fused")(scene, q))
    assert not (clear | valid)[depths(holding, scene, q) > 1e-5].any()
    # Each thing matters somewhere where nothing else does.
    bare, alone = depths(tiny, scene, q), {}
    for kind, thing in THINGS.items():
        alone[kind] = depths(tiny.attach("lower", [thing]), scene, q)
    met = np.array([bare, *alone.values()]) > 0
    for kind, found in alone.items():
        by_it = (found > 2e-3) & (met.sum(axis=0) == 1)
        assert by_it.sum() > 5, kind
        assert not (clear | valid)[by_it].any()
    # Hulls may be thicker by a millimetre or two in the kernel.
    grown = scene._replace(half_extents=scene.half_extents + 5e-3)
    free = depths(holding, grown, q) == 0
    assert (clear & valid)[free].mean() > 0.98


def test_the_engine_pairs_what_is_held_just_as_planning_does(holding):
    scene = make_scene([], [])
    model = build_world(holding, len(scene.mask))
    data = mujoco.MjData(model)
    place_obstacles(model, data, scene)
    q = random_configurations(np.random.default_rng(1), holding, 400)
    clear, met = clearances(holding, scene, q, most=0.0) > 0, []
    for x in q:
        data.qpos[:] = x
        mujoco.mj_forward(model, data)
        met.append((data.contact.dist[: data.ncon] < 0).any())
    met = np.array(met)
    assert 10 < met.sum() < len(q) - 10
    assert not (clear & met).any()
    assert (clear == ~met).mean() > 0.98  # but for half a millimetre around cylinders


def test_it_is_kept_clear_of_the_link_just_before_the_one_that_holds_it(tiny):
    short = tiny.attach("lower", [box([0.3, 0, 0], [0.02, 0.02, 0.02])])
    names = {frozenset(short.parts[p].name for p in two) for two in short.part_pairs.tolist()}
    others = {part.name for part in short.parts[:-1] if short.bodies[part.body].name != "lower"}
    assert {frozenset((short.parts[-1].name, name)) for name in others} <= names
    free = tiny.attach("lower", [box([0.3, 0, 0], [0.02, 0.02, 0.02])], allow=["middle"])
    assert len(free.part_pairs) == len(short.part_pairs) - 1


def ball_at_the_end(robot):
    """A ball where the far end of what is held is at zero, and that nothing else touches."""
    rows = robot.sphere_parts == len(robot.parts) - 1
    data = mujoco.MjData(robot.mj_model)
    mujoco.mj_kinematics(robot.mj_model, data)
    body = robot.parts[-1].body + 1
    centers = robot.sphere_centers[rows] @ data.xmat[body].reshape(3, 3).T + data.xpos[body]
    return scene_from_shapes([sphere(centers[np.linalg.norm(centers, axis=1).argmax()], 0.02)])


def seen_by_backend(backend):
    def free(robot, scene, q):
        return bool(kernel(robot, backend)(scene, np.tile(q, (NUM, 1)))[0])

    return free


def seen_by_the_guide(robot, scene, q):
    guide = field_guide(robot)
    prices = guide.prices(guide.weights, guide.read(guide.weights, scene))
    return float(prices.nodes(jnp.asarray(q, jnp.float32)[None])[0]) < 0.5


def seen_by_the_query(robot, scene, q):
    problems = jax.tree.map(lambda x: np.asarray(x)[None], Problem(q, q, scene))
    (reason,) = check_queries(robot, problems)
    return not re.search(r"held_\w+ and sphere 0 overlap", reason or "")


CONSUMERS = {
    "fused": seen_by_backend("fused"),
    "MJX": seen_by_backend("mjx"),
    "certificate": lambda robot, scene, q: certify_path(robot, scene, q[None]),
    "clearance": lambda robot, scene, q: clearances(robot, scene, q[None])[0] > 0,
    "MuJoCo": lambda robot, scene, q: deepest_contact(robot, scene, q) is None,
    "guide": seen_by_the_guide,
    "query": seen_by_the_query,
}


@pytest.mark.parametrize("consumer", CONSUMERS)
def test_no_consumer_forgets_what_is_held(tiny, holding, consumer):
    scene, q = jax.tree.map(jnp.asarray, ball_at_the_end(holding)), np.zeros(3, np.float32)
    assert CONSUMERS[consumer](tiny, scene, q)
    assert not CONSUMERS[consumer](holding, scene, q)


def test_pictures_show_it(tiny, holding, tmp_path):
    path, scene = random_configurations(np.random.default_rng(0), tiny, 3), make_scene([], [])
    draw_plan(tiny, scene, path, tmp_path / "bare.svg")
    draw_plan(holding, scene, path, tmp_path / "holding.svg")
    assert (tmp_path / "holding.svg").stat().st_size > 2 * (tmp_path / "bare.svg").stat().st_size


@pytest.mark.parametrize(
    "size", [(0.03, 0.03, 0.1), (0.1, 0.15, 0.004), (0.2, 0.01, 0.01), (0.02, 0.02, 0.02)]
)
def test_covers_enclose_boxes_and_cylinders_and_their_inner_balls_do_not_stick_out(size):
    rng, size = np.random.default_rng(0), np.array(size)
    points = rng.uniform(-size, size, (4000, 3))
    points[:3000] = np.sign(points[:3000]) * np.maximum(np.abs(points[:3000]), size - 1e-6)
    radius, around = size[0], 1.01 * size[0]
    beside = np.linalg.norm(points[:, :2], axis=1) <= around
    covers = {
        "box": (box_cover(size, 0.015), points),
        "cylinder": (cylinder_cover(radius, size[2], around, 0.015), points[beside]),
    }
    for kind, (cover, inside) in covers.items():
        assert 0 < len(cover.radii) <= 12
        apart = np.linalg.norm(inside[:, None] - cover.centers, axis=-1)
        assert (apart <= cover.radii).any(axis=1).all()
        ends = size[2] - np.abs(cover.centers[:, 2])
        sides = (size[:2] - np.abs(cover.centers[:, :2])).min(axis=1)
        if kind == "cylinder":
            sides = radius - np.linalg.norm(cover.centers[:, :2], axis=1)
        assert (cover.depths <= np.minimum(ends, sides)).all()


def test_what_is_held_alike_is_held_by_the_same_arm(tiny):
    def held(half_length=0.06, **how):
        things = [THINGS["sphere"], cylinder([0.3, 0, 0], 0.03, half_length)]
        return tiny.attach("lower", things, **{"mass": 1.0, "allow": ["middle"], **how})

    pose = (np.zeros(3), [2.0, 0, 0, 0])
    for same in ({}, {"allow": ["middle", "middle"]}, {"pose": pose}):
        assert held(**same) is held()
    for other in ({"half_length": 0.061}, {"mass": 2.0}, {"allow": []}, {"mass": None}):
        assert held(**other) is not held()
        assert held(**other).name != held().name


def test_its_mass_and_inertia_are_in_the_model_and_the_arm_is_as_it_was(tiny):
    before = tiny.mj_model.body_mass.copy()
    thing = THINGS["box"].values
    robot = tiny.attach(
        "lower",
        [box([0, 0, 0], thing["half_extents"])],
        pose=Pose(np.array(thing["center"]), 3 * thing["quat"]),
        mass=2.0,
    )
    np.testing.assert_array_equal(tiny.mj_model.body_mass, before)
    assert robot.mj_model.body_mass.sum() == pytest.approx(before.sum() + 2.0)
    body = robot.mj_model.body(robot.bodies[robot.parts[-1].body].name)
    x, y, z = (2 * np.array(thing["half_extents"])) ** 2
    expected = np.sort([y + z, x + z, x + y]) * 2.0 / 12
    np.testing.assert_allclose(np.sort(body.inertia), expected, rtol=1e-6)
    np.testing.assert_allclose(body.ipos, thing["center"], atol=1e-9)
    assert "2 kg" in robot.notes[-1]
    # The same placed directly, without a mass.
    placed = tiny.attach("lower", [THINGS["box"]])
    np.testing.assert_allclose(placed.parts[-1].vertices, robot.parts[-1].vertices, atol=1e-9)
    assert placed.mj_model.body_mass.sum() == pytest.approx(before.sum())


def test_links_that_are_called_like_what_is_held_are_none_of_it(tmp_path):
    path = tmp_path / "held_arm.xml"
    path.write_text(TINY.replace('"lower"', '"held_camera_mount"').replace('"middle"', '"held_x"'))
    for choice in ({}, {"allow": [("upper", "held_camera_mount")]}):
        robot = load_robot(path, **choice)
        assert robot.held_bodies == ()
        assert tool_frame(robot).name == "held_camera_mount"
        holding = robot.attach("held_x", [THINGS["box"]]).attach("upper", [THINGS["box"]])
        (body, other), last = holding.held_bodies, last_link(holding)
        assert holding.bodies[last].name == tool_frame(holding).name == "held_camera_mount"
        holders = [holding.bodies[holding.bodies[b].parent].name for b in (body, other)]
        assert holders == ["held_x", "upper"]
    with pytest.raises(InputError, match="no body 'held' in"):
        allow_contacts(robot, make_scene([[1, 0, 0]], [[0.1] * 3]), [("held", "box 0")])


def test_an_arm_that_holds_two_things_is_no_other_arm(tiny, holding, tmp_path):
    other = tiny.attach("lower", [THINGS["box"]])
    both = other.attach("middle", [sphere([0.1, 0.0, 0.15], 0.03)])
    assert len({robot.name for robot in (tiny, holding, other, both)}) == 4
    assert [part.name for part in both.parts[-2:]] == ["held_box_0", "held_sphere_0"]
    for part, g in zip(both.parts, both.part_geoms.tolist(), strict=True):
        assert both.mj_model.geom_bodyid[g] == part.body + 1
    # The last that was taken is what problems are about, whichever link holds it.
    holders = "middle", "lower"
    turned = functools.reduce(lambda arm, body: arm.attach(body, [THINGS["box"]]), holders, tiny)
    found = [turned.bodies[turned.bodies[b].parent].name for b in turned.held_bodies]
    assert tuple(found) == holders
    scene = make_scene([], [])
    problems = jax.tree.map(lambda x: np.asarray(x)[None], Problem(tiny.home, tiny.home, scene))
    save_problems(tmp_path / "p.npz", ProblemSet(other.name, problems))
    assert len(load_problems(tmp_path / "p.npz", other).problems.start) == 1
    with pytest.raises(InputError, match="is for robot 'tiny_holding_"):
        load_problems(tmp_path / "p.npz", tiny)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"body": "hand"}, r"no body 'hand' in tiny to hold something; there are \['upper'"),
        ({"body": "foot"}, "body 'foot' of standing is moved by no joint; put what it holds into"),
        ({"shapes": []}, "shapes is empty; name what lower holds, or keep the arm as it is"),
        ({"shapes": THINGS["box"]}, r"shapes is Shape.* give a list of box\(...\)"),
        ({"shapes": [1]}, r"shapes is \[1\]; give a list of box"),
        ({"shapes": [THINGS["box"]._replace(kind="cone")]}, "shapes has a 'cone'; there are only"),
        ({"shapes": [half_space([0, 0, 0], [0, 0, 1])]}, "is to hold a half_space, which has no"),
        ({"shapes": [sphere([0, 0, 0], -1.0)]}, "sphere 0 of what lower holds has radius"),
        (
            {"shapes": [sphere([0, 0, 0], 5.0)]},
            "what lower holds touches .* in every configuration; if it may, let allow name",
        ),
        ({"pose": Pose(np.zeros(3), np.zeros(4))}, "pose is Pose.* give a position"),
        ({"pose": (np.zeros(3), "up")}, "pose is .* give a position and a quaternion"),
        ({"pose": (np.zeros(2), np.ones(4))}, "pose is .* give a position"),
        ({"mass": -1.0}, "mass is -1.0; it must be positive"),
        ({"allow": ["wrist"]}, "no body 'wrist' in tiny to allow; there are"),
        ({"allow": "middle"}, "allow is 'middle'; give a list of names"),
    ],
)
def test_what_cannot_be_held_is_refused_in_one_sentence(tiny, tiny_path, tmp_path, change, message):
    robot = tiny
    if change.get("body") == "foot":
        path = tmp_path / "standing.xml"
        path.write_text(
            tiny_path.read_text().replace("<worldbody>", '<worldbody><body name="foot"/>')
        )
        robot = load_robot(path)
    arguments = {"body": "lower", "shapes": [THINGS["box"]], **change}
    with pytest.raises(InputError, match=message):
        robot.attach(**arguments)


def test_a_mass_that_is_no_number_is_refused(tiny):
    with pytest.raises(InputError, match="mass is '1 kg'; give a number"):
        inspect.unwrap(attach)(tiny, "lower", [THINGS["box"]], mass="1 kg")


def test_an_arm_of_a_relative_path_holds_things_in_whatever_folder(
    tiny_path, tmp_path, monkeypatch
):
    (tmp_path / "m.obj").write_text(
        "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4"
    )
    mesh = '<asset><mesh name="m" file="m.obj" scale="0.1 0.1 0.1"/></asset></mujoco>'
    text = tiny_path.read_text().replace("</mujoco>", mesh)
    look = '<geom type="mesh" mesh="m" contype="0" conaffinity="0"/></worldbody>'
    text = text.replace("</worldbody>", look)
    (tmp_path / "arm.xml").write_text(text)
    monkeypatch.chdir(tmp_path)
    robot = load_robot("arm.xml")
    monkeypatch.chdir("/")
    assert len(robot.attach("lower", [sphere([0.3, 0, 0], 0.02)]).parts) == len(robot.parts) + 1


def test_a_file_says_what_is_held(tiny, tmp_path):
    path = tmp_path / "held.json"
    given = {"center": [0.3, 0.02, 0.0], "half_extents": [0.1, 0.02, 0.06], "quat": TURNED.tolist()}
    path.write_text(json.dumps({"body": "lower", "boxes": [given], "mass": 1}))
    robot = attach_from_json(tiny, path)
    assert robot.name == tiny.attach("lower", [THINGS["box"]], mass=1.0).name


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"boxes": []}, "names no body; write"),
        ([1], "names no body; write"),
        ({"body": "lower", "mass": "heavy", "boxes": []}, "has mass = 'heavy'; give a number"),
        ({"body": "lower", "mass": 10**400, "boxes": []}, "has mass = 10+.*; give a number .kg"),
        ({"body": "lower", "allow": "all"}, "has allow = 'all'; give a list of names"),
        (
            {"body": "lower", "bowls": []},
            r"\['bowls'\], .* only \['boxes', .*'body', 'mass', 'allow'\]",
        ),
        (
            {"body": "lower", "boxes": [{"center": [0, 0, 0]}]},
            "box 0 of .* has half_extents = None",
        ),
    ],
)
def test_a_file_that_says_something_else_is_refused(tiny, tmp_path, data, message):
    path = tmp_path / "held.json"
    path.write_text(json.dumps(data))
    with pytest.raises(InputError, match=message):
        attach_from_json(tiny, path)
