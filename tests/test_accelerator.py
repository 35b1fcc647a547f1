"""Searches abreast find what the engine finds, and what they find holds."""

import json

import jax
import numpy as np
import pytest

from experiments import abreast
from experiments.accelerator import AcceleratorConfig, accelerator
from gnnjax.collision.certify import certify_path
from gnnjax.collision.checker import make_checker
from gnnjax.errors import InputError
from gnnjax.guide.field import field_guide
from gnnjax.planning.guided import Guided
from gnnjax.planning.load import load_planner
from gnnjax.planning.options import PlannerOptions
from gnnjax.planning.query import path_length
from tests.queries import random_problem

NUM = 24


@pytest.fixture(scope="module")
def problems(tiny):
    rng = np.random.default_rng(11)
    drawn = [random_problem(tiny, rng, num=9) for _ in range(NUM)]
    return jax.tree.map(lambda *x: np.stack(x), *drawn)


def test_candidates_are_the_paths_of_the_engine_or_nearly(tiny, tiny_path, problems, monkeypatch):
    monkeypatch.setattr(abreast, "SIZES", (32,))
    monkeypatch.setattr(abreast, "_FEW", 1)
    options = PlannerOptions(num_nodes=40)
    checker = make_checker(tiny, resolution=options.resolution)
    strategy = Guided(tiny, field_guide(tiny), options)
    search = abreast.AbreastSearch(tiny, strategy, checker, options.resolution)
    found = search(problems, 0)
    plans = load_planner(tiny_path, num_nodes=40, check_cost=100.0).plan_batch(problems)
    solved = found.num[-1] > 0
    bent = found.num[0] > 2
    assert bent.any()
    assert not solved.all()
    for i, plan in enumerate(plans):
        assert plan.success or not solved[i]
        lengths = [
            path_length(points[i, :num])
            for points, num in zip(found.points, found.num[:, i], strict=True)
        ]
        assert all(np.diff(lengths) <= 1e-5)
        if solved[i]:
            path = found.points[0, i, : found.num[0, i]]
            ends = problems.start[i], problems.goal[i]
            assert np.array_equal(path[[0, -1]], np.stack(ends))
            assert certify_path(tiny, jax.tree.map(lambda x, i=i: x[i], problems.scene), path)
            assert lengths[-1] < 1.1 * plan.cost
    assert solved.sum() >= 0.8 * sum(plan.success for plan in plans)
    assert (found.configuration_checks >= found.edge_checks).all()

    # In another order, and beside others, each comes out the same.
    rows = np.arange(NUM)[::-2]
    some = search(jax.tree.map(lambda x: x[rows], problems), 0)
    assert np.array_equal(some.num, found.num[:, rows])
    assert np.array_equal(some.points, found.points[:, rows])


def test_measurements_are_lines_of_a_file(tiny_path, tmp_path):
    file = tmp_path / "rates.jsonl"
    config = AcceleratorConfig(
        out=file, robot=str(tiny_path), parts=("mjx", "labels"), sizes=(64,), roadmaps=(2,), turns=1
    )
    accelerator(config)
    rows = [json.loads(line) for line in file.read_text().splitlines()]
    assert [(row["what"], row["at_once"]) for row in rows] == [("MJX", 64), ("labels", 2)]
    assert all(row["per_s"] > 0 for row in rows)
    assert 0 < rows[0]["free"] < 1
    with pytest.raises(InputError, match="0 is below 1"):
        accelerator(AcceleratorConfig(out=file, turns=0))
