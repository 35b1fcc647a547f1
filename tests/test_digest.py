"""The digest of functions: everything that changes what they compute changes it."""

import dataclasses
import functools

import jax.numpy as jnp
import numpy as np
import pytest

from gnnjax.collision import exact
from gnnjax.collision.checker import make_checker
from gnnjax.digest import Undigested, digest
from gnnjax.guide.field import field_guide
from gnnjax.planning.guided import Guided
from gnnjax.planning.options import PlannerOptions
from gnnjax.scene.shapes import box
from gnnjax.surroundings import sources_digest


def first_level(robot, **how):
    checker = make_checker(robot, **how)
    return digest(checker.place, checker.check_each, checker.check_configurations)


@functools.cache
def guide_of(robot):
    return field_guide(robot)


def first_roadmap(robot, guide=None, **options):
    planner = Guided(robot, guide or guide_of(robot), PlannerOptions(**options))
    return digest(planner._first)


def test_what_was_made_twice_has_one_digest(tiny):
    again = dataclasses.replace(tiny)
    assert first_level(tiny) == first_level(again)
    assert first_roadmap(tiny) == first_roadmap(again, field_guide(again))


def nudged(array):
    changed = array.copy()
    changed.flat[-1] = np.nextafter(changed.flat[-1], np.inf, dtype=changed.dtype)
    return changed


@pytest.mark.parametrize(
    "name", ["sphere_centers", "sphere_radii", "sphere_inner_radii", "joint_lower", "joint_upper"]
)
def test_the_last_bit_of_an_arm_counts(tiny, name):
    changed = dataclasses.replace(tiny, **{name: nudged(getattr(tiny, name))})
    assert first_level(changed) != first_level(tiny)


def test_what_an_arm_holds_touches_and_how_its_links_lie_counts(tiny):
    body = tiny.bodies[1]
    moved = body._replace(position=nudged(body.position))
    arms = [
        tiny,
        tiny.attach("lower", [box([0.2, 0, 0], [0.02, 0.02, 0.02])]),
        tiny.attach("lower", [box([0.2, 0, 0], [0.02, 0.02, 0.021])]),
        dataclasses.replace(tiny, sphere_pairs=tiny.sphere_pairs[:-1]),
        dataclasses.replace(tiny, part_pairs=tiny.part_pairs[:-1]),
        dataclasses.replace(tiny, held={"finger": 0.04}),
        dataclasses.replace(tiny, bodies=(tiny.bodies[0], moved, *tiny.bodies[2:])),
    ]
    assert len({first_level(arm) for arm in arms}) == len(arms)


def test_options_and_guides_count(tiny):
    guide = guide_of(tiny)
    found = [
        first_level(tiny),
        first_level(tiny, axis_aligned=True),
        first_roadmap(tiny),
        first_roadmap(tiny, num_nodes=201),
        first_roadmap(tiny, shorten=False),
        first_roadmap(tiny, margin=0.01),
        first_roadmap(tiny, field_guide(tiny, cells=12)),
        first_roadmap(tiny, guide._replace(weights=nudged(np.asarray(guide.weights)))),
    ]
    assert len(set(found)) == len(found)


@pytest.mark.parametrize(
    "name",
    [
        "gnnjax.guide.field.SPACING",  # read in the function itself
        "gnnjax.planning.guided.EDGE_PIECES",
        "gnnjax.search.knowledge.VALID",  # of what is called by what is called
        "gnnjax.roadmap.stored._END_REACH",
    ],
)
def test_a_constant_that_is_set_from_outside_counts(tiny, monkeypatch, name):
    before = first_roadmap(tiny)
    module, _, constant = name.rpartition(".")
    value = getattr(__import__(module, fromlist=["_"]), constant)
    monkeypatch.setattr(name, value + type(value)(1))
    assert first_roadmap(tiny) != before


def test_a_function_that_is_replaced_counts(tiny, monkeypatch):
    before = first_roadmap(tiny)
    monkeypatch.setattr("gnnjax.planning.guided.insert_ends", exact.hulls_of)
    assert first_roadmap(tiny) != before
    monkeypatch.setattr("gnnjax.planning.guided.insert_ends", lambda stored, *ends: stored)
    with pytest.raises(Undigested, match=r"the function tests\.test_digest|test_digest\."):
        first_roadmap(tiny)


def test_a_guide_of_ones_own_has_none(tiny):
    guide = guide_of(tiny)
    own = guide._replace(read=lambda weights, scene: guide.read(weights, scene))
    with pytest.raises(Undigested, match=r"test_a_guide_of_ones_own_has_none"):
        first_roadmap(tiny, own)


class Unknown:
    """Something of somebody else."""


@pytest.mark.parametrize(
    "value", [Unknown, Unknown(), np.array([Unknown()]), iter([]), [{0: open}, Unknown()]]
)
def test_what_is_not_known_has_none(value):
    with pytest.raises(Undigested):
        digest(value)


def test_values_that_differ_have_other_digests():
    round_about = [1]
    round_about.append(round_about)
    values = [
        (), (None,), ("a", "b"), ("ab",), (b"ab",), (("a", "b"),), (["a", "b"],), ("a", ["b"]),
        (0,), (0.0,), (-0.0,), (False,), (1,), (True,), (float("nan"),), ("nan",), (1j,),
        ({"a": 1},), ({"a": 2},), ({"b": 1},), ({"a", "b"},), (["a", "b", ["a", "b"]],),
        (np.zeros(2),), (np.zeros(2, np.float32),), (np.zeros((1, 2)),), (np.zeros(1),),
        (np.float32(0),), (jnp.zeros(2),), (jnp.asarray(0.0),), (np.dtype("f4"),),
        (round_about,), (functools.partial(max, 1),), (functools.partial(max, 2),), (max,),
        (range(3),), (slice(3),), (np,), (jnp,), (np.add,), (np.sin,),
    ]  # fmt: skip
    assert len({digest(*value) for value in values}) == len(values)
    assert digest({"a", "b", "c"}) == digest({"c", "b", "a"})


def test_a_source_file_counts_by_name_and_content(tmp_path):
    found = set()
    (tmp_path / "wing").mkdir()
    for name, text in [("a.py", "x"), ("a.py", "xy"), ("wing/b.py", ""), ("wing/c.py", "x")]:
        (tmp_path / name).write_text(text)
        found.add(sources_digest(tmp_path))
    (tmp_path / "wing" / "c.py").rename(tmp_path / "d.py")
    found.add(sources_digest(tmp_path))
    (tmp_path / "notes.txt").write_text("not a source")
    assert len(found) == 5
    assert sources_digest(tmp_path) in found
