"""The engine: whoever shares the pool, a problem's plan is its own."""

import dataclasses
import functools
import os
import pickle
import subprocess
import sys

import jax
import numpy as np
import pytest

from gnnjax import devices
from gnnjax.arm.robot import load_robot
from gnnjax.clock import Clock
from gnnjax.errors import InputError
from gnnjax.planning import progress
from gnnjax.planning.batch import Batch
from gnnjax.planning.engine import Run
from gnnjax.planning.load import make_planner
from gnnjax.planning.options import make_options
from gnnjax.planning.progress import Limits
from tests.queries import check_path, one, random_problem, same

pytestmark = pytest.mark.usefixtures("all_sizes")

NUM = 16  # scenes, and their shares, fill one padded number: kernels are compiled once


@pytest.fixture(scope="module")
def planner(tiny_path):
    options = make_options("guided", num_nodes=40, max_roadmaps=2, check_cost=100.0)
    return make_planner(load_robot(tiny_path), options)


def run_of(planner, problems, pool, time=np.inf):
    return planner._run(planner._tester(True), problems, 0, pool, Limits(time))


@pytest.fixture(scope="module")
def problems(planner):
    """Hard ones: nine boxes around an arm of a metre."""
    rng = np.random.default_rng(5)
    drawn = [random_problem(planner.robot, rng, num=9) for _ in range(NUM)]
    return jax.tree.map(lambda *x: np.stack(x), *drawn)


@pytest.fixture(scope="module")
def plans(planner, problems):
    return planner.plan_batch(problems)


@pytest.fixture(scope="module")
def cheap(tiny_path):
    """A planner for checks that cost less than a look at the guide."""
    return make_planner(load_robot(tiny_path), make_options("guided"))


@pytest.fixture(scope="module")
def cheap_plans(cheap, problems):
    return cheap.plan_batch(problems)


def test_the_clock_stands_still_while_something_is_made_for_the_first_time(monkeypatch):
    seconds = [0.0]
    monkeypatch.setattr("time.perf_counter", lambda: seconds[0])

    @functools.cache
    def slow(x):
        seconds[0] += 5.0
        return x

    @jax.jit
    def compiled(x):
        seconds[0] += 5.0  # while it is traced
        return x

    clock = Clock()
    for call, function in ((clock.remembered, slow), (clock.call, compiled)):
        for _ in range(2):
            assert call(function, 3) == 3
            assert clock.now() == 0.0
    seconds[0] += 1.0
    assert clock.now() == 1.0


def test_plans_are_the_same_for_whoever_computes_in_double_precision(cheap, problems, cheap_plans):
    with jax.enable_x64(True):
        again = cheap.plan_batch(problems)
    for plan, other in zip(cheap_plans, again, strict=True):
        np.testing.assert_array_equal(plan.path, other.path)


def test_the_field_guides_to_certified_paths(planner, problems, plans):
    assert 5 <= sum(plan.success for plan in plans) < NUM
    assert sum(plan.success and len(plan.path) > 2 for plan in plans) >= 3
    for i, plan in enumerate(plans):
        if plan.success:
            check_path(planner.robot, one(problems, i), plan)


@pytest.mark.parametrize("pool", [1, 2, 16])
def test_plans_do_not_depend_on_who_shares_the_pool(planner, problems, plans, pool):
    # Smaller pools are refilled.
    assert same(run_of(planner, problems, pool).run(), plans)


def test_plans_do_not_depend_on_the_order(planner, problems, plans):
    order = np.random.default_rng(0).permutation(NUM)[:7]
    some = planner.plan_batch(jax.tree.map(lambda x: x[order], problems))
    assert same(some, [plans[i] for i in order])


def test_a_problem_that_is_none_leaves_the_others_alone(planner, problems, plans):
    start = problems.start.copy()
    start[3] = np.nan
    bad = problems._replace(start=start)
    others = [i for i in range(NUM) if i != 3]
    for plan in (planner.plan_batch, lambda bad: planner._plan_batch(bad, 0, Limits())):
        found = plan(bad)
        assert not found[3].success
        assert same([found[i] for i in others], [plans[i] for i in others])


def test_a_batch_says_of_each_invalid_problem_what_plan_says_of_it(planner, problems, plans):
    scene, start, goal = problems.scene, problems.start.copy(), problems.goal.copy()
    start[1], goal[2] = 9.0, np.nan
    half_extents = scene.half_extents.copy()
    half_extents[4, 0] = np.nan
    bad = problems._replace(start=start, goal=goal, scene=scene._replace(half_extents=half_extents))
    found = planner.plan_batch(bad)
    said = ["start has 9 for joint a", "goal has nan for joint a", "half_extents and radii [nan"]
    for i, words in zip((1, 2, 4), said, strict=True):
        assert words in found[i].reason
        assert (found[i].valid, found[i].success) == (False, False)
        assert found[i].configuration_checks == 0
    with pytest.raises(InputError) as error:
        planner.plan(one(scene, 1), start[1], goal[1])
    assert found[1].reason == str(error.value)
    assert sum(plan.valid for plan in found) == len(found) - 3
    assert same([found[0], found[3], *found[5:]], [plans[0], plans[3], *plans[5:]])
    assert planner.plan_batch(jax.tree.map(lambda x: x[:0], problems)) == []


def test_every_check_is_counted_once(planner, problems, monkeypatch):
    counted, test = [], Batch.test

    def note(self, ids, items):
        outcome = test(self, ids, items)
        counted.append((outcome.num_checks.sum(), outcome.num_edges.sum(), len(ids) - len({*ids})))
        return outcome

    monkeypatch.setattr(Batch, "test", note)
    monkeypatch.setattr(devices, "num_cores", lambda: 1)
    more = dataclasses.replace(planner.options, max_roadmaps=4)
    monkeypatch.setattr(planner, "options", more)
    plans = planner.plan_batch(problems)
    checks, edges, twice = np.sum(counted, axis=0)
    assert checks == sum(plan.search_checks for plan in plans)
    assert edges == sum(plan.edge_checks for plan in plans)
    assert twice > 0  # several roadmaps of a problem were in the pool


@pytest.mark.whole
def test_a_batch_is_shared_out_over_devices_and_comes_out_the_same(
    problems, cheap_plans, tiny_path, tmp_path
):
    # One on a straight line, two on the way round, and one without a path: a pool of two each.
    lengths = [len(plan.path) for plan in cheap_plans]
    turned = sorted(range(NUM), key=lambda i: -lengths[i])[:2]
    chosen = [lengths.index(2), *turned, lengths.index(0)]
    assert lengths[turned[1]] > 2
    some = jax.tree.map(lambda x: x[chosen], problems)
    target = tmp_path / "plans.pkl"
    with (tmp_path / "problems.pkl").open("wb") as file:
        pickle.dump(some, file)
    code = f"""
import pickle, jax
from gnnjax import devices, load_planner
devices._LEAST_SHARE = 2
problems = pickle.load(open({str(tmp_path / "problems.pkl")!r}, "rb"))
planner = load_planner({str(tiny_path)!r})
used = set()
run = planner._run
def spy(*args):
    used.add(str(jax.config.jax_default_device))
    return run(*args)
planner._run = spy
plans = planner.plan_batch(problems)
pickle.dump((len(jax.local_devices()), sorted(used), plans), open({str(target)!r}, "wb"))
"""
    environment = os.environ | {"JAX_NUM_CPU_DEVICES": "2"}
    subprocess.run([sys.executable, "-c", code], env=environment, check=True)
    with target.open("rb") as file:
        num, used, found = pickle.load(file)
    assert num == len(used) == 2
    assert same(found, [cheap_plans[i] for i in chosen])


def test_a_batch_is_shared_out_over_cores_and_comes_out_the_same(
    planner, problems, plans, monkeypatch
):
    monkeypatch.setattr(devices, "num_cores", lambda: 3)
    monkeypatch.setattr(devices, "_LEAST_SHARE", 5)
    assert [len(share.numbers) for share in devices.shares_of(NUM)] == [6, 5, 5]
    found = planner.plan_batch(problems)
    assert same(found, plans)


def test_what_no_certificate_proves_is_searched_anew(cheap, problems, cheap_plans, monkeypatch):
    plain, prove, refused = progress.certify_edges, progress.Progress.prove, []

    def certify(*args):
        return plain(*args) & bool(refused)

    def first_refused(self):
        monkeypatch.setattr(progress, "certify_edges", certify)
        asked = [i for i, paths in enumerate(self.unproven) if paths]
        prove(self)
        assert not any(self.unproven)
        if not refused:
            assert all(self.paths[i] is None for i in asked)
            refused.extend(asked)

    monkeypatch.setattr(progress.Progress, "prove", first_refused)
    monkeypatch.setattr(devices, "num_cores", lambda: 1)
    found = cheap.plan_batch(problems)
    bent = [i for i, plan in enumerate(cheap_plans) if plan.success and len(plan.path) > 2]
    assert bent
    assert set(bent) <= set(refused)
    for i, (plan, before) in enumerate(zip(found, cheap_plans, strict=True)):
        assert plan.success == before.success
        if plan.success:
            check_path(cheap.robot, one(problems, i), plan)
        assert (plan.edge_checks > before.edge_checks) == (i in refused)


def test_a_time_limit_acts_between_rounds(planner, problems, plans, monkeypatch):
    hopeless = [i for i, plan in enumerate(plans) if not plan.success]
    some = jax.tree.map(lambda x: x[hopeless], problems)
    free = run_of(planner, some, 16)
    assert not any(plan.success for plan in free.run())
    assert free.batch.rounds.max() > 3

    def spend(self, ids, begin, *, planning=True):
        self.total_time[ids] += 1.0
        return begin

    monkeypatch.setattr(Batch, "spend", spend)
    limited = run_of(planner, some, 16, 8.0)
    for i, plan in enumerate(limited.run()):
        assert not plan.success
        assert limited.batch.rounds[i] <= 8
        if plan.total_time_s > 8:
            assert "; 8 s are over, give it more time" in plan.reason
    assert limited.batch.rounds.sum() < free.batch.rounds.sum() / 2
    assert limited.batch.total_time.max() > 8


def test_where_checks_are_cheap_trees_find_the_paths(
    cheap, problems, plans, cheap_plans, monkeypatch
):
    monkeypatch.setattr(Run, "_search_roadmaps", None)  # nobody asks for it
    found = cheap.plan_batch(problems)
    assert same(found, cheap_plans)
    assert sum(plan.success for plan in found) >= sum(plan.success for plan in plans)
    for i, plan in enumerate(found):
        if plan.success:
            check_path(cheap.robot, one(problems, i), plan)
            if plans[i].success:
                assert plan.cost < 1.3 * plans[i].cost
        else:
            said = "no path in 64 rounds of growing trees from both ends; more effort may find one"
            assert plan.reason == said
    assert np.mean([p.cost for p in found if p.success]) < np.mean(
        [p.cost for p in plans if p.success]
    )


def test_more_effort_is_never_worse(planner, problems, plans, monkeypatch):
    options = dataclasses.replace(planner.options, effort=4, max_roadmaps=8)
    monkeypatch.setattr(planner, "options", options)
    more = planner.plan_batch(problems)
    assert all(b.success >= a.success for a, b in zip(plans, more, strict=True))
    assert sum(b.success for b in more) >= sum(a.success for a in plans)
    assert any(b.roadmaps > a.roadmaps for a, b in zip(plans, more, strict=True))


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("guided", {"effort": 0}, "effort is 0; it must be at least 1"),
        ("lazysp", {"effort": 2}, "effort=2 with planner 'lazysp'; it is for planner 'guided'"),
        ("prm", {"check_cost": 1e3}, "check_cost=1000.0 with planner 'prm'; it is for planner 'gu"),
        ("lazysp", {"weights": "motion"}, "weights=motion with planner 'lazysp'; it is for plann"),
        (
            "ompl:prm",
            {"num_nodes": 99, "time_limit": 1.0},
            "num_nodes=99 with planner 'ompl:prm'; it is",
        ),
        ("ompl:prm", {"max_roadmaps": 2, "time_limit": 1.0}, "max_roadmaps=2 with planner"),
    ],
)
def test_options_that_a_planner_does_not_use_are_refused(planner, name, options, message):
    with pytest.raises(InputError, match=message):
        make_planner(planner.robot, make_options(name, **options))


def test_a_guide_of_ones_own_takes_no_weights(planner):
    options = make_options("guided", weights="motion")
    with pytest.raises(InputError, match="weights=motion with a guide of your own"):
        make_planner(planner.robot, options, planner.strategy.guide)
