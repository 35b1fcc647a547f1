"""The experiments run, and go on where they were cut off."""

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
from experiments.cases import CLASSICAL, GUIDED, OURS, classical_case, nodes_of, own_case
from experiments.hard import strata_table
from experiments.measure import ExperimentConfig
from experiments.record import run
from experiments.registry import EXPERIMENTS
from experiments.results import load_results
from gnnjax.errors import InputError
from gnnjax.evaluate import EvaluateConfig, evaluate
from gnnjax.generate import generate
from gnnjax.guide.motion import MotionNetwork
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
            planner = stand_in(30)
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
    cut = next((folder / "runs").rglob("*lazysp_30*.json"))
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


def test_a_planner_that_searches_no_roadmaps_is_one_for_all_sizes(tmp_path):
    def case(planner, num_nodes):
        return own_case(tmp_path / "set.npz", "kuka_iiwa14", planner, num_nodes)

    for planner in ("guided", "guided@0.02"):
        assert case(planner, 200) == case(planner, 1000)
        assert nodes_of(case(planner, 1000)) is None
    for planner in (*{*GUIDED, *OURS} - {"guided"}, "gnn_paper"):
        assert nodes_of(case(planner, 1000)) == 1000
    assert nodes_of(case("ompl:rrt_connect@simplified", 1000)) is None


def test_sizes_that_files_of_earlier_versions_tell_are_left_out(tmp_path):
    rows = [
        {"set": name, "planner": planner, "num_nodes": size, "cost": cost}
        for name in ("test", "public")
        for planner in ("guided", "guided_dear")
        for size, cost in ((200, 1.0), (1000, 2.0))
    ]
    path = tmp_path / "figure5.json"
    path.write_text(json.dumps({"format": 1, "experiment": "figure5", "rows": rows}))
    found = load_results(path)["rows"]
    kept = [row for row in found if row["planner"] == "guided"]
    assert [(row["set"], row["num_nodes"], row["cost"]) for row in kept] == [
        ("test", None, 1.0),
        ("public", None, 1.0),
    ]
    assert [row for row in found if row["planner"] != "guided"] == [
        row for row in rows if row["planner"] != "guided"
    ]
    # Set beside the roadmaps of others, a planner has a row for each size of theirs.
    path.write_text(json.dumps({"format": 1, "experiment": "failures", "rows": rows}))
    assert load_results(path)["rows"] == rows


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


def test_what_an_older_planner_has_made_is_not_read(tmp_path, monkeypatch):
    asked = []

    def evaluate_once(case, planner):
        asked.append(case.json)
        return {"problems": []}

    monkeypatch.setattr(measure, "evaluate", evaluate_once)
    monkeypatch.setattr(measure, "_planner", lambda settings: None)
    config = ExperimentConfig(runs=tmp_path, seeds=(0,))
    case = own_case(tmp_path / "set.npz", "kuka_iiwa14", "lazysp", 200)
    for code in ("1" * 64, "1" * 64, "2" * 64):
        monkeypatch.setattr(measure, "code_digest", lambda code=code: code)
        measure.measure_problems(config, case)
    assert asked[0] == asked[1] == tmp_path / "11111111" / "set_lazysp_200_seed0.json"
    assert asked[2] == tmp_path / "22222222" / "set_lazysp_200_seed0.json"


def test_a_set_with_fewer_problems_than_are_wanted_is_refused(tiny_path, tmp_path):
    config = ExperimentConfig(data=tmp_path)
    path = measure.problem_set(config, str(tiny_path), num_problems=2)
    assert measure.problem_set(config, str(tiny_path), num_problems=2) == path
    with pytest.raises(InputError, match="holds 2 problems, and 3 are wanted; remove it"):
        measure.problem_set(config, str(tiny_path), num_problems=3)
