"""Results as a database for OMPL's Planner Arena (plannerarena.org), which compares and draws them.

python -m gnnjax.planner_arena guided.json rrt_connect.json --out benchmark.db
"""

import contextlib
import dataclasses
import json
import sqlite3
from pathlib import Path
from typing import Any

import tyro

from gnnjax.arguments import parse_arguments
from gnnjax.errors import InputError, run_command
from gnnjax.files import atomic_write, check_apart, check_target
from gnnjax.measure.result_files import OF_ARM, names_of, read_results
from gnnjax.measure.table import titles_of

# The tables of OMPL's ompl_benchmark_statistics.py (Moll, Sucan and Kavraki, 2015), which Planner
# Arena reads; `runs` has further columns for what was measured.
_TABLES = """
CREATE TABLE experiments (id INTEGER PRIMARY KEY AUTOINCREMENT, name VARCHAR(512), totaltime REAL,
  timelimit REAL, memorylimit REAL, runcount INTEGER, version VARCHAR(128), hostname VARCHAR(1024),
  cpuinfo TEXT, date DATETIME, seed INTEGER, setup TEXT);
CREATE TABLE plannerConfigs (id INTEGER PRIMARY KEY AUTOINCREMENT, name VARCHAR(512) NOT NULL,
  settings TEXT);
CREATE TABLE enums (name VARCHAR(512), value INTEGER, description TEXT, PRIMARY KEY (name, value));
CREATE TABLE runs (id INTEGER PRIMARY KEY AUTOINCREMENT, experimentid INTEGER, plannerid INTEGER,
  time REAL, planning_time REAL, solved BOOLEAN, certified BOOLEAN, status ENUM,
  solution_length REAL, edge_checks INTEGER, configuration_checks INTEGER, roadmaps INTEGER,
  straight_line_blocked BOOLEAN,
  FOREIGN KEY (experimentid) REFERENCES experiments(id) ON DELETE CASCADE,
  FOREIGN KEY (plannerid) REFERENCES plannerConfigs(id) ON DELETE CASCADE);
CREATE TABLE progress (runid INTEGER, time REAL, PRIMARY KEY (runid, time),
  FOREIGN KEY (runid) REFERENCES runs(id) ON DELETE CASCADE);
"""
_STATUSES = ("no path", "path", "certified path")


@dataclasses.dataclass(frozen=True, kw_only=True)
class ArenaConfig:
    """Gather results of gnnjax.evaluate in a database for OMPL's Planner Arena."""

    results: tyro.conf.Positional[tuple[Path, ...]]
    """Files that gnnjax.evaluate has written. Those of the same problems become one experiment."""
    out: Path = Path("benchmark.db")
    """The database; one that is there is replaced."""


def planner_arena(config: ArenaConfig) -> Path:
    """Writes the database; invalid problems, which no planner can solve, are no runs.

    Raises:
        InputError: no files, or one that holds no finished results.
    """
    if not config.results:
        raise InputError("no results are named; give files that gnnjax.evaluate has written")
    check_target(config.out)
    check_apart((config.out,), config.results)
    all_results = [read_results(path) for path in config.results]
    files = names_of(config.results)
    called = [files[path] for path in config.results]
    names = _names([results["settings"] for results in all_results], called)
    atomic_write(config.out, lambda file: _write(file, all_results, names))
    return config.out


def _names(all_settings: list[dict[str, Any]], files: list[str]) -> list[str]:
    """What planners are called: runs of one name are taken for one planner's, whatever its seed."""
    titles = titles_of(all_settings)
    apart = {
        *("problems", "problems_sha256", "num_problems", *OF_ARM),
        *("seed", "time_limit", "radius", "robot_sha256"),
    }
    own = [{k: v for k, v in settings.items() if k not in apart} for settings in all_settings]
    alike = [
        all(theirs == mine for theirs, other in zip(own, titles, strict=True) if other == title)
        for mine, title in zip(own, titles, strict=True)
    ]
    named = zip(titles, files, alike, strict=True)
    return [title if same else f"{title} ({file})" for title, file, same in named]


def _write(file: Path, all_results: list[dict[str, Any]], names: list[str]) -> None:
    with contextlib.closing(sqlite3.connect(file)) as database, database:
        database.executescript(_TABLES)
        rows = [("status", value, words) for value, words in enumerate(_STATUSES)]
        database.executemany("INSERT INTO enums VALUES (?, ?, ?)", rows)
        experiments: dict[tuple, int] = {}
        for results, called in zip(all_results, names, strict=True):
            settings, machine = results["settings"], results["machine"]
            valid = [row for row in results["problems"] if row["valid"]]
            spent = sum(row["total_time_s"] for row in valid)
            name = f"{settings['robot']} {Path(settings['problems']).stem}"
            # Versions of what plans may differ: OMPL's planners are compared with ours.
            key = (
                *(name, settings["num_problems"], settings["time_limit"]),
                *(
                    str(settings.get(x) or None)
                    for x in ("problems_sha256", "robot_sha256", *OF_ARM)
                ),
                *(machine.get(part) for part in ("processor", "cores", "device", "gnnjax")),
            )
            if key not in experiments:
                made = database.execute(
                    "INSERT INTO experiments VALUES (NULL, ?, 0, ?, 0, ?, ?, '', ?, NULL, ?, ?)",
                    (
                        name,
                        settings["time_limit"],
                        len(valid),
                        f"gnnjax {machine['gnnjax']}",
                        machine["processor"],
                        settings["seed"],
                        f"{settings['num_problems']} problems of {settings['problems']}",
                    ),
                )
                experiments[key] = made.lastrowid or 0
            database.execute(
                "UPDATE experiments SET totaltime = totaltime + ? WHERE id = ?",
                (spent, experiments[key]),
            )
            planner = database.execute(
                "INSERT INTO plannerConfigs VALUES (NULL, ?, ?)",
                (called, json.dumps(settings)),
            )
            database.executemany(
                f"INSERT INTO runs VALUES (NULL{', ?' * 12})",
                [(experiments[key], planner.lastrowid, *_run(row)) for row in valid],
            )


def _run(row: dict[str, Any]) -> tuple:
    """What was measured of a problem, in the order of the columns."""
    return (
        row["total_time_s"],
        row["planning_time_s"],
        row["success"],
        row["certified"],
        row["success"] + row["certified"],
        row["cost"],
        row["edge_checks"],
        row["configuration_checks"],
        row["roadmaps"],
        row["hard"],
    )


def main() -> None:
    """Writes what the command line asks for."""
    config = parse_arguments(ArenaConfig)
    print(f"wrote {planner_arena(config)}, of {len(config.results)} files")


if __name__ == "__main__":
    run_command(main)
