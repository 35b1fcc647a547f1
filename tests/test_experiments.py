"""The experiments run, go on where they were cut off, and sum up as plain NumPy does."""

import dataclasses
import functools
import json
import shlex
from pathlib import Path

import numpy as np
import pytest
import tyro
from flax import nnx

from experiments import arms, crossover, failures, hard, measure, predictor, run_all
from experiments.bounds import (
    BOUNDED,
    bounds_table,
    first_roadmap,
    per_verification,
    verification_table,
)
from experiments.cases import CLASSICAL, GUIDED, OURS, classical_case, own_case
from experiments.hard import strata_table
from experiments.measure import ExperimentConfig
from experiments.price import FINE, Timed, crossovers, faster, total_times, without_overhead
from experiments.record import run
from experiments.registry import EXPERIMENTS
from experiments.results import load_results
from experiments.statistics import statistics, summarize_seeds
from experiments.strata import split
from gnnjax.errors import InputError
from gnnjax.evaluate import EvaluateConfig, evaluate
from gnnjax.generate import generate
from gnnjax.guide.motion import MotionNetwork
from gnnjax.measure.rows import QUANTITIES
from gnnjax.planning.load import load_planner
from gnnjax.problems.families import FAMILIES
from gnnjax.training.weights import save_network


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("experiments")


def quick(name: str, tiny_path: Path, folder: Path) -> tuple[ExperimentConfig, dict]:
    """Runs the quick form of an experiment; all share their runs, as the real ones do."""
    folders = {key: folder / key for key in ("data", "runs", "results")}
    # The tiny arm has no weights of its own.
    more = {"figure7": {"weights": Path("kuka_iiwa14")}}
    experiment = EXPERIMENTS[name]
    options = folders | more.get(name, {})
    config = experiment.config(quick=True, robot=str(tiny_path), **options)
    results = run(experiment, config)
    assert load_results(folder / "results" / f"{name}.json") == results
    return config, results


# One test for all of them, so that they run in one process and compile once. What is tested is what
# experiments make of results: planners have tests of their own, and one stands in for all of ours.
@pytest.mark.usefixtures("experiments_remember", "stand_ins")
def test_quick_forms_write_results_and_figures_and_go_on(tiny_path, folder, monkeypatch):
    planned = []

    @functools.cache
    def stand_in(num_nodes):
        return load_planner(tiny_path, "lazysp", num_nodes=num_nodes)

    def counted(config, planner=None):
        before = config.json.exists() and json.loads(config.json.read_text())["complete"]
        planned.extend([] if before else [config.json.name])
        if not config.is_classical:
            planner = stand_in(config.num_nodes)
        return evaluate(config, planner)

    monkeypatch.setattr(measure, "evaluate", counted)

    def plain(config):
        """Families have tests of their own; here they are as the paper's, of other seeds."""
        seed = ("paper", *FAMILIES).index(config.family)
        return generate(dataclasses.replace(config, family="paper", seed=seed))

    monkeypatch.setattr(measure, "generate", plain)
    # Training has tests of its own.
    monkeypatch.setattr("experiments.training.trained", lambda config: Path("motion"))
    own = {*OURS, "gnn_paper"}
    more = {"ompl:rrt_connect@0.02", "ompl:rrt_connect@simplified"}
    expected = {
        "figure5": own | set(GUIDED) | set(CLASSICAL) | more,
        "figure7": own | set(CLASSICAL) | {"gnn_own", "gnn_lazy_own"},
        "crossover": {*crossover.OWN, *crossover.RIVALS},
        "hard": set(hard.PLANNERS),
        "failures": set(failures.PLANNERS),
        "arms": set(arms.PLANNERS),
    }
    for name, planners in expected.items():
        config, results = quick(name, tiny_path, folder)
        assert results["experiment"] == name
        assert results["claim"] == EXPERIMENTS[name].claim
        assert "|" in EXPERIMENTS[name].table(results)
        assert {row["planner"] for row in results["rows"]} == planners
        assert all("python -m gnnjax.evaluate" in row["command"] for row in results["rows"])
        assert (config.out / f"{name}.png").stat().st_size > 10_000
    # The tables of docs/results.md that need rows problem by problem.
    found = {name: load_results(folder / "results" / f"{name}.json") for name in expected}
    bounds = bounds_table(found["figure5"]["rows"])
    assert len(bounds.splitlines()) == 2 + len(BOUNDED)
    assert "RRT-Connect, simplified" in verification_table(found["figure5"]["rows"])
    assert "guided, network of this arm" in arms.table(found["arms"])
    strata = [row for row in found["hard"]["rows"] if row["set"] == "test"]
    assert "guided" in strata_table(strata)
    own = next(row for row in found["arms"]["rows"] if row["planner"] == "guided_own")
    assert own["to_own"]["edge_checks"] == {"mean": 1.0, "low": 1.0, "high": 1.0}
    # Each case was evaluated once, whoever asked for it.
    assert len(set(planned)) == len(planned)

    # One command for all of them; what was measured is not measured again.
    planned.clear()
    folders = {key: folder / key for key in ("data", "runs", "results")}
    only = ("crossover", "arms")
    run_all.run(run_all.RunAllConfig(quick=True, robot=str(tiny_path), only=only, **folders))
    assert not planned

    # Killed in the middle of one case, before the results of the others were written.
    times = (folder / "results" / "figure5.json").read_text()
    (folder / "results" / "figure5.json").unlink()
    cut = next(path for path in (folder / "runs").iterdir() if "lazysp_30" in path.name)
    half = json.loads(cut.read_text())
    half |= {"problems": half["problems"][:1], "complete": False, "summary": {}}
    cut.write_text(json.dumps(half))
    planned.clear()
    quick("figure5", tiny_path, folder)
    assert planned == [cut.name]
    rows, earlier = (
        {row["planner"]: row for row in json.loads(text)["rows"]}
        for text in ((folder / "results" / "figure5.json").read_text(), times)
    )
    del rows["lazysp"], earlier["lazysp"]
    assert rows == earlier  # times too: nothing was run again


@pytest.mark.usefixtures("small_figures")
def test_networks_are_asked_about_the_edges_of_roadmaps(tiny_path, folder, monkeypatch):
    def train_motion(made):
        """Training has tests of its own."""
        network = MotionNetwork(made.num_points, made.channels, rngs=nnx.Rngs(made.seed))
        made.out.mkdir(parents=True)
        save_network(made.out / "weights.safetensors", network, {})
        return made.out / "weights.safetensors"

    monkeypatch.setattr("experiments.training.train_motion", train_motion)
    folders = {key: folder / key for key in ("data", "runs", "results", "trained")}
    config = predictor.PredictorConfig(quick=True, robot=str(tiny_path), **folders)
    results = run(predictor.EXPERIMENT, config)
    assert {row["network"] for row in results["rows"]} == {"6 points, 16 wide, 2 steps", "shipped"}
    for row in results["rows"]:
        assert 0 <= row["arms"]["tiny"]["area"] <= 1
    # More pieces are more work, by the whole pieces that an edge of 3 rad has.
    coarse, fine = (row["arms"]["tiny"]["operations"] for row in results["rows"][:2])
    assert 4 / 3 < fine / coarse < 2
    assert (folder / "results" / "predictor.png").stat().st_size > 10_000
    lines = predictor.table(results).splitlines()
    assert sum(line.startswith("|") for line in lines) == 2 + len(results["rows"])


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


def test_strata_split_by_upper_ends():
    found = split(np.array([2, 3, 4, 9, np.nan]), {"few": 3, "many": np.inf})
    assert found["few"].tolist() == [True, True, False, False, False]
    assert found["many"].tolist() == [False, False, True, True, False]


def test_reversals_are_turns_of_more_than_a_right_angle():
    path = np.array([[0, 0], [1, 0], [1, 1], [0.5, 0.2], [0, 0]])
    assert failures.reversals(path) == 1
    assert failures.reversals(path[:2]) == failures.reversals(np.zeros((0, 2))) == 0


def test_failures_are_those_of_the_rows():
    def row(success, cost, roadmaps=1, path=((0.0,), (1.0,))):
        path = list(path) if success else []
        return {
            "valid": True,
            "success": success,
            "cost": cost,
            "roadmaps": roadmaps,
            "path": path,
        }

    optimal = [[row(True, 2.0), row(True, 2.0), row(False, None, 8), row(True, 1.0)]]
    back_and_forth = ((0.0,), (2.0,), (1.0,))
    found = [[row(True, 3.0, 1, back_and_forth), row(True, 2.0, 2), row(False, None, 8)]]
    found[0].append(row(True, 1.0))
    measured = failures.failures(found, optimal, np.array([True, False, False, True]))
    # The second was solved on its second roadmap: a dead end on the first.
    assert measured["dead_ends"]["mean"] == pytest.approx(1 / 3)
    assert measured["cost_ratio"]["mean"] == pytest.approx((1.5 + 1.0) / 2)
    assert measured["swinging"]["mean"] == measured["reversals"]["mean"] == pytest.approx(1 / 2)
    assert measured["failure_end_in_voxel"]["mean"] == 0
    assert measured["failure_ends_clear_of_voxels"]["mean"] == 1


def test_checks_are_counted_by_those_of_the_path():
    def row(edges, checks, cost, roadmaps=1, hard=True):
        return {
            "valid": True,
            "hard": hard,
            "success": edges > 0,
            "roadmaps": roadmaps,
            "path": [[0.0]] * (edges + 1) if edges else [],
            "cost": cost,
            "edge_checks": checks,
            "configuration_checks": 10 * checks,
        }

    # Hard and on the first roadmap; the same; put off for another roadmap; no path; not hard.
    found = [[row(2, 6, 3.0), row(4, 4, 4.0), row(3, 9, 5.0, 2), row(0, 7, None, 8)]]
    found[0].append(row(1, 1, 1.0, hard=False))
    shortest = [[row(3, 9, 2.0), row(4, 8, 4.0), row(3, 3, 5.0), row(0, 9, None, 8)]]
    shortest[0].append(row(1, 1, 1.0, hard=False))
    ratios = first_roadmap(found, shortest, shortest, shortest)
    means = {name: part["mean"] for name, part in ratios.items()}
    assert means == pytest.approx(
        {
            "edges": 3,
            "per_edge": 2,
            "share": 2 / 3,
            "per_guided_edge": (6 / 3 + 4 / 4) / 2,
            "per_shortest_edge": (6 / 3 + 4 / 4 + 9 / 3) / 3,
            "cost_ratio": (1.5 + 1) / 2,
        }
    )
    measured = per_verification(found, 0.1)
    assert measured["hard"]["median"] == pytest.approx(np.median([60 / 30, 40 / 40, 90 / 50]))
    assert measured["all"]["mean"] == pytest.approx(np.mean([60 / 30, 40 / 40, 90 / 50, 10 / 10]))


def test_a_quick_look_leaves_the_real_results_alone():
    assert ExperimentConfig().out == Path("results")
    assert ExperimentConfig(quick=True).out == Path("runs/quick")
    assert ExperimentConfig(quick=True, results=Path("here")).out == Path("here")


def test_one_command_runs_all_experiments_there_are():
    scripts = Path("experiments").glob("*.py")
    commands = {path.stem for path in scripts if "main(EXPERIMENT)" in path.read_text()}
    assert commands == set(EXPERIMENTS)
    with pytest.raises(InputError, match="no experiment 'figure6'; there are"):
        run_all.run(run_all.RunAllConfig(only=("figure6",)))


def test_an_option_is_named_where_it_is_not_the_default(tmp_path):
    plain = classical_case(tmp_path / "set.npz", "kuka_iiwa14", "ompl:rrt_connect")
    simplified = dataclasses.replace(plain, simplify=True)
    assert measure.slug(plain) == "set_ompl-rrt_connect_200"
    assert measure.slug(simplified) == "set_ompl-rrt_connect_200_simplify-True"
    words = shlex.split(measure.command(simplified))[3:]
    assert tyro.cli(EvaluateConfig, args=words).simplify
    assert "simplify" not in measure.command(plain)
    case = own_case(tmp_path / "set.npz", "kuka_iiwa14", "guided_sampled", 200)
    assert measure.slug(case) == "set_guided_200_shorten-False_sampled-True"
    parsed = tyro.cli(EvaluateConfig, args=shlex.split(measure.command(case))[3:])
    assert (parsed.planner, parsed.shorten, parsed.sampled) == ("guided", False, True)


def test_a_set_with_fewer_problems_than_are_wanted_is_refused(tiny_path, tmp_path):
    config = ExperimentConfig(data=tmp_path)
    path = measure.problem_set(config, str(tiny_path), num_problems=2)
    assert measure.problem_set(config, str(tiny_path), num_problems=2) == path
    with pytest.raises(InputError, match="holds 2 problems, and 3 are wanted; remove it"):
        measure.problem_set(config, str(tiny_path), num_problems=3)
