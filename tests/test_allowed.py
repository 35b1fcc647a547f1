"""Allowed contacts are left out of every test, and nothing beside them."""

import json
import re
from functools import partial

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from gnnjax.arm.robot import load_robot
from gnnjax.baselines.ledger import Ledger, mujoco_checks
from gnnjax.collision.certify import certify_edges, certify_path, known_obstacles
from gnnjax.collision.checker import make_checker
from gnnjax.collision.clearances import base_clear, clearances
from gnnjax.collision.fused import obstacles_clear
from gnnjax.collision.sequences import Items, SequenceTester
from gnnjax.errors import InputError
from gnnjax.planning.load import own_planner
from gnnjax.planning.options import make_options
from gnnjax.planning.query import check_queries
from gnnjax.problems.file import save_problems
from gnnjax.problems.problem import Problem, ProblemSet
from gnnjax.scene.allowed import allow_contacts
from gnnjax.scene.any_file import read_scene
from gnnjax.scene.batches import stack_scenes
from gnnjax.scene.mujoco_world import build_world, deepest_contact, place_obstacles
from gnnjax.scene.scene import inflated, make_scene, pad_scene, scene_from_shapes
from gnnjax.scene.scene_file import scene_from_json, scene_to_json
from gnnjax.scene.shapes import box, capsule, cylinder, half_space, sphere
from tests.draws import random_configurations

# Parts of many forms, which spheres leave open; the base stands on the world.
ARM = """
<mujoco model="hand">
  <compiler angle="radian" autolimits="true"/>
  <worldbody>
    <geom type="cylinder" size="0.08 0.05" pos="0 0 0.05"/>
    <body name="upper" pos="0 0 0.2">
      <joint name="a" axis="0 0 1" range="-3 3"/>
      <geom type="box" size="0.2 0.05 0.03" pos="0.2 0 0"/>
      <body name="middle" pos="0.4 0 0">
        <joint name="b" axis="0 1 0" range="-2.5 2.5"/>
        <geom type="box" size="0.15 0.03 0.05" pos="0.2 0 0"/>
        <body name="hand" pos="0.4 0 0">
          <joint name="c" axis="0 0.6 0.8" range="-2 2"/>
          <geom type="box" size="0.06 0.1 0.02" pos="0.12 0 0"/>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
SHAPES = [
    box([0.5, 0.3, 0.2], [0.15, 0.05, 0.2], [0.9, 0.1, 0.3, 0.2]),
    box([-0.4, -0.4, 0.3], [0.1, 0.2, 0.1]),
    sphere([0.6, -0.3, 0.4], 0.15),
    capsule([0.2, 0.6, 0.5], 0.06, 0.2, [0.7, 0.7, 0, 0]),
    cylinder([0.0, -0.7, 0.3], 0.1, 0.3),
    half_space([0, 0, -0.1], [0, 0, 1]),
]
MEANT = [
    ("hand", "box 0"),
    ("hand", "half_space 0"),
    ("middle", "sphere 0"),
    ("upper", "cylinder 0"),
    ("hand", "capsule 0"),
    ("middle", "box 0"),
]
NO_CONTACT = 1e-4  # m


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    path = tmp_path_factory.mktemp("robots") / "hand.xml"
    path.write_text(ARM)
    return load_robot(path)


@pytest.fixture(scope="module")
def bare():
    return scene_from_shapes(SHAPES)


@pytest.fixture(scope="module")
def scene(robot, bare):
    return allow_contacts(robot, bare, MEANT)


@pytest.fixture(scope="module")
def checker(robot):
    return make_checker(robot)


def depths_by_mujoco(robot, q, excluded):
    """Deepest contact [m] of the C engine, of whose pairs of bodies some are excluded, `[B]`."""
    spec = robot.mj_spec.copy()
    for name, (kind, size, position, quat) in scene_as_geoms():
        body = spec.worldbody.add_body(name=name, mocap=True, pos=position, quat=quat)
        body.add_geom(type=kind, size=size, contype=-1, conaffinity=-1)
        spec.add_exclude(bodyname1="world", bodyname2=name)
    for pair in excluded:
        spec.add_exclude(bodyname1=pair[0], bodyname2=pair[1])
    model = spec.compile()
    data = mujoco.MjData(model)
    of_obstacles = {model.body(name).id for name, _ in scene_as_geoms()}
    found = []
    for data.qpos[:] in q:
        mujoco.mj_forward(model, data)
        deepest = 0.0
        for contact in data.contact:
            bodies = {int(model.geom_bodyid[g]) for g in contact.geom}
            if not bodies <= of_obstacles:
                deepest = max(deepest, -float(contact.dist))
        found.append(deepest)
    return np.array(found)


def scene_as_geoms():
    """Names and MuJoCo's geoms of `SHAPES`, in the scene's order."""
    geoms, counts = mujoco.mjtGeom, {}
    for shape in sorted(SHAPES, key=lambda shape: ORDER.index(shape.kind)):
        number = counts[shape.kind] = counts.get(shape.kind, -1) + 1
        values = shape.values
        quat = values.get("quat", [1, 0, 0, 0])
        if shape.kind == "box":
            geom = geoms.mjGEOM_BOX, values["half_extents"], values["center"], quat
        elif shape.kind == "half_space":
            geom = geoms.mjGEOM_BOX, [5, 5, 5], np.subtract(values["point"], [0, 0, 5]), quat
        else:
            kind = getattr(geoms, f"mjGEOM_{shape.kind.upper()}")
            size = [values["radius"], values.get("half_length", 0), 0]
            geom = kind, size, values["center"], quat
        yield f"{shape.kind} {number}", geom


ORDER = ("box", "sphere", "capsule", "cylinder", "half_space")


def test_kernels_and_certificate_see_what_the_engine_sees_with_those_pairs_excluded(
    robot, scene, bare, checker
):
    q = random_configurations(np.random.default_rng(0), robot, 1500)
    depths = depths_by_mujoco(robot, q, MEANT)
    everything = depths_by_mujoco(robot, q, [])
    assert ((everything > 5e-3) & (depths == 0)).sum() > 60  # what is meant matters here
    assert (depths > 5e-3).sum() > 300  # and so does all else
    check = jax.jit(checker.check_configurations)
    seen = {
        "kernel": np.asarray(check(scene, q)),
        "clearance": np.asarray(jax.jit(checker.clearance)(scene, q)) > 0,
        "certificate": clearances(robot, scene, q, most=0.0) > 0,
        "sequences": sequences_valid(robot, checker, scene, q),
    }
    for name, free in seen.items():
        assert not free[depths > NO_CONTACT].any(), name
        if name != "clearance":  # of spheres, which stand out
            assert free[depths == 0].mean() > 0.97, name
    for row in np.flatnonzero(depths > 2e-3)[:20]:
        found = deepest_contact(robot, scene, q[row])
        assert found.depth == pytest.approx(depths[row], abs=2e-3)


def sequences_valid(robot, checker, scene, q):
    tester = SequenceTester(robot, checker, 0.05)
    batch = jax.tree.map(lambda x: np.asarray(x)[None], scene)
    each, zeros = np.arange(len(q)), np.zeros(len(q), int)
    items = Items(each, zeros, q, q, zeros > 0)
    return ~tester(tester.place(batch), items, len(q)).refuted


def test_edges_are_certified_just_where_the_engine_finds_nothing_else(robot, scene, bare):
    rng = np.random.default_rng(1)
    starts = random_configurations(np.random.default_rng(2), robot, 300)
    ends = np.clip(
        starts + rng.normal(size=starts.shape) * 0.2, robot.joint_lower, robot.joint_upper
    )
    certified = certify_edges(robot, scene, starts, ends)
    more = certified & ~certify_edges(robot, bare, starts, ends)
    assert more.sum() > 10
    along = np.linspace(starts[more], ends[more], 60).reshape(-1, robot.num_dof)
    assert depths_by_mujoco(robot, along, MEANT).max() == 0


def test_a_scene_in_which_none_is_meant_compiles_and_tests_as_before(robot, bare, checker):
    q = random_configurations(np.random.default_rng(0), robot, 64)
    nothing = allow_contacts(robot, bare, [])
    assert nothing is bare
    meant = allow_contacts(robot, bare, MEANT)
    empty = meant._replace(allowed=meant.allowed._replace(pairs=np.zeros_like(meant.allowed.pairs)))

    def words(scene):
        placed = checker.place(jax.tree.map(lambda x: jnp.asarray(x)[None], scene))
        return checker.levels.first(placed, jnp.zeros(8, int), jnp.asarray(q).reshape(8, 8, -1))

    plain, more = (str(jax.make_jaxpr(words)(scene)) for scene in (bare, meant))
    assert "inf" in more
    assert len(plain) < len(more)
    np.testing.assert_array_equal(jax.jit(words)(bare), jax.jit(words)(empty))
    np.testing.assert_array_equal(clearances(robot, bare, q), clearances(robot, empty, q))


def test_scenes_of_a_batch_and_padded_ones_keep_each_its_own(robot, scene, checker):
    q = random_configurations(np.random.default_rng(3), robot, 200)
    other = allow_contacts(robot, scene_from_shapes(SHAPES[:2]), [("upper", "box 1")])
    none = scene._replace(allowed=scene.allowed._replace(pairs=np.zeros_like(scene.allowed.pairs)))
    several = [scene, none, other, pad_scene(scene, 16)]
    batch, owner = stack_scenes(several), np.tile(np.arange(4), 50)
    alone = [clearances(robot, several[i], q[j][None])[0] for j, i in enumerate(owner)]
    np.testing.assert_array_equal(clearances(robot, batch, q, owner), alone)
    # The last one is the first, but for its padding.
    place, each, free = jax.jit(checker.place), jax.jit(checker.check_each), {}
    for name, scenes, owners in [("batch", several, owner)] + [
        (number, [one] * 3 + several[3:], np.zeros(200, int)) for number, one in enumerate(several)
    ]:
        free[name] = np.asarray(each(place(stack_scenes(scenes)), owners, q[:, None]))[:, 0]
    single = np.stack([free[number] for number in range(4)])
    np.testing.assert_array_equal(free["batch"], single[owner, np.arange(200)])
    np.testing.assert_array_equal(free[0], free[3])
    assert (single[0] != single[1]).any()
    # A margin is kept from all but them.
    thick = clearances(robot, inflated(scene, 0.02), q)
    np.testing.assert_allclose(thick, clearances(robot, scene, q) - 0.02, atol=0.021)


def test_a_fixed_body_may_touch_what_it_stands_on(tmp_path):
    path = tmp_path / "standing.xml"
    path.write_text(
        ARM.replace('<geom type="cylinder"', '<body name="foot"><geom type="cylinder"').replace(
            'pos="0 0 0.05"/>', 'pos="0 0 0.05"/></body>'
        )
    )
    robot = load_robot(path)
    q = np.zeros(3, np.float32)
    stand = scene_from_shapes(
        [box([0, 0, 0], [0.1, 0.1, 0.05]), box([0.1, 0, 0], [0.1, 0.1, 0.03])]
    )
    meant = allow_contacts(robot, stand, [("foot", "box 0")])
    for clear in (
        base_clear(robot, meant),
        jax.jit(partial(obstacles_clear, robot, base_only=True))(meant, q=q),
    ):
        assert np.asarray(clear)[:3].tolist() == [True, False, True]
    batch = jax.tree.map(lambda x: np.asarray(x)[None], Problem(q, q, meant))
    (reason,) = check_queries(robot, batch)
    assert "box 1 of the scene reaches" in reason
    both = allow_contacts(robot, meant, [("foot", "box 1")])
    batch = batch._replace(scene=jax.tree.map(lambda x: np.asarray(x)[None], both))
    assert check_queries(robot, batch) == [None]


def test_a_held_thing_is_put_down_and_its_name_stands_for_it(robot):
    holding = robot.attach("hand", [cylinder([0.25, 0, 0], 0.03, 0.06)], allow=["middle"])
    table = scene_from_shapes([box([1.05, 0, 0.0], [0.2, 0.5, 0.15])])
    start, goal = np.float32([0.2, 0, 0]), np.float32([-0.2, 0, 0])
    batch = Problem(start[None], goal[None], jax.tree.map(lambda x: np.asarray(x)[None], table))
    (reason,) = check_queries(holding, batch)
    assert re.match(r"start .* is in collision: held_\w+ and box 0 overlap by 10\.\d mm", reason)
    meant = allow_contacts(holding, table, [("held", "box 0")])
    planner = own_planner(holding, make_options("guided", num_nodes=64))
    plan = planner.plan(meant, start, goal)
    assert plan.success
    assert plan.certified
    assert certify_path(holding, meant, plan.path)
    assert not certify_path(holding, table, plan.path)
    with pytest.raises(InputError, match="declared for another arm, not hand; name them"):
        certify_path(robot, meant, plan.path)
    with pytest.raises(InputError, match="no body 'held' in hand to touch"):
        allow_contacts(robot, table, [("held", "box 0")])


@pytest.mark.parametrize(
    ("allow", "words"),
    [
        ([("wrist", "box 0")], "no body 'wrist' in hand to touch an obstacle; there are"),
        ([("world", "box 0")], "no body 'world'"),
        ([("hand", "box 2")], "no obstacle 'box 2' to be touched; the scene has"),
        ([("hand", "the cloud")], "no obstacle 'the cloud'"),
        ([("hand", 0)], "give pairs of names"),
        ("hand", "give pairs of names"),
    ],
)
def test_what_is_no_body_or_obstacle_is_named(robot, bare, allow, words):
    with pytest.raises(InputError, match=re.escape(words)):
        allow_contacts(robot, bare, allow)


def test_whoever_cannot_leave_contacts_out_refuses_the_scene(robot, scene, bare, tmp_path):
    q = random_configurations(np.random.default_rng(0), robot, 4)
    model = build_world(robot, len(scene.mask))
    data = mujoco.MjData(model)
    problems = jax.tree.map(lambda x: np.asarray(x)[None], Problem(q[0], q[1], scene))
    # The same in all but the name of a body.
    (tmp_path / "other.xml").write_text(ARM.replace('"hand"', '"tool"'))
    other = load_robot(tmp_path / "other.xml")
    (tmp_path / "other.xml").unlink()
    wrong = scene._replace(allowed=scene.allowed._replace(arm=np.uint32(7)))
    refusals = [
        lambda: place_obstacles(model, data, scene),
        lambda: mujoco_checks(robot, len(scene.mask))(scene, Ledger()),
        lambda: make_checker(robot, "mjx").check_configurations(scene, jnp.asarray(q)),
        lambda: scene_to_json(scene, tmp_path / "scene.json"),
        lambda: save_problems(tmp_path / "set.npz", ProblemSet("hand", problems, {})),
        lambda: clearances(robot, wrong, q),
        lambda: base_clear(robot, wrong),
        lambda: certify_edges(robot, wrong, q[:1], q[1:2]),
        lambda: certify_edges(other, known_obstacles(robot, scene), q[:1], q[1:2]),
        lambda: allow_contacts(robot, wrong, MEANT),
    ]
    for refuse in refusals:
        with pytest.raises(InputError, match="allowed contacts"):
            refuse()
    assert list(tmp_path.iterdir()) == []


def test_scene_files_name_them(robot, tmp_path):
    path = tmp_path / "scene.json"
    lists = {"boxes": [{"center": [0.5, 0.3, 0.2], "half_extents": [0.1, 0.1, 0.1]}]}
    path.write_text(json.dumps({**lists, "allow": [["hand", "box 0"]]}))
    scene = read_scene(path, robot)
    assert np.argwhere(scene.allowed.pairs).tolist() == [[0, 2]]
    with pytest.raises(InputError, match="has allow, contacts that are meant of an arm's bodies"):
        scene_from_json(path)
    path.write_text(json.dumps({**lists, "allow": [["hand", "box 1"]]}))
    with pytest.raises(InputError, match="no obstacle 'box 1'"):
        read_scene(path, robot)
    path.write_text(json.dumps({**lists, "allow": {"hand": "box 0"}}))
    with pytest.raises(InputError, match=r"has allow = .* give a list"):
        read_scene(path, robot)
    path.write_text(json.dumps(lists))
    assert read_scene(path, robot).allowed is None
    assert make_scene([], []).allowed is None
