"""Whether two versions of the code plan alike: same paths and counts for the same seeds.

    python tests/equal_results.py measure --problems data/kuka_iiwa14_test.npz --out before.json
    ... check out another version ...
    python tests/equal_results.py measure --problems data/kuka_iiwa14_test.npz --out after.json
    python tests/equal_results.py compare before.json after.json

Times are left out. Only public functions are used, so that old and new versions run it.
"""

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

import gnnjax

COUNTS = ("edge_checks", "sampling_checks", "search_checks", "roadmaps")
# Planners, and the options of those that have variants.
PLANNERS: dict[str, dict[str, Any]] = {
    "guided": {},
    "guided, not shortened": {"shorten": False},
    "guided, sampled": {"sampled": True},
    "gnn": {},
    "gnn_lazy": {},
    "distance": {},
    "lazysp": {},
    "prm": {},
    "oracle": {},
}


def plan_all(robot: str, name: str, problems: Any, num: int, **options: Any) -> list[dict]:
    """What a planner finds for the first `num` problems of a set, without times."""
    planner = gnnjax.load_planner(robot, name.split(",")[0], **PLANNERS[name], **options)
    rows = []
    for i in range(num):
        start, goal, scene = jax.tree.map(lambda x, i=i: x[i], problems)
        try:
            plan = planner.plan(scene, start, goal)
        except gnnjax.InputError as error:
            rows.append({"invalid": str(error)})
            continue
        row = {count: int(getattr(plan, count) or 0) for count in COUNTS}
        rows.append({"success": plan.success, "path": plan.path.tolist(), **row})
    return rows


def differences(before: list[dict], after: list[dict], tolerance: float = 0.0) -> list[int]:
    """The problems that two versions answer differently; path and counts both matter."""

    def alike(one: dict, other: dict) -> bool:
        if "invalid" in one or "invalid" in other:
            return one == other
        paths = np.array(one["path"]), np.array(other["path"])
        same_path = paths[0].shape == paths[1].shape and np.allclose(*paths, rtol=0, atol=tolerance)
        return same_path and all(one[k] == other[k] for k in ("success", *COUNTS))

    pairs = enumerate(zip(before, after, strict=True))
    return [i for i, (one, other) in pairs if not alike(one, other)]


def main() -> int:
    """Measures or compares; returns 1 where something differs."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("command", choices=("measure", "compare"))
    parser.add_argument("files", nargs="*", type=Path)
    parser.add_argument("--problems", type=Path)
    parser.add_argument("--robot", default="kuka_iiwa14")
    parser.add_argument("--num", type=int, default=300)
    parser.add_argument("--planners", nargs="*", default=list(PLANNERS))
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    if given.command == "compare":
        before, after = (json.loads(file.read_text()) for file in given.files)
        found = {name: differences(before[name], after[name]) for name in before}
        for name, rows in found.items():
            print(f"{name}: {len(before[name])} problems, {len(rows)} differ {rows[:10]}")
        return int(any(found.values()))
    problems = gnnjax.load_problems(given.problems, gnnjax.load_robot(given.robot)).problems
    results = json.loads(given.out.read_text()) if given.out.exists() else {}
    for name in given.planners:
        if name not in results:
            begin = time.perf_counter()
            results[name] = plan_all(given.robot, name, problems, given.num)
            given.out.write_text(json.dumps(results))
            print(f"{name}: {time.perf_counter() - begin:.0f} s", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
