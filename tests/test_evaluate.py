"""Evaluation: what is written, summed up, resumed and refused."""

import dataclasses
import json
import re
import signal
import subprocess
import sys
import time

import jax
import numpy as np
import pytest

from gnnjax.arm.robot import load_robot
from gnnjax.errors import InputError, run_command
from gnnjax.evaluate import EvaluateConfig, evaluate, main
from gnnjax.files import locked
from gnnjax.generate import GenerateConfig, generate
from gnnjax.measure.statistics import summarize
from gnnjax.measure.table import print_summary
from gnnjax.planning.load import make_planner
from gnnjax.planning.planner import GuidedPlanner, SampledPlanner
from gnnjax.planning.query import check_queries
from gnnjax.problems.file import save_problems
from gnnjax.problems.shards import load_problems
from tests.fine_scan import collides_anywhere

pytestmark = pytest.mark.usefixtures("evaluate_with_one_planner")

TIMEOUT = 120.0  # s, for a process that compiles
ROW = (
    "success reason path edge_checks configuration_checks sampling_checks cost planning_time_s "
    "total_time_s certified"
)


@pytest.fixture(scope="module")
def problems(tiny_path, tmp_path_factory):
    """Six problems; in problem 2 a box stands on the goal, in problem 4 the start is off limits."""
    folder = tmp_path_factory.mktemp("problems")
    robot = load_robot(tiny_path)
    generate(
        GenerateConfig(
            split="test", robot=str(tiny_path), num_problems=6, seed=3, out=folder / "good.npz"
        )
    )
    drawn = load_problems(folder / "good.npz", robot)
    scene = jax.tree.map(np.copy, drawn.problems.scene)
    start, goal = drawn.problems.start.copy(), drawn.problems.goal.copy()
    goal[2] = [0.0, 0.0, 0.0]
    scene.centers[2, 0], scene.half_extents[2, 0] = [0.5, 0.0, 0.0], [0.1, 0.1, 0.1]
    start[4, 1] = 2.7
    changed = type(drawn.problems)(start, goal, scene)
    save_problems(folder / "six.npz", type(drawn)(drawn.robot, changed))
    return folder / "six.npz"


def config(tiny_path, problems, out, **changes):
    settings = {"planner": "lazysp", "num_nodes": 40, "max_roadmaps": 2} | changes
    return EvaluateConfig(problems=problems, json=out, robot=str(tiny_path), **settings)


@pytest.fixture(scope="module")
def results(tiny_path, problems, tmp_path_factory):
    out = tmp_path_factory.mktemp("results") / "lazysp.json"
    evaluate(config(tiny_path, problems, out))
    return json.loads(out.read_text())


def test_every_problem_has_a_row_and_paths_hold(tiny_path, problems, results):
    robot = load_robot(tiny_path)
    query = load_problems(problems, robot).problems
    assert results["complete"]
    assert len(results["problems"]) == 6
    assert results["settings"]["planner"] == "lazysp"
    assert results["machine"]["cores"] >= 1
    for i, row in enumerate(results["problems"]):
        assert row.keys() >= set(ROW.split())
        if not row["success"]:
            assert row["reason"]
            assert row["path"] == []
            continue
        path = np.array(row["path"], np.float32)
        np.testing.assert_array_equal(path[[0, -1]], [query.start[i], query.goal[i]])
        assert row["certified"]
        scene = jax.tree.map(lambda x, i=i: x[i], query.scene)
        assert not collides_anywhere(robot, scene, path, step=0.01)
        length = np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
        np.testing.assert_allclose(row["cost"], length, rtol=1e-5)
        assert row["configuration_checks"] == row["sampling_checks"] + row["search_checks"]
        assert row["total_time_s"] > row["planning_time_s"] > 0


def test_invalid_problems_are_counted_and_named(results):
    assert results["summary"]["num_invalid"] == 2
    assert results["summary"]["invalid_problems"] == [2, 4]
    assert "goal [0.0, 0.0, 0.0] is in collision" in results["problems"][2]["reason"]
    assert "start has 2.7 for joint b" in results["problems"][4]["reason"]
    assert results["summary"]["all"]["num_problems"] == 4


def test_the_summary_is_that_of_its_rows(results, capsys):
    rows = results["problems"]
    assert summarize(rows) == results["summary"]
    valid = [row for row in rows if row["valid"]]
    checks = [row["edge_checks"] for row in valid]
    found = results["summary"]["all"]["edge_checks"]
    assert found["mean"] == np.mean(checks)
    assert found["median"] == np.median(checks)
    costs = [row["cost"] for row in valid if row["success"]]
    np.testing.assert_allclose(results["summary"]["all"]["cost"]["std"], np.std(costs))
    hard = [row for row in valid if row["hard"]]
    assert results["summary"]["hard"]["num_problems"] == len(hard)
    print_summary(results)
    printed = capsys.readouterr().out
    assert "2 invalid problems left out: [2, 4]" in printed
    assert re.search(r"checks +checks +\[rad\] +\[ms\] +\[ms\]", printed)


def without_times(rows):
    return [{k: v for k, v in row.items() if not k.endswith("_s")} for row in rows]


def test_a_run_that_was_cut_off_goes_on(tiny_path, problems, results, tmp_path):
    out = tmp_path / "cut.json"
    cut = {**results, "problems": results["problems"][:3], "complete": False, "summary": {}}
    out.write_text(json.dumps(cut))
    resumed = evaluate(config(tiny_path, problems, out))
    assert resumed["problems"][:3] == results["problems"][:3]  # times too: nothing was redone
    assert without_times(resumed["problems"]) == without_times(results["problems"])


def test_rows_of_a_run_that_was_cut_off_are_kept_in_parts(tiny_path, problems, results, tmp_path):
    out = tmp_path / "cut.json"
    cut = {**results, "problems": results["problems"][:3], "complete": False, "summary": {}}
    out.write_text(json.dumps(cut))
    kept = evaluate(config(tiny_path, problems, out, keep_parts=True))
    folder = tmp_path / "cut.json.parts"
    files = [json.loads((folder / name).read_text()) for name in kept["parts"]]
    rows = [row for file in files for row in file["problems"]]
    assert rows[:3] == results["problems"][:3]
    assert without_times(rows) == without_times(results["problems"])


def test_two_evaluations_do_not_share_a_file(tiny_path, problems, tmp_path):
    out = tmp_path / "results.json"
    with locked(out):
        with pytest.raises(InputError, match=r"is being written by process .*; wait until it ends"):
            evaluate(config(tiny_path, problems, out))
    assert not out.exists()


def test_rows_that_are_no_results_are_refused(tiny_path, problems, results, tmp_path):
    out = tmp_path / "bad.json"
    rows = results["problems"]
    for bad in (rows[1:], [1, 2], [{"index": 0}], {"a": 1}, "rows"):
        out.write_text(json.dumps({**results, "problems": bad}))
        with pytest.raises(InputError, match="exists and holds no results; remove it"):
            evaluate(config(tiny_path, problems, out))


def test_a_file_from_before_an_option_has_its_default(tiny_path, problems, results, tmp_path):
    out = tmp_path / "old.json"
    later = ("simplify", "shorten", "sampled")
    settings = {k: v for k, v in results["settings"].items() if k not in later}
    out.write_text(json.dumps({**results, "settings": settings}))
    resumed = evaluate(config(tiny_path, problems, out))
    assert resumed["problems"] == results["problems"]  # times too: nothing was redone
    assert resumed["settings"] == results["settings"]


@pytest.mark.whole
def test_a_killed_run_goes_on_where_it_stopped(tiny_path, problems, results, tmp_path):
    # The six problems fifty times, so that there is time to kill it.
    many = load_problems(problems, load_robot(tiny_path)).take(np.tile(np.arange(6), 50))
    save_problems(tmp_path / "many.npz", many)
    out = tmp_path / "killed.json"
    command = [sys.executable, "-c", "import gnnjax.evaluate as e; e._WRITE_EVERY_S = 0; e.main()"]
    command += ["--robot", str(tiny_path), "--planner", "lazysp", "--num-nodes", "40"]
    command += ["--max-roadmaps", "2", "--problems", str(tmp_path / "many.npz"), "--json", str(out)]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) as process:
        deadline = time.monotonic() + TIMEOUT
        try:
            while not (out.exists() and json.loads(out.read_text())["problems"]):
                assert process.poll() is None, process.stderr.read()
                assert time.monotonic() < deadline
                time.sleep(0.05)
        finally:
            process.send_signal(signal.SIGKILL)
    kept = json.loads(out.read_text())["problems"]
    resumed = evaluate(config(tiny_path, tmp_path / "many.npz", out))["problems"]
    assert 0 < len(kept) < 300
    assert resumed[: len(kept)] == kept
    expected = without_times(results["problems"]) * 50
    assert [row | {"index": i % 6} for i, row in enumerate(without_times(resumed))] == expected


@pytest.mark.parametrize("settings", [{}, {"planner": "guided", "max_roadmaps": 1}])
@pytest.mark.parametrize("kept", [0, 1, 3])
def test_a_run_that_was_cut_off_in_a_batch_comes_to_the_same_rows(
    tiny_path, problems, tmp_path, settings, kept
):
    whole = evaluate(config(tiny_path, problems, tmp_path / "whole.json", **settings))
    out = tmp_path / "cut.json"
    case = config(tiny_path, problems, out, batch_size=4, **settings)
    evaluate(case)
    found = json.loads(out.read_text())
    cut = {"problems": found["problems"][:kept], "complete": False, "summary": {}}
    out.write_text(json.dumps(found | cut))
    resumed = evaluate(case)
    assert resumed["problems"][:kept] == found["problems"][:kept]
    assert without_times(resumed["problems"]) == without_times(whole["problems"])
    assert resumed["settings"] == found["settings"]


def test_a_picture_shows_results_beside_those_of_others(tiny_path, problems, results, tmp_path):
    (tmp_path / "b").mkdir()
    for name in ("one", "other", "b/other", "prm", "dear"):
        changed = json.loads(json.dumps(results))
        changed["settings"]["planner"] = "prm" if name == "prm" else "lazysp"
        if name == "dear":
            changed["settings"] |= {"check_cost": 20.0, "weights": "runs/my/weights.safetensors"}
        changed["summary"]["hard"]["cost"] = None  # nothing solved
        (tmp_path / f"{name}.json").write_text(json.dumps(changed))
    pictures = {"figure": tmp_path / "summary.svg"}
    others = ("other", "b/other", "prm", "dear")
    pictures["beside"] = tuple(tmp_path / f"{name}.json" for name in others)
    found = evaluate(config(tiny_path, problems, tmp_path / "one.json", **pictures))
    assert found["problems"] == results["problems"]  # nothing was planned again
    assert "figure" not in found["settings"]
    # Matplotlib says in comments what it writes as outlines.
    words = (tmp_path / "summary.svg").read_text()
    solved = f"{100 * results['summary']['all']['success']:.1f}"
    of_one_name = f"{tmp_path.name}/other", "b/other"
    titles = [f"lazysp, 40 nodes ({name})" for name in ("one", *of_one_name)]
    dear = "lazysp, 40 nodes, weights my/weights.safetensors, checks of 20 us"
    for title in (*titles, "prm, 40 nodes", dear):
        assert words.count(f"<!-- {title} -->") == 2  # for each row of panels
    assert words.count(f"<!-- {solved} -->") >= 3
    assert "<!-- total time [ms] -->" in words
    assert "<!-- all problems (4) -->" in words


def test_problems_of_one_name_and_another_content_are_not_compared_nor_gone_on_with(
    tiny_path, problems, results, tmp_path, caplog
):
    (tmp_path / "again").mkdir()
    other = tmp_path / "again" / problems.name
    save_problems(other, load_problems(problems, load_robot(tiny_path)).take(slice(None, None, -1)))
    out, old = tmp_path / "out.json", json.loads(json.dumps(results))
    out.write_text(json.dumps(results).replace(str(problems), str(other)))  # as if it was there
    pictures = {"figure": tmp_path / "summary.png", "beside": (out,)}
    case = config(tiny_path, other, tmp_path / "new.json", **pictures)
    with pytest.raises(InputError, match=r"'out' of --beside has problems_sha256 .*; name results"):
        evaluate(case)
    with pytest.raises(InputError, match=r"holds results with problems_sha256 '.*; choose another"):
        evaluate(dataclasses.replace(case, json=out, figure=None, beside=()))
    # Files from before there was one do not tell.
    del old["settings"]["problems_sha256"]
    out.write_text(json.dumps(old))
    same = config(tiny_path, problems, out, figure=tmp_path / "a.png", beside=(out,))
    assert evaluate(same)["problems"] == results["problems"]
    assert "'out' of --beside is older and does not tell which problems it had" in caplog.text


def test_a_picture_that_cannot_be_is_refused_before_planning(
    tiny_path, problems, results, tmp_path, monkeypatch
):
    of_others, rested, cut = (json.loads(json.dumps(results)) for _ in range(3))
    of_others["settings"]["time_limit"] = 1.0
    rested["settings"]["rest_share"] = 0.5
    cut["complete"] = False
    of_arm = json.loads(json.dumps(results))
    of_arm["settings"]["hold"] = [["c", 0.1]]
    written = ("others", of_others), ("rested", rested), ("cut", cut), ("held", of_arm)
    for name, held in written:
        (tmp_path / f"{name}.json").write_text(json.dumps(held))
    figure, out = tmp_path / "summary.png", tmp_path / "out.json"
    others = tuple(tmp_path / f"{name}.json" for name in ("others", "rested", "cut"))
    for pictures, message in (
        ({"figure": tmp_path / "summary.doc"}, "summary.doc' has no known ending; there are"),
        ({"beside": others}, "--beside names results for a picture; give --figure, too"),
        ({"figure": figure, "beside": others[:1]}, r"'others' of .* has time_limit 1.0, not 5.0"),
        ({"figure": figure, "beside": others[1:2]}, r"'rested' of .* has rest_share 0.5, not None"),
        ({"figure": figure, "beside": others[2:]}, "cut.json' holds results that were cut off"),
        (
            {"figure": figure, "beside": (tmp_path / "held.json",)},
            "'held' of .* has hold .*'c', 0.1",
        ),
    ):
        with pytest.raises(InputError, match=message):
            evaluate(config(tiny_path, problems, out, **pictures))
    monkeypatch.setitem(sys.modules, "gnnjax.measure.figure", None)
    with pytest.raises(InputError, match=r"--figure needs the viz extra .*gnnjax\[viz\]"):
        evaluate(config(tiny_path, problems, out, figure=figure))
    assert not out.exists()


class ShortOfMemory:
    """A planner that has room for so many problems."""

    def __init__(self, planner, most, error):
        self.planner, self.most, self.error = planner, most, error
        self.robot, self.radius = planner.robot, planner.radius
        self.sizes = []  # of the batches that were tried

    def warm_up(self, scene, batch_size=1):
        if batch_size <= self.most:  # what is not planned need not be compiled
            self.planner.warm_up(scene, batch_size)

    def plan_batch(self, problems, *, seed=0):
        self.sizes.append(len(problems.start))
        if self.sizes[-1] > self.most:
            raise self.error
        return self.planner.plan_batch(problems, seed=seed)


OUT_OF_MEMORY = jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 9 TB")


@pytest.mark.parametrize("error", [MemoryError(), OUT_OF_MEMORY])
def test_a_batch_that_does_not_fit_is_halved(
    tiny_path, problems, results, tmp_path, capsys, error, planner_once
):
    # Sixteen problems; those that are valid, of the first twenty, sixteen, eight and four.
    many = load_problems(problems, load_robot(tiny_path)).take(np.arange(16) % 6)
    save_problems(tmp_path / "many.npz", many)
    case = config(tiny_path, tmp_path / "many.npz", tmp_path / "halved.json", batch_size=20)
    planner = ShortOfMemory(planner_once(load_robot(tiny_path), case), 4, error)
    found = evaluate(case, planner)
    assert planner.sizes == [16, 8, 4, 4, 4, 4, 4]  # the first that fits is planned once untimed
    said = " ".join(capsys.readouterr().out.split())
    assert "not enough memory for 16 problems at once; batch_size is halved to 8" in said
    assert "not enough memory for 8 problems at once; batch_size is halved to 4" in said
    assert "problems/s" in said
    expected = (without_times(results["problems"]) * 3)[:16]
    rows = without_times(found["problems"])
    assert [row | {"index": i % 6} for i, row in enumerate(rows)] == expected
    assert found["settings"]["batch_size"] == 20


def test_one_problem_that_does_not_fit_and_other_errors_end_the_run(
    tiny_path, problems, tmp_path, planner_once
):
    case = config(tiny_path, problems, tmp_path / "none.json", batch_size=4)
    planner = planner_once(load_robot(tiny_path), case)
    short = ShortOfMemory(planner, 0, OUT_OF_MEMORY)
    with pytest.raises(InputError, match="not enough memory for one problem; ask for fewer nodes"):
        evaluate(case, short)
    assert short.sizes == [4, 2, 1]
    broken = ShortOfMemory(planner, 0, jax.errors.JaxRuntimeError("INTERNAL: broken"))
    with pytest.raises(jax.errors.JaxRuntimeError, match="INTERNAL: broken"):
        evaluate(case, broken)
    assert broken.sizes == [4]


# More of them than a pool of the guided planner holds, and one batch of the others.
@pytest.mark.parametrize(("name", "num", "bad"), [("guided", 18, [0, 7, 11]), ("lazysp", 4, [1])])
def test_problems_that_are_none_leave_the_others_of_their_batch_alone(
    tiny_path, problems, tmp_path, planner_once, name, num, bad
):
    case = config(tiny_path, problems, tmp_path / "unused.json", planner=name)
    planner = planner_once(load_robot(tiny_path), case)
    valid = np.resize([0, 1, 3, 5], num)
    query = load_problems(problems, planner.robot).take(valid).problems
    plans = planner.plan_batch(query)
    assert sum(plan.success for plan in plans) >= num / 2
    functions = planner._compiled(True) if isinstance(planner, SampledPlanner) else ()
    sizes = [f._cache_size() for f in functions]
    for part in ("start", "goal", "centers", "half_extents"):
        changed = jax.tree.map(np.copy, query)
        getattr(changed if part in ("start", "goal") else changed.scene, part)[bad] = np.nan
        assert all(fault for fault in np.array(check_queries(planner.robot, changed))[bad])
        found = planner.plan_batch(changed)
        for i, (one, other) in enumerate(zip(plans, found, strict=True)):
            if i in bad:
                assert not other.valid
                continue
            np.testing.assert_array_equal(one.path, other.path)
            drop = {"path": 0, "planning_time_s": 0, "total_time_s": 0}
            assert one._asdict() | drop == other._asdict() | drop
    assert [f._cache_size() for f in functions] == sizes  # fewer, by the function for all


def test_a_batch_finds_what_single_queries_find(tiny_path, problems, results, tmp_path):
    batched = evaluate(config(tiny_path, problems, tmp_path / "batch.json", batch_size=4))
    assert without_times(batched["problems"]) == without_times(results["problems"])


@pytest.mark.parametrize(
    ("variant", "used"),
    [
        ({}, "branches"),
        ({"check_cost": 100.0}, "first later shortcuts branches"),
        ({"shorten": False, "sampled": True}, "sampled"),
    ],
)
def test_the_guided_planner_is_warm_before_it_is_timed(
    tiny_path, problems, tmp_path, variant, used
):
    case = config(tiny_path, problems, tmp_path / "guided.json", planner="guided", **variant)
    planner = make_planner(load_robot(tiny_path), case)
    assert isinstance(planner, GuidedPlanner)
    query = load_problems(problems, planner.robot).take(slice(1)).problems
    planner.warm_up(jax.tree.map(lambda x: x[0], query.scene))
    own = planner.strategy
    functions = {"first": own._first, "later": own._later, "sampled": own._sampled}
    functions |= {"shortcuts": own.looks.shortcuts, "branches": own.looks.branches}
    assert planner._tester(True)._check._cache_size() >= 1
    sizes = {name: f._cache_size() for name, f in functions.items()}
    assert sorted(name for name, size in sizes.items() if size) == sorted(used.split())
    found = evaluate(case, planner)
    assert {name: f._cache_size() for name, f in functions.items()} == sizes
    assert found["summary"]["all"]["certified"] > 0
    assert found["settings"]["sampled"] is case.sampled
    print_summary(found)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "holds no results; remove it"),
        ('{"format": 0, "settings": {}, "problems": []}', "results of format 0"),
        ('{"format": 2, "settings": {"planner": "prm"}, "problems": []}', "results with"),
        ('{"format": 2, "settings": ["prm"], "problems": []}', "holds no results; remove it"),
    ],
)
def test_a_file_with_something_else_is_kept(tiny_path, problems, tmp_path, text, message):
    out = tmp_path / "other.json"
    out.write_text(text)
    with pytest.raises(InputError, match=message):
        evaluate(config(tiny_path, problems, out))
    assert out.read_text() == text


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--planner", "magic"], "error: no planner 'magic'; there are ['guided',"),
        (["--problems", "missing.npz"], "error: no problem file 'missing.npz'; check the path"),
        (["--robot", "kuka_iiwa14"], "is for robot 'tiny', not 'kuka_iiwa14'"),
        (["--num-nodes", "1"], "error: num_nodes is 1"),
        (["--batch-size", "0"], "error: batch_size is 0"),
        (["--seed", "-1"], "error: seed is -1"),
        (["--sampled"], "error: sampled with planner 'lazysp'; it is for planner 'guided'"),
        (["--no-shorten"], "error: --no-shorten with planner 'lazysp'; it is for planner"),
        (["--json", "."], "error: '.' is a folder; name a file"),
        (["--time-limit", "inf"], "error: time_limit is inf; give a number that is finite"),
        (["--check-cost", "inf"], "error: check_cost is inf; give a number that is finite"),
    ],
)
def test_bad_arguments_are_refused_in_one_line(
    tiny_path, problems, tmp_path, monkeypatch, capsys, arguments, message
):
    out = tmp_path / "out.json"
    words = ["evaluate", "--robot", str(tiny_path), "--planner", "lazysp"]
    words += ["--problems", str(problems), "--json", str(out)]
    monkeypatch.setattr("sys.argv", words + arguments)
    with pytest.raises(SystemExit) as exit_info:
        run_command(main)
    assert exit_info.value.code == 2
    said = capsys.readouterr().err
    assert message in said
    assert len(said.splitlines()) == 1
    assert not out.exists()


def test_the_command_refuses_what_is_not_there(tmp_path, run_as_command):
    words = ["--problems", "missing.npz", "--json", tmp_path / "out.json"]
    status, _, said = run_as_command("gnnjax.evaluate", *words)
    assert status == 2
    assert said.startswith("error: no problem file 'missing.npz'; check the path")
    assert len(said.splitlines()) == 1
