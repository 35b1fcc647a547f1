"""Maps of the joint values at which two parts touch, against MuJoCo's C engine."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from gnnjax.arm.hulls import SIMPLER, simpler_hulls
from gnnjax.arm.robot import load_robot
from gnnjax.collision import contact_cells, fused
from gnnjax.collision.checker import make_checker
from gnnjax.collision.contact_cells import CLEAR, OPEN, TOUCHING
from gnnjax.collision.contact_maps import ContactMaps, contact_maps
from gnnjax.collision.couples import couple_of, reaches
from gnnjax.collision.levels import BLOCKED
from gnnjax.digest import digest
from gnnjax.scene.scene import make_scene
from gnnjax.scene.shapes import sphere
from tests.arms import FOLDING
from tests.draws import random_configurations

MANY = 4000


@pytest.fixture(scope="module")
def folding(tmp_path_factory):
    path = tmp_path_factory.mktemp("robots") / "folding.xml"
    path.write_text(FOLDING)
    return load_robot(path)


@pytest.fixture(scope="module")
def maps(folding):
    """Of all pairs of parts that three joints or fewer move, coarser than those of other arms."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(contact_cells, "_WORTH", {2: -1.0, 3: -1.0})
        patch.setattr(contact_cells, "_BITS", {2: 14, 3: 17})
        return contact_maps.__wrapped__(folding)


def distances(robot, number, q):
    """Of the parts of a pair, m, by the C engine; not above 0 where they touch."""
    model, data, found = robot.mj_model, mujoco.MjData(robot.mj_model), []
    first, second = robot.part_geoms[robot.part_pairs[number]].tolist()
    for row in q:
        data.qpos[:] = row
        mujoco.mj_kinematics(model, data)
        found.append(mujoco.mj_geomDistance(model, data, first, second, 10.0, None))
    return np.array(found)


def codes_of(one, q):
    return np.asarray(one.codes(jnp.asarray(q)))


def test_cells_say_what_the_c_engine_says(folding, maps):
    q = random_configurations(np.random.default_rng(0), folding, MANY)
    # The ends of ranges are in a cell, too.
    q[:50], q[50:100] = folding.joint_lower, folding.joint_upper
    every = maps.alone + maps.beside
    assert {len(one.joints) for one in every} == {2, 3}
    assert any(one.turns.any() for one in every)
    found = np.zeros(3, int)
    for one in every:
        gaps, codes = distances(folding, one.pair, q), codes_of(one, q)
        assert (gaps[codes == CLEAR] > 0).all()
        # Hulls that are tested stand out of the true ones.
        assert (gaps[codes == TOUCHING] < 2 * SIMPLER).all()
        assert (codes == OPEN).mean() < 0.15, one.pair
        found += np.bincount(codes, minlength=3)
    assert found.min() > 100


def test_parts_that_never_touch_need_no_look(folding, maps):
    mapped = {one.pair for one in maps.alone + maps.beside}
    left = np.sort(folding.sphere_parts[maps.pairs], axis=1).tolist()
    never = [
        number
        for number, parts in enumerate(folding.part_pairs.tolist())
        if number not in mapped and sorted(parts) not in left
    ]
    assert never
    q = random_configurations(np.random.default_rng(1), folding, MANY)
    for number in never:
        assert (distances(folding, number, q) > 0).all()


def test_a_full_turn_leads_back_to_the_same_cell(folding, maps):
    one = next(x for x in maps.alone + maps.beside if x.turns.any())
    joint = int(one.joints[one.turns.argmax()])
    q = random_configurations(np.random.default_rng(2), folding, 400)
    q[:, joint] = np.linspace(-5.9, -0.3, len(q))
    turned = q.copy()
    turned[:, joint] += 2 * np.pi
    codes, again = codes_of(one, q), codes_of(one, turned)
    # But for those that rounding takes over the edge of one.
    assert (codes != again).mean() < 0.01
    assert set(codes.tolist()) >= {CLEAR, TOUCHING}


def test_nothing_is_said_of_what_is_no_number_or_out_of_range(folding, maps):
    for one in maps.alone + maps.beside:
        for joint, turns in zip(one.joints.tolist(), one.turns.tolist(), strict=True):
            q = np.tile(folding.home, (4, 1))
            q[:, joint] = np.nan, np.inf, folding.joint_lower[joint] - 1e-3, 1e30
            assert (codes_of(one, q)[[0, 1, 3]] == OPEN).all()
            assert turns or codes_of(one, q)[2] == OPEN


def half_beside(folding, maps):
    """Every other map is asked before spheres are looked at, the others after."""
    every = maps.alone + maps.beside
    parts = [sorted(folding.part_pairs[one.pair].tolist()) for one in every[1::2]]
    of = np.sort(folding.sphere_parts[folding.sphere_pairs], axis=1).tolist()
    own = np.array([pair in parts for pair in of])
    return ContactMaps(every[::2], every[1::2], folding.sphere_pairs[own], maps.pairs)


def test_verdicts_are_those_without_maps(folding, maps, monkeypatch):
    q = jnp.asarray(random_configurations(np.random.default_rng(3), folding, 1500))
    scene = jax.tree.map(lambda x: x[None], make_scene([[9.0, 9.0, 9.0]], [[0.1, 0.1, 0.1]]))
    verdicts, left = [], []
    for some in (
        ContactMaps((), (), np.empty((0, 2), int), folding.sphere_pairs),
        half_beside(folding, maps),
    ):
        monkeypatch.setattr(fused, "contact_maps", lambda robot, some=some: some)
        checker = make_checker(folding)
        first, second = checker.levels
        words = jax.jit(first)(checker.place(scene), jnp.zeros(1, jnp.int32), q[None])[0]
        clear = second.clear_of_itself(q, jnp.ones(len(q), bool))
        is_open = (words > 0) & (words < BLOCKED)
        left.append(is_open.mean())
        verdicts += [(words == 0) | is_open & clear, clear]
    for verdict in verdicts:
        np.testing.assert_array_equal(verdict, verdicts[0])
    assert 0.2 < verdicts[0].mean() < 0.8
    assert left[1] < 0.7 * left[0]


def test_maps_are_made_while_a_function_is_traced(folding, monkeypatch):
    monkeypatch.setattr(contact_cells, "_BITS", {2: 4, 3: 4})
    monkeypatch.setattr(contact_cells, "_TEST", jax.jit(contact_cells._test))

    @jax.jit
    def words(q):
        maps = contact_maps.__wrapped__(folding)
        return maps.words(maps.alone + maps.beside, q)

    assert words(jnp.zeros((3, folding.num_dof))).shape == (3,)


def couples_of(robot):
    """Of every pair of parts that three joints or fewer move: its number, joints and couple."""
    spheres = np.sort(robot.sphere_parts[robot.sphere_pairs], axis=1)
    for number, parts in enumerate(robot.part_pairs.tolist()):
        rows = robot.sphere_pairs[(spheres == sorted(parts)).all(axis=1)]
        found = couple_of(robot, parts, rows, *simpler_hulls(robot))
        if found is not None:
            yield number, *found


def test_no_joint_moves_parts_faster_than_its_bound(folding):
    rng, step, most = np.random.default_rng(4), 1e-3, []
    for number, joints, couple in couples_of(folding):
        for joint, bound in zip(joints.tolist(), reaches(couple), strict=True):
            q = random_configurations(rng, folding, 400).astype(float)
            moved = q.copy()
            moved[:, joint] += step
            before, after = (distances(folding, number, x) for x in (q, moved))
            apart = (before > 0.01) & (after > 0.01)
            rate = np.abs(after - before)[apart].max() / step
            assert rate < bound + 1e-3
            most.append(rate / bound)
    assert len(most) > 10
    assert np.median(most) > 0.7


def test_what_an_arm_holds_changes_none_of_its_maps(folding):
    held = folding.attach("tip", [sphere([0.2, 0.0, 0.0], 0.03)])
    assert len(held.part_pairs) > len(folding.part_pairs)
    couples = [
        {
            tuple(robot.parts[p].name for p in robot.part_pairs[number]): digest(found)
            for number, *found in couples_of(robot)
        }
        for robot in (folding, held)
    ]
    bare, more = couples
    assert bare
    assert {names: more[names] for names in bare} == bare
    parts = {one.pair for one in contact_maps(held).alone + contact_maps(held).beside}
    assert all(number < len(folding.part_pairs) for number in parts)
