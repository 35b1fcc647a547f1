"""Results of experiments are summed up as plain NumPy does."""

import numpy as np
import pytest

from experiments import predictor
from experiments.statistics import statistics, summarize_seeds
from experiments.strata import split
from gnnjax.measure.rows import QUANTITIES


def test_the_pareto_front_leaves_out_what_costs_more_for_less():
    points = [(3.0, 0.7), (1.0, 0.5), (2.0, 0.4), (3.0, 0.8), (4.0, 0.8)]
    assert predictor.pareto(points) == [(1.0, 0.5), (3.0, 0.8)]


def some_rows(rng, num: int) -> list[dict]:
    """Rows of one seed; the same problems are valid and hard for each seed."""
    rows = []
    for index in range(num):
        success = bool(rng.random() < 0.8)
        rows.append(
            {
                "index": index,
                "valid": index != 3,
                "hard": index % 2 == 0,
                "success": success,
                "certified": success,
                "roadmaps": int(rng.integers(1, 3)),
                "cost": float(rng.uniform(2, 9)) if success else None,
                "edge_checks": None,
                **{
                    name: float(rng.uniform(0, 100))
                    for name in QUANTITIES
                    if name not in ("cost", "edge_checks")
                },
            }
        )
    return rows


def test_summaries_over_seeds_are_those_of_the_rows():
    rng = np.random.default_rng(1)
    seeds = [some_rows(rng, 20) for _ in range(3)]
    summary = summarize_seeds(seeds, keep=lambda index: index < 15)
    assert (summary["num_problems"], summary["num_seeds"], summary["num_invalid"]) == (20, 3, 1)
    for stratum in ("all", "hard"):
        chosen = [
            row
            for seed in seeds
            for row in seed
            if row["valid"] and row["index"] < 15 and (row["hard"] or stratum == "all")
        ]
        part = summary[stratum]
        assert part["num_problems"] == len(chosen) / 3
        costs = [row["cost"] for row in chosen if row["success"]]
        checks = [row["configuration_checks"] for row in chosen]
        for name, values in {"cost": costs, "configuration_checks": checks}.items():
            assert part[name]["mean"] == pytest.approx(np.mean(values))
            assert part[name]["median"] == pytest.approx(np.median(values))
            assert part[name]["p95"] == pytest.approx(np.quantile(values, 0.95))
            assert part[name]["low"] < part[name]["mean"] < part[name]["high"]
        assert part["edge_checks"] is None
        assert part["success"]["mean"] == pytest.approx(len(costs) / len(chosen))
        first = [row["success"] and row["roadmaps"] == 1 for row in chosen]
        assert part["success_first_roadmap"]["mean"] == pytest.approx(np.mean(first))


def test_intervals_are_those_of_a_mean_over_problems():
    rng = np.random.default_rng(2)
    # Seeds of a problem agree, so that only the 400 problems count: standard error 1 / 20.
    values = np.tile(rng.normal(size=400), (3, 1))
    found = statistics(values, np.ones(values.shape, bool))
    assert found is not None
    error = 1.96 * values[0].std() / np.sqrt(400)
    assert found["high"] - found["mean"] == pytest.approx(error, rel=0.15)
    assert found["mean"] - found["low"] == pytest.approx(error, rel=0.15)
    assert statistics(values, np.zeros(values.shape, bool)) is None


def test_strata_split_by_upper_ends():
    found = split(np.array([2, 3, 4, 9, np.nan]), {"few": 3, "many": np.inf})
    assert found["few"].tolist() == [True, True, False, False, False]
    assert found["many"].tolist() == [False, False, True, True, False]
