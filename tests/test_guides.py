"""Guides are compared as equals, and the field's calibration is what fits the labels."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from experiments.field_fits import Margins, fit, log_loss_of
from experiments.guide_edges import log_loss, stored_edges
from experiments.guides import GuidesConfig
from experiments.known_guides import BLOCKED, KINDS
from experiments.record import run
from experiments.registry import EXPERIMENTS
from experiments.results import load_results
from gnnjax.arm.robot import load_robot
from gnnjax.collision.checker import make_checker
from gnnjax.collision.clearances import configuration_clearance
from gnnjax.errors import InputError
from gnnjax.planning.load import load_planner
from gnnjax.planning.options import check_options
from gnnjax.problems.families import BOX_FAMILIES
from tests.fine_scan import random_scene
from tests.stand_in import StandIn


@pytest.fixture(scope="module")
def robot(tiny_path):
    return load_robot(tiny_path)


@pytest.fixture(scope="module")
def edges(robot):
    rng = np.random.default_rng(7)
    scenes = jax.tree.map(lambda *x: np.stack(x), *(random_scene(rng) for _ in range(3)))
    found = stored_edges(robot, scenes, 60)
    return found._replace(scenes=jax.tree.map(jnp.asarray, scenes))


def ends(edges):
    return jnp.asarray(edges.starts), jnp.asarray(edges.ends)


def test_stored_edges_are_those_of_the_roadmap_and_labelled_by_the_checker(robot, edges):
    nodes, neighbors = np.asarray(edges.roadmap.nodes), np.asarray(edges.roadmap.neighbors)
    wanted = {
        (min(i, j), max(i, j))
        for i, row in enumerate(neighbors)
        for j, there in zip(row, edges.roadmap.neighbor_mask[i], strict=True)
        if there
    }
    number = {node.tobytes(): i for i, node in enumerate(nodes)}
    found = [
        (number[a.tobytes()], number[b.tobytes()])
        for a, b in zip(edges.starts, edges.ends, strict=True)
    ]
    assert sorted(found) == sorted(wanted)
    checker = make_checker(robot)
    check, check_edges = jax.jit(checker.check_configurations), jax.jit(checker.check_edges)
    for i, (valid, mask) in enumerate(zip(edges.valid, edges.mask, strict=True)):
        scene = jax.tree.map(lambda x, i=i: x[i], edges.scenes)
        free = np.asarray(check(scene, edges.roadmap.nodes))
        np.testing.assert_array_equal(mask, [free[a] and free[b] for a, b in found])
        np.testing.assert_array_equal(valid, check_edges(scene, *ends(edges)).valid)
    assert 0 < edges.valid[edges.mask].mean() < 1


@pytest.mark.parametrize("name", ["length", "oracle"])
def test_tables_say_of_stored_edges_what_prices_say(robot, edges, name):
    guide = KINDS[name].make(robot)
    assert guide.tabulate is not None
    assert guide.stored is not None
    table = guide.tabulate(edges.roadmap)
    stored = jax.jit(guide.stored)
    priced = np.asarray(stored(guide.weights, guide.read(guide.weights, edges.scenes), table))

    @jax.jit
    def motions(scene, own, other):
        prices = guide.prices(guide.weights, guide.read(guide.weights, scene))
        return prices.motions(own, other, 16)

    neighbors = np.asarray(edges.roadmap.neighbors)
    for i, found in enumerate(priced):
        scene = jax.tree.map(lambda x, i=i: x[i], edges.scenes)
        own = jnp.repeat(edges.roadmap.nodes, neighbors.shape[1], axis=0)
        other = edges.roadmap.nodes[neighbors.ravel()]
        each = np.asarray(motions(scene, own, other)).reshape(neighbors.shape)
        mask = np.asarray(edges.roadmap.neighbor_mask)
        np.testing.assert_array_equal(found[mask], each[mask])


def test_the_oracle_knows_and_the_length_knows_nothing(robot, edges):
    scene = jax.tree.map(lambda x: x[0], edges.scenes)
    found = {}
    for name in ("oracle", "length"):
        guide = KINDS[name].make(robot)

        @jax.jit
        def price(scene, starts, ends, guide=guide):
            prices = guide.prices(guide.weights, guide.read(guide.weights, scene))
            return prices.nodes(starts), prices.motions(starts, ends, 16)

        nodes, found[name] = map(np.asarray, price(scene, *ends(edges)))
        assert nodes.shape == (len(edges.starts),)
    free = edges.valid[0] & edges.mask[0]
    np.testing.assert_array_equal(found["oracle"], np.where(free, 0.0, BLOCKED))
    assert not found["length"].any()


def test_the_oracle_checks_no_edge_in_vain(robot, tiny_path):
    rng = np.random.default_rng(3)
    planner = load_planner(
        tiny_path, guide=KINDS["oracle"].make(robot), num_nodes=60, shorten=False, max_roadmaps=1
    )
    solved = 0
    while solved < 3:
        scene = random_scene(rng)
        query = rng.uniform(robot.joint_lower, robot.joint_upper, (2, 3)).astype(np.float32)
        if min(configuration_clearance(robot, scene, q) for q in query) < 0.01:
            continue
        plan = planner.plan(scene, *query)
        if plan.success and len(plan.path) > 2:
            # The straight line, which was refuted, and those of the path.
            assert plan.edge_checks == 1 + len(plan.path) - 1
            solved += 1


def test_the_log_loss_is_that_of_the_definition():
    prices, valid = np.array([0.1, 2.0, 0.7]), np.array([True, False, False])
    free = np.exp(-prices)
    expected = -np.mean(np.log(np.where(valid, free, 1 - free)))
    assert log_loss(prices, valid) == pytest.approx(expected)
    assert np.isfinite(log_loss(np.array([0.0, 1e3]), np.array([False, True])))


def test_a_fit_finds_the_pair_that_labels_were_drawn_with():
    rng = np.random.default_rng(0)
    margin = rng.uniform(-0.1, 0.15, 40_000)
    pair = 0.02, 0.008
    valid = rng.random(len(margin)) < 1 / (1 + np.exp((pair[0] - margin) / pair[1]))
    margins = Margins(margin, valid)
    found = fit(margins)
    assert found == pytest.approx(pair, rel=0.05)
    price = np.logaddexp(0, (pair[0] - margin) / pair[1])
    assert log_loss_of(margins, pair) == pytest.approx(log_loss(price, valid), rel=1e-3)
    for other in ((0.022, 0.008), (0.018, 0.008), (0.02, 0.009), (0.02, 0.007)):
        assert log_loss_of(margins, found) < log_loss_of(margins, other)
    told_apart = fit(Margins(margin, margin > 0.01))
    assert 0 < told_apart[1] < 1e-3
    assert told_apart[0] == pytest.approx(0.01, abs=1e-3)


@pytest.mark.parametrize(
    ("name", "finding"),
    [
        ("guides", "1.00 times the checks and "),
        ("calibrate_field", "takes 1.000 (1.000 to 1.000) times the configuration checks on tiny."),
    ],
)
@pytest.mark.usefixtures("small_figures")
def test_quick_forms_write_results_and_go_on(tiny_path, tmp_path, monkeypatch, name, finding):
    made = []

    def stand_in(robot, options, guide):
        """What is compiled for guides has tests of its own."""
        check_options(options)
        made.append((options.shorten, guide))
        return StandIn(robot)

    monkeypatch.setattr(f"experiments.{name}.own_planner", stand_in)
    # Scenes of all families to fit and train in have tests of their own.
    monkeypatch.setattr("gnnjax.training.motions.BOX_FAMILIES", BOX_FAMILIES[-1:])
    experiment = EXPERIMENTS[name]
    folders = {key: tmp_path / key for key in ("data", "runs", "results")}
    config = experiment.config(quick=True, robot=str(tiny_path), **folders)
    results = run(experiment, config)
    assert load_results(tmp_path / "results" / f"{name}.json") == results
    assert (tmp_path / "results" / f"{name}.png").stat().st_size > 10_000
    assert "|" in experiment.table(results)
    assert finding in experiment.verdict(results)

    assert made
    made.clear()
    assert run(experiment, config) == results
    assert not made  # all was kept


def test_blocks_are_of_the_very_arm_and_problems(tiny_path, tmp_path, monkeypatch):
    told = []

    def folder_of(runs, name, settings, *files):
        told.extend(files)
        raise InputError("enough")

    def problem_set(config, robot, *, family="paper", num_problems):
        return tmp_path / f"{family}_{num_problems}.npz"

    monkeypatch.setattr("experiments.guides.folder_of", folder_of)
    monkeypatch.setattr("experiments.guides.problem_set", problem_set)
    config = GuidesConfig(quick=True, robot=str(tiny_path), results=tmp_path)
    with pytest.raises(InputError, match="enough"):
        run(EXPERIMENTS["guides"], config)
    assert told == [tiny_path, tmp_path / "paper_3.npz", tmp_path / "bin_2.npz"]


def test_a_guide_that_is_none_is_refused():
    config = GuidesConfig(guides=("oracel",), results=Path("nowhere"))
    with pytest.raises(InputError, match=r"guides are \('oracel',\); choose some of \['length'"):
        run(EXPERIMENTS["guides"], config)
