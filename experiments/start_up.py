"""How long a newcomer waits: for the import, the first query of a machine, and the next process.

    python -m experiments.start_up

Each in a process of its own; the first query with an empty cache of compiled code, the next one
with what the first has left there.
"""

import dataclasses
import json
import os
import subprocess
import sys
import tempfile

from rich.console import Console
from rich.table import Table

from gnnjax.arguments import parse_arguments
from gnnjax.errors import run_command

_IMPORT = (
    "import time; begin = time.perf_counter(); import gnnjax; took = time.perf_counter() - begin"
)
_QUERY = """
robot = {robot!r}
loaded = gnnjax.load_robot(robot)
scene = gnnjax.make_scene([[3.0, 0.0, 0.5]], [[0.1, 0.1, 0.1]])  # out of the way of any arm
begin = time.perf_counter()
planner = gnnjax.load_planner(robot)
plan = planner.plan(scene, loaded.home, 0.9 * loaded.home)
line = time.perf_counter() - begin
planner.warm_up(scene)
every = time.perf_counter() - begin
"""
_PRINT = "\nimport json; print(json.dumps({names}))"


@dataclasses.dataclass(frozen=True)
class StartUpConfig:
    """Measure import and first queries."""

    robot: str = "kuka_iiwa14"
    """Shipped robot, or path of an MJCF."""
    repeats: int = 3
    """Imports, of which the median counts."""


def _run(code: str, names: str, cache: str) -> dict[str, float]:
    """What a process measured, s."""
    environment = {**os.environ, "JAX_COMPILATION_CACHE_DIR": cache}
    code += _PRINT.format(names="{" + ", ".join(f"'{n}': {n}" for n in names.split()) + "}")
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    return json.loads(done.stdout.splitlines()[-1])


def measure(config: StartUpConfig) -> dict[str, float]:
    """Seconds of each wait."""
    query = _IMPORT + _QUERY.format(robot=config.robot)
    with tempfile.TemporaryDirectory() as cache:
        imports = sorted(_run(_IMPORT, "took", cache)["took"] for _ in range(config.repeats))
        runs = {
            "first process of a machine": _run(query, "line every", cache),
            "next process": _run(query, "line every", cache),
        }
    found = {"import": imports[len(imports) // 2]}
    for process, run in runs.items():
        found[f"{process}: planner and first query, a straight line"] = run["line"]
        found[f"{process}: until all that queries may need is there"] = run["every"]
    return found


def main(config: StartUpConfig) -> dict[str, float]:
    """Measures and prints."""
    found = measure(config)
    table = Table("wait", "s")
    for name, seconds in found.items():
        table.add_row(name, f"{seconds:.1f}")
    Console().print(table)
    return found


if __name__ == "__main__":
    run_command(lambda: main(parse_arguments(StartUpConfig)) and None)
