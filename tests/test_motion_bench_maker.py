"""The published problems are read as they are, planned scene by scene, and summed up."""

import dataclasses
import json
import re
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import tyro
import yaml

from experiments import contenders, motion_bench_maker, run_all
from experiments.by_scene import ALL, RIVALS
from experiments.measure import MissingProblems
from experiments.motion_bench_maker import EXPERIMENT, MotionBenchMakerConfig
from experiments.moveit_folder import problems_of_folder
from experiments.record import run
from experiments.registry import EXPERIMENTS
from experiments.results import load_results
from gnnjax.arm.robot import load_robot
from gnnjax.errors import InputError
from gnnjax.evaluate import EvaluateConfig
from gnnjax.problems.file import save_problems
from gnnjax.problems.shards import load_problems
from tests.stand_in import StandIn

TURN = {"position": [0.0, 0.0, 3.0], "orientation": [0, 0, 0, 1]}


def write_problem(folder: Path, names: tuple[str, str], start: float, boxes: int) -> None:
    folder.mkdir(exist_ok=True, parents=True)
    objects = [
        {
            "id": f"box {i}",
            "primitives": [{"type": "box", "dimensions": [0.1, 0.2, 0.3]}],
            "primitive_poses": [TURN],
        }
        for i in range(boxes)
    ]
    ends = [{"joint_name": name, "position": 0.5 * i} for i, name in enumerate("abc")]
    request = {
        "start_state": {"joint_state": {"name": ["a", "b", "c"], "position": [start, 0.0, 0.0]}},
        "goal_constraints": [{"joint_constraints": ends}],
    }
    for name, message in zip(
        names, ({"world": {"collision_objects": objects}}, request), strict=True
    ):
        (folder / name).write_text(yaml.safe_dump(message))


@pytest.fixture
def published(tmp_path):
    """Two scenes in folders and one in flat files: the first has an end beyond a limit, the second
    a problem that is not solved."""
    folder = tmp_path / "published"
    for number, start in ((1, 0.1), (12, 9.0)):
        names = f"scene{number:04}.yaml", f"request{number:04}.yaml"
        write_problem(folder / "cage_panda", names, start, boxes=number)
    for number, start in ((2, 0.2), (3, 0.5)):
        names = f"scene{number:04}.yaml", f"request{number:04}.yaml"
        write_problem(folder / "table_pick_panda", names, start, boxes=1)
    write_problem(folder, ("box_scene0004.yaml", "box_request0004.yaml"), 0.3, boxes=2)
    (folder / "config.yaml").write_text("not: read")
    return folder


def test_folders_and_flat_files_become_one_set(published, tiny_path, tmp_path):
    robot = load_robot(tiny_path)
    found = problems_of_folder(published, robot)
    names = list(zip(found.extras["scene"].tolist(), found.extras["index"].tolist(), strict=True))
    assert names == [("box", 4), ("cage", 1), ("cage", 12), ("table_pick", 2), ("table_pick", 3)]
    np.testing.assert_array_equal(found.problems.scene.mask.sum(axis=1), [2, 1, 12, 1, 1])
    np.testing.assert_allclose(found.problems.start[:, 0], [0.3, 0.1, 9, 0.2, 0.5], rtol=1e-6)
    save_problems(tmp_path / "set.npz", found)
    assert len(load_problems(tmp_path / "set.npz", robot)) == 5
    (published / "box_request0004.yaml").unlink()
    with pytest.raises(InputError, match=r"no request '.*box_request0004.yaml'; check the path"):
        problems_of_folder(published, robot)
    with pytest.raises(InputError, match=r"no sceneNNNN.yaml below '.*cage_panda/none'"):
        problems_of_folder(published / "cage_panda" / "none", robot)


@pytest.fixture
def planners(monkeypatch):
    """Stand-ins, by name; and threads in place of processes, which would import JAX for seconds."""
    made = {}

    def stand_in(case):
        name = f"{case.planner}{'@simplified' * case.simplify}"
        cost = {"guided": 2.0, "ompl:rrt_connect@simplified": 3.0}.get(name, 5.0)
        return made.setdefault(name, StandIn(load_robot(case.robot), cost))

    monkeypatch.setattr(motion_bench_maker, "start_workers", ThreadPoolExecutor)
    for module in (motion_bench_maker, contenders):
        monkeypatch.setattr(module, "planner_of", stand_in)
    monkeypatch.setattr(motion_bench_maker, "processes_of", lambda case, num: stand_in(case))
    return made


def test_scenes_are_planned_kept_and_summed_up(published, tiny_path, tmp_path, planners):
    folders = {key: tmp_path / key for key in ("data", "runs", "results")}
    config = MotionBenchMakerConfig(robot=str(tiny_path), folder=published, **folders)
    results = run(EXPERIMENT, config)
    assert results == load_results(tmp_path / "results" / "motion_bench_maker.json")
    rows = {(row["scene"], row["planner"]): row for row in results["rows"]}
    assert len(rows) == len(results["rows"]) == 4 * 4
    for planner in ("guided", *RIVALS):
        counts = {
            scene: (rows[scene, planner]["num_problems"], rows[scene, planner]["num_accepted"])
            for scene in ("box", "cage", "table_pick", ALL)
        }
        assert counts == {"box": (1, 1), "cage": (2, 1), "table_pick": (2, 2), ALL: (5, 4)}
        row = rows[ALL, planner]
        assert (row["success_of_all"], row["success"], row["certified"]) == (3 / 5, 3 / 4, 3 / 5)
        assert row["configuration_checks"]["median"] == 9
        assert row["total_time_s"]["median"] > 0.5  # with the check of the query
    # One at a time and all at once, each twice, the first of which is untimed; then all scenes.
    assert planners["guided"].batches == [1, 1, 1, 1] + [1, 1, 1, 1] + [1] * 4 + [2, 2] + [4, 4]
    (folder,) = (tmp_path / "runs").iterdir()
    together = json.loads((folder / "pool_guided.json").read_text())
    assert rows[ALL, "guided"]["per_s"] == pytest.approx(4 / together["wall_s"])
    found = EXPERIMENT.verdict(results)
    better = "on the 3 that both solve the mean cost is 2.00, that of RRT-Connect, simplified, 3.00"
    assert better in found.split("What")[0]
    assert "4 of 5 problems have both ends free; 3 of these 4 are solved" in found.split("What")[1]
    table = EXPERIMENT.table(results)
    assert "| cage | guided | 2 | 1 | 50.0 | 100.0 | 50.0 | 2.00 | 2.00 | 9 |" in table
    assert len(re.findall(r"^\| all scenes", table, re.M)) == 4

    # What was cut off goes on with what lacks; nothing else is planned again.
    (kept,) = (tmp_path / "runs").iterdir()
    (kept / "cage_guided.json").unlink()
    planners.clear()
    again = run(EXPERIMENT, dataclasses.replace(config, folder=None))
    assert planners.keys() == {"guided"}
    assert planners["guided"].batches == [1] * 4
    assert len(again["rows"]) == 16
    # Other settings are planned anew.
    run(EXPERIMENT, dataclasses.replace(config, num_problems=1))
    assert planners.keys() == {"guided", "ompl:rrt_connect", "ompl:bit_star", RIVALS[1]}


def test_joints_may_be_held(published, tiny_path, tmp_path):
    for path in published.rglob("*request*.yaml"):  # whose goal holds c, too
        text = path.read_text().replace("position: 1.0", "position: 0.25")
        path.write_text(text)
    options = tyro.cli(MotionBenchMakerConfig, args=["--hold", "c", "0.25"])
    assert options.hold == (("c", 0.25),)
    config = dataclasses.replace(
        options, robot=str(tiny_path), folder=published, data=tmp_path, runs=tmp_path / "runs"
    )
    _, head = motion_bench_maker.measurement(config)
    assert head["settings"]["hold"] == {"c": 0.25}
    case = EvaluateConfig(
        robot=str(tiny_path),
        hold=config.hold,
        json=tmp_path / "x",
        problems=tmp_path / f"{tiny_path.stem}_motion_bench_maker.npz",
    )
    assert contenders.robot_of(case).num_dof == 2
    assert contenders.problems_of(case).start.shape == (5, 2)


def test_costs_are_compared_on_what_both_solve():
    turn = {"wall_s": 1.0, "cores": 1.0, "accepted": [True] * 3, "certified": [True] * 3}
    turn |= {"configuration_checks": [1] * 3, "total_time_s": [1.0] * 3}
    ours = turn | {"success": [True, True, False], "cost": [1.0, 2.0, None]}
    theirs = turn | {"success": [False, True, True], "cost": [None, 3.0, 20.0]}
    row = motion_bench_maker._row("s", "p", [[theirs]], [[ours]])
    assert row["both"] == {"num": 1, "cost": 3.0, "guided": 2.0}
    assert row["cost"]["mean"] == 11.5


def test_published_costs_are_told_beside(published, tiny_path, tmp_path, planners):
    problems = problems_of_folder(published, load_robot(tiny_path))
    problems.extras["vamp_simplified_cost"] = np.array([1.0, 2, 3, 4, 5])
    save_problems(tmp_path / "set.npz", problems)
    config = MotionBenchMakerConfig(
        robot=str(tiny_path),
        problems=tmp_path / "set.npz",
        runs=tmp_path / "runs",
        results=tmp_path / "results",
    )
    results = run(EXPERIMENT, config)
    told = {r["scene"]: r for r in results["rows"] if r["planner"] == "vamp_simplified_cost"}
    assert told["cage"]["cost"]["mean"] == 2.5
    assert told["cage"]["cost_where_guided_solves"] == 2
    assert told[ALL]["cost"]["mean"] == 3
    assert told[ALL]["cost_where_guided_solves"] == pytest.approx((1 + 2 + 4) / 3)
    assert "VAMP's published mean cost, simplified, is 2.33" in EXPERIMENT.verdict(results)
    assert "| cage | VAMP, simplified, as published | 2 | - |" in EXPERIMENT.table(results)
    assert EXPERIMENT.draw(results).axes


def test_where_no_problem_is_valid_nothing_is_claimed(published, tiny_path, tmp_path, planners):
    problems = problems_of_folder(published, load_robot(tiny_path))
    save_problems(tmp_path / "set.npz", problems.take(np.array([2])))
    config = MotionBenchMakerConfig(
        robot=str(tiny_path),
        problems=tmp_path / "set.npz",
        runs=tmp_path / "runs",
        results=tmp_path / "results",
    )
    results = run(EXPERIMENT, config)
    assert EXPERIMENT.verdict(results) == "Does not hold: 0 of 1 problems have both ends free."
    assert "| cage | guided | 1 | 0 | 0.0 | - | 0.0 | - | - | - |" in EXPERIMENT.table(results)


def test_missing_problems_are_named_and_the_other_experiments_run(tmp_path, monkeypatch, capsys):
    config = MotionBenchMakerConfig(data=tmp_path)
    with pytest.raises(MissingProblems, match=r"no problem set .*; name the folder"):
        motion_bench_maker.measurement(config)
    with pytest.raises(InputError, match=r"no folder .*none"):
        motion_bench_maker.measurement(dataclasses.replace(config, folder=tmp_path / "none"))
    with pytest.raises(InputError, match="are both given"):
        motion_bench_maker.measurement(
            dataclasses.replace(config, folder=tmp_path, problems=tmp_path / "set.npz")
        )
    with pytest.raises(InputError, match="must be at least 1"):
        motion_bench_maker.measurement(dataclasses.replace(config, processes=0))
    ran = []

    def stand_in(experiment, config):
        if experiment.name == "motion_bench_maker":
            raise MissingProblems("they are not there")
        ran.append(experiment.name)

    monkeypatch.setattr(run_all.record, "run", stand_in)
    run_all.run(run_all.RunAllConfig(quick=True, data=tmp_path))
    assert ran == [name for name in EXPERIMENTS if name != "motion_bench_maker"]
    assert "left as it was: they are not there" in capsys.readouterr().out
