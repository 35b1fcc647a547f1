"""Results become a database with the tables that Planner Arena reads."""

import contextlib
import json
import sqlite3

import pytest

from gnnjax.errors import InputError
from gnnjax.measure.result_files import FORMAT
from gnnjax.planner_arena import ArenaConfig, planner_arena

SETTINGS = {
    "planner": "guided",
    "num_nodes": 200,
    "problems": "data/some.npz",
    "robot": "kuka_iiwa14",
    "num_problems": 3,
    "time_limit": 5.0,
    "seed": 0,
    "shorten": True,
    "sampled": False,
    "simplify": False,
}


def row(index, **changes):
    zeros = dict.fromkeys(("edge_checks", "configuration_checks", "sampling_checks"), 4)
    return {
        **zeros,
        "search_checks": 0,
        "index": index,
        "valid": True,
        "hard": True,
        "success": True,
        "certified": True,
        "roadmaps": 1,
        "planning_time_s": 0.25,
        "total_time_s": 0.5,
        "cost": 3.0,
        **changes,
    }


def write(path, **changes):
    failed = row(1, success=False, certified=False, cost=None)
    results = {
        "format": FORMAT,
        "complete": True,
        "settings": SETTINGS | changes.pop("settings", {}),
        "machine": {"gnnjax": "0.2.0", "processor": "some"},
        "summary": {},
        "problems": [row(0), failed, row(2, valid=False, success=False)],
    }
    path.write_text(json.dumps(results | changes))
    return path


def test_runs_are_those_of_the_files_by_problems_and_planner(tmp_path):
    files = [
        write(tmp_path / "a.json"),
        write(
            tmp_path / "b.json",
            settings={"planner": "ompl:rrt_connect", "simplify": True},
            machine={"gnnjax": "0.2.0", "processor": "some", "ompl": "2.0.1"},
        ),
        write(tmp_path / "c.json", settings={"problems": "data/other.npz"}),
    ]
    out = planner_arena(ArenaConfig(results=tuple(files), out=tmp_path / "arena.db"))
    with sqlite3.connect(out) as database:
        ask = database.execute
        assert ask("SELECT name, totaltime, runcount FROM experiments").fetchall() == [
            ("kuka_iiwa14 some", 2.0, 2),
            ("kuka_iiwa14 other", 1.0, 2),
        ]
        assert ask("SELECT name FROM plannerConfigs").fetchall() == [
            ("guided, 200 nodes",),
            ("ompl:rrt_connect, simplified",),
            ("guided, 200 nodes",),
        ]
        found = "SELECT experimentid, plannerid, time, solved, solution_length, description"
        joined = "FROM runs JOIN enums ON enums.name = 'status' AND value = status"
        assert ask(f"{found} {joined} ORDER BY runs.id").fetchall() == [
            (1, 1, 0.5, 1, 3.0, "certified path"),
            (1, 1, 0.5, 0, None, "no path"),
            (1, 2, 0.5, 1, 3.0, "certified path"),
            (1, 2, 0.5, 0, None, "no path"),
            (2, 3, 0.5, 1, 3.0, "certified path"),
            (2, 3, 0.5, 0, None, "no path"),
        ]
        types = {name: kind for _, name, kind, *_ in ask("PRAGMA table_info(runs)")}
        assert {types["time"], types["solved"], types["status"]} == {"REAL", "BOOLEAN", "ENUM"}
    database.close()


def test_planners_of_one_title_are_told_apart_but_for_their_seeds(tmp_path):
    dear = {"settings": {"check_cost": 1000.0}}
    files = [write(tmp_path / "a.json"), write(tmp_path / "dear.json", **dear)]
    files += [write(tmp_path / "b.json", settings={"seed": 1}), write(tmp_path / "held.json")]
    held = json.loads(files[-1].read_text())
    held["settings"]["attach"] = "held.json"
    files[-1].write_text(json.dumps(held))
    files.append(write(tmp_path / "open.json"))
    held["settings"] |= {"attach": None, "hold": [["finger", 0.04]]}
    files[-1].write_text(json.dumps(held))

    def rows(files, query):
        out = planner_arena(ArenaConfig(results=tuple(files), out=tmp_path / "arena.db"))
        with contextlib.closing(sqlite3.connect(out)) as database:
            return [name for (name,) in database.execute(query)]

    names = "SELECT name FROM plannerConfigs"
    assert rows([files[0], files[2]], names) == ["guided, 200 nodes"] * 2
    titles = ["guided, 200 nodes", "guided, 200 nodes, checks of 1000 us", "guided, 200 nodes"]
    assert rows(files[:3], names) == titles
    (tmp_path / "one").mkdir()
    alike = [files[0], write(tmp_path / "one" / "a.json", settings={"batch_size": 4})]
    titles = [f"guided, 200 nodes ({name})" for name in (f"{tmp_path.name}/a", "one/a")]
    assert rows(alike, names) == titles
    assert rows(files, "SELECT id FROM experiments") == [1, 2, 3]


def test_results_are_not_written_over(tmp_path):
    path = write(tmp_path / "a.json")
    before = path.read_text()
    with pytest.raises(InputError, match=r"a\.json' would be written, and is also read from"):
        planner_arena(ArenaConfig(results=(path,), out=path))
    assert path.read_text() == before


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"complete": False}, "holds results that were cut off; run gnnjax.evaluate again"),
        ({"problems": []}, "holds results without rows; run gnnjax.evaluate again$"),
        ({"problems": [], "parts": []}, "without rows; .* again, without --keep-parts$"),
        ({"format": 1}, "holds results of another version"),
        ({"problems": [{"index": 0}]}, "holds no results; gnnjax.evaluate writes such"),
        (None, "no results '.*missing.json'"),
    ],
)
def test_what_is_no_finished_result_is_refused(tmp_path, changes, message):
    path = tmp_path / "missing.json"
    if changes is not None:
        path = write(tmp_path / "results.json", **changes)
    out = tmp_path / "arena.db"
    out.write_text("as before")
    with pytest.raises(InputError, match=message):
        planner_arena(ArenaConfig(results=(path,), out=out))
    assert out.read_text() == "as before"


def test_no_files_are_no_database():
    with pytest.raises(InputError, match="no results are named"):
        planner_arena(ArenaConfig(results=()))
