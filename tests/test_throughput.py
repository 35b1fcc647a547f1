"""The throughput experiment clocks whole arrays of problems, goes on, and judges within turns."""

import dataclasses
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from experiments import contenders, throughput
from experiments.record import run
from experiments.results import load_results
from experiments.throughput import EXPERIMENT, Contender, ThroughputConfig
from gnnjax.arm.robot import load_robot
from gnnjax.errors import InputError
from gnnjax.problems.file import save_problems
from gnnjax.problems.problem import Problem, ProblemSet
from gnnjax.problems.shards import load_problems
from gnnjax.scene.scene import box_scene
from tests.stand_in import StandIn


@pytest.fixture
def problems(tiny_path, tmp_path):
    """Ten problems: the third is not solved, the last starts beyond a limit."""
    starts = np.zeros((10, 3), np.float32)
    starts[2], starts[9] = 0.5, 5.0
    boxes = np.full((10, 1, 3), 0.1, np.float32)
    quats = np.tile(np.array([1, 0, 0, 0], np.float32), (10, 1, 1))
    scene = box_scene(boxes + 3, boxes, quats, np.ones((10, 1), bool))
    path = tmp_path / "ten.npz"
    goals = np.linspace(0.1, 1.0, 30, dtype=np.float32).reshape(10, 3)
    save_problems(path, ProblemSet(load_robot(tiny_path).name, Problem(starts, goals, scene)))
    return path


@pytest.mark.usefixtures("small_figures")
def test_turns_are_clocked_kept_and_summed_up(tiny_path, tmp_path, problems, monkeypatch):
    stand_ins = {}

    def stand_in(case):
        key = case.planner, case.shorten, case.simplify
        return stand_ins.setdefault(key, StandIn(load_robot(case.robot)))

    # Threads in place of processes, each of which would import JAX for seconds.
    monkeypatch.setattr(throughput, "start_workers", ThreadPoolExecutor)
    monkeypatch.setattr(throughput, "peak_memory", lambda case, num: 100.0 + num)
    for module in (throughput, contenders):
        monkeypatch.setattr(module, "planner_of", stand_in)
    monkeypatch.setattr(throughput, "processes_of", lambda case, num: stand_in(case))
    folders = {key: tmp_path / key for key in ("data", "runs", "results")}
    config = ThroughputConfig(
        robot=str(tiny_path), problems=problems, pools=(1, 4, 20), singles=3, turns=2, **folders
    )
    results = run(EXPERIMENT, config)
    assert results["peak_memory"] == {"pool": 10, "MiB": 110.0}
    assert results["settings"]["pools"] == [1, 4, 10]
    assert results == load_results(tmp_path / "results" / "throughput.json")
    rows = {(row["stratum"], row["planner"], row["pool"]): row for row in results["rows"]}
    assert len(rows) == len(results["rows"]) == 2 * 8
    # The set fills a pool of 10, which is compared; the others plan once.
    for stratum, num, accepted in (("accepted", 10, 9), ("solved", 8, 8)):
        for planner in ("guided", "guided_roadmap"):
            assert len(rows[stratum, planner, 10]["per_s"]) == 2
            assert len(rows[stratum, planner, 4]["per_s"]) == 1
            assert rows[stratum, planner, 1]["num_problems"] == 3
        for planner, pool in (("guided", 10), ("ompl:rrt_connect", None)):
            row = rows[stratum, planner, pool]
            assert (row["num_problems"], row["num_accepted"]) == (num, accepted)
            assert row["success"] == pytest.approx(8 / accepted)
            assert row["success_of_all"] == pytest.approx(8 / num)
            assert row["certified_paths"] == 1
            assert row["configuration_checks"]["median"] == 9
            assert row["total_time_s"]["mean"] > 0.5  # with the check of the query
    # Batches are about equal. The first turn plans everything twice, at first untimed.
    batches = stand_ins["guided", True, False].batches
    of_first_stratum = [9, 4, 3, 2, 1, 1, 1]
    assert batches[:7] == of_first_stratum
    assert batches[7:14] == of_first_stratum
    assert batches[14] == 9
    assert (tmp_path / "results" / "throughput.png").stat().st_size > 10_000
    assert "All accepted problems (9 of 10)" in throughput.table(results)

    # What was cut off goes on with the turn that lacks; nothing else is planned again.
    (folder,) = (tmp_path / "runs").iterdir()
    (folder / "solved_1.json").unlink()
    stand_ins.clear()
    again = run(EXPERIMENT, config)
    assert stand_ins["guided", True, False].batches == [8, 8]
    stand_ins.clear()
    assert run(EXPERIMENT, config)["rows"] == again["rows"]
    assert not stand_ins
    run(EXPERIMENT, dataclasses.replace(config, singles=2))
    assert stand_ins  # other settings, other turns


def test_a_set_is_generated_where_none_is_named(tiny_path, tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(throughput, "generate", asked.append)
    config = ThroughputConfig(robot=str(tiny_path), data=tmp_path, pools=(1, 30))
    path = throughput._problems(config, str(tiny_path))
    assert (asked[0].split, asked[0].num_problems, asked[0].out) == ("test", 30, path)
    with pytest.raises(InputError, match="must be at least 1"):
        throughput.measurement(dataclasses.replace(config, turns=0))


def test_contenders_stand_beside_their_rivals():
    one, rival, two, simple, *others = throughput.contenders((1, 16, 256, 1024))
    assert (one, two) == (Contender("guided", 256), Contender("guided_roadmap", 256))
    assert rival == Contender("ompl:rrt_connect@simplified", None)
    assert simple == Contender("ompl:rrt_connect", None)
    assert [each.pool for each in others] == [1024, 1024, 16, 16, 1, 1]
    assert throughput.contenders((1, 16, 256, 1024), 1) == [one, rival, two, simple, *others[:2]]
    assert throughput.compared_pool((512, 1024)) == 512


def test_a_verdict_compares_within_turns():
    def row(planner, pool, per_s):
        # RRT-Connect keeps both cores busy, the others one.
        cores = [1.0 + (pool is None)] * 3
        key = {"stratum": "accepted", "planner": planner, "pool": pool}
        return key | {"per_s": per_s, "cores": cores}

    rows = [
        row("guided", 256, [100, 50, 80]),  # 2, 1.25 and 0.8 times
        row("ompl:rrt_connect@simplified", None, [50, 40, 100]),
        row("guided", 1024, [300, 75, 160]),  # 3, 1.5 and 2 times
        row("guided_roadmap", 256, [100, 100, 100]),
        row("ompl:rrt_connect", None, [200, 400, 300]),
        row("guided_roadmap", 1024, [100, 100, 100]),
    ]
    found = throughput.verdict({"settings": {"pools": [256, 1024]}, "rows": rows})
    held, failed = found.split("What does not hold")
    assert "guided plans 80 a second in a pool of 256, 1.25 times RRT-Connect, simplified" in held
    assert "simplified, and 2.50 times as many a second of CPU time" in held
    assert "0.33 times RRT-Connect, and 0.67 times as many a second of CPU time." in failed
    assert "2.00 times as many (guided, all accepted problems)" in failed


def test_another_set_of_the_same_name_is_measured_anew(tiny_path, tmp_path, problems, monkeypatch):
    monkeypatch.setattr(throughput, "peak_memory", lambda case, num: 100.0)
    runs = tmp_path / "runs"
    config = ThroughputConfig(robot=str(tiny_path), problems=problems, runs=runs)
    for _ in range(2):
        throughput.measurement(config)
        assert len(list(runs.iterdir())) == 1
    held = load_problems(problems, load_robot(tiny_path))
    others = held.problems._replace(goal=held.problems.goal[::-1])
    save_problems(problems, dataclasses.replace(held, problems=others))
    throughput.measurement(config)
    assert len(list(runs.iterdir())) == 2
