"""Prices of a check at which planners change places."""

import dataclasses

import numpy as np
import pytest

from experiments.price import FINE, Timed, crossovers, faster, total_times, without_overhead


def timed(time: list, checks: list, **key) -> Timed:
    key = {"set": "test", "planner": "gnn", "num_nodes": 200, "bound": False} | key
    times = np.array([time], float)
    everything = np.ones(times.shape[1], bool)
    return Timed(
        key,
        "",
        times,
        np.array([checks], float),
        np.ones_like(times),
        {"all": everything, "hard": everything},
    )


def test_crossovers_are_where_the_lines_cross():
    guide = timed([2e-3, 4e-3], [300, 500])  # mean 3 ms + 400 c
    cheap = timed([1e-3, 1e-3], [2100, 2900], planner="lazysp")  # mean 1 ms + 2500 c
    small = timed([1e-3, 1e-3], [10, 10], planner="distance")  # better everywhere
    slow = timed([1.0, 1.0], [100, 100], planner="ompl:bit_star", num_nodes=None)
    bound = without_overhead(slow)  # 100 c: better everywhere
    np.testing.assert_allclose(
        total_times(guide, "all", np.array([0.0, 1e-3])),
        [[[2e-3, 4e-3]], [[0.302, 0.504]]],
    )
    found = {
        (row["rival"], row["bound"]): row
        for row in crossovers([guide, cheap, small, slow, bound])
        if row["stratum"] == "all" and row["average"] == "mean"
    }
    step = FINE[1] / FINE[0]
    crossing = 2e-3 / 2100
    assert 1 <= found["lazysp", False]["from_s"] / crossing < step
    assert found["lazysp", False]["intervals_s"][0][1] == FINE[-1]
    assert found["distance", False] == found["distance", False] | {
        "from_s": None,
        "intervals_s": [],
    }
    # Faster while checks are cheap, and slower from (1 - 0.003) / 300 s on.
    (low, high), *rest = found["ompl:bit_star", False]["intervals_s"]
    assert not rest
    assert low == FINE[0]
    assert 1 / step < high / (0.997 / 300) <= 1
    assert found["ompl:bit_star", False]["from_s"] is None
    assert found["ompl:bit_star", True]["intervals_s"] == []
    # At 0.1 s a check, 200 and 400 checks more than the bound has.
    expected = {"mean": -30.003, "low": -40.004, "high": -20.002}
    assert found["ompl:bit_star", True]["saved_s"] == pytest.approx(expected)


def test_who_is_told_the_price_of_a_check_is_another_where_it_is_high():
    dear = timed([5e-3, 5e-3], [10, 20])
    told = dataclasses.replace(timed([1e-3, 2e-3], [300, 500]), dear=dear)
    found = total_times(told, "all", np.array([9e-6, 11e-6]))
    expected = [[1e-3 + 300 * 9e-6, 2e-3 + 500 * 9e-6], [5e-3 + 10 * 11e-6, 5e-3 + 20 * 11e-6]]
    np.testing.assert_allclose(found[:, 0], expected)


def test_faster_names_all_intervals():
    price = np.arange(6.0)
    ours, theirs = np.array([1, 3, 3, 1, 3, 1]), np.full(6, 2)
    assert faster(price, ours, theirs) == {
        "from_s": 5.0,
        "intervals_s": [[0, 0], [3, 3], [5, 5]],
    }
