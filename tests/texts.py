"""Runs what the texts show: the Python of each page in order, and the commands, in small.

    python -m tests.texts [PAGE ...]

A page is a namespace and a folder of its own, which holds the files that texts name. `python`
blocks stand alone; `py` blocks are fragments, which find all public names and what `given` says. Of
shell blocks, lines that call a module of this project are run, each with the options of `SMALL`;
those of `SLOW` are only parsed. A block after `<!-- not run: reason -->` is left out.
"""

import contextlib
import io
import itertools
import json
import os
import re
import runpy
import shlex
import sys
import tempfile
import time
import traceback
import warnings
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

from tests.compiling import ENVIRONMENT

os.environ.setdefault("JAX_PLATFORMS", "cpu")
os.environ.update(ENVIRONMENT)

import numpy as np
import tyro

import gnnjax

_REAL_CLI = tyro.cli  # which `run_command` replaces
ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]

# Last options that make a command small; of what is given twice, the last counts.
SMALL = {
    "gnnjax.generate": "--num-problems 4",
    "gnnjax.evaluate": "--num-problems 2",
}
# First options, which leave behind what another text goes on with.
LEAVING = {"gnnjax.plan": "--trajectory motion.npz"}
# What compiles for longer even so, by how it begins; its options are parsed.
SLOW = {
    "gnnjax.generate --distributed": "tests/test_cluster.py starts several processes",
    "gnnjax.generate --split train": "tests/test_generate.py draws labelled problems",
    "gnnjax.generate --split test --family": "tests/test_families.py draws families",
    "gnnjax.train": "tests/test_train.py and tests/test_train_motion.py train",
    "gnnjax.view": "tests/test_view.py opens the page, which is served until it is interrupted",
    "gnnjax.evaluate --problems data/kuka_iiwa14_public": "not shipped",
    "experiments": "tests/test_experiments.py measures, in small",
    "tests": "they are run by hand",
}
PLACEHOLDERS = {"--start": "-0.9 0.9 0 -1 0 0.6 0", "--goal": "0.9 0.9 0 -1 0 0.6 0"}

ARM = """<mujoco model="planar"><worldbody>
  <body name="upper"><joint name="shoulder" axis="0 0 1" range="-170 170"/>
    <geom type="capsule" fromto="0 0 0 0.5 0 0" size="0.04"/>
    <body name="fore" pos="0.5 0 0"><joint name="elbow" axis="0 0 1" range="-150 150"/>
      <geom type="capsule" fromto="0 0 0 0.4 0 0" size="0.03"/></body></body>%s
</worldbody></mujoco>"""
BOX = '<geom type="box" pos="0.7 0 0" size="0.1 0.1 0.1"/>'
MOVEIT_SCENE = """world: {collision_objects: [{id: post,
  primitives: [{type: box, dimensions: [0.2, 0.2, 0.2]}],
  primitive_poses: [{position: [0.7, 0, 0], orientation: [0, 0, 0, 1]}]}]}"""
MOVEIT_REQUEST = """start_state: {joint_state: {name: [shoulder, elbow], position: [-1, 0]}}
goal_constraints: [{joint_constraints: [{joint_name: shoulder, position: 1},
  {joint_name: elbow, position: 0}]}]"""
OCTOMAP = b"# Octomap OcTree binary file\nid OcTree\nsize 1\nres 0.1\ndata\n" + bytes.fromhex(
    "00fc300030003000300030003000300030003000300030003000c000000301000c000c000c000c00"
    "0c000c000c000c000c000c000c00000c0c0000038000030003000300030003000300030003000300"
    "030003000300030003000200"
)


class Block(NamedTuple):
    """A block of code."""

    line: int  # of its first line
    kind: str  # python, py, sh, ...
    code: str
    not_run: str  # the reason, or nothing


def blocks_of(text: str) -> list[Block]:
    """The fenced blocks of a page."""
    found = []
    pattern = r"(?:<!-- not run: (.*?) -->\n)?^```([^\n]*)\n(.*?)^```$"
    for match in re.finditer(pattern, text, re.MULTILINE | re.DOTALL):
        line = text.count("\n", 0, match.start(3)) + 1
        found.append(Block(line, match[2].strip(), match[3], match[1] or ""))
    return found


def commands_of(code: str) -> list[list[str]]:
    """Words of the lines of a shell block that call a module: its name, and its arguments."""
    calls = []
    for line in code.replace("\\\n", " ").splitlines():
        words = shlex.split(line, comments=True)
        while words and re.fullmatch(r"[A-Z_]+=\S*", words[0]):  # of the environment
            words.pop(0)
        if len(words) > 2 and Path(words[0]).name == "python" and words[1] == "-m":
            if words[2].split(".")[0] in ("gnnjax", "experiments", "tests"):
                calls.append([word for word in words[2:] if word != "&"])
    return calls


def is_slow(words: list[str]) -> bool:
    """Whether a command is only parsed."""
    return " ".join(words).startswith(tuple(SLOW))


def given(folder: Path) -> dict[str, Any]:
    """Writes the files that texts name into a folder, and returns what `py` blocks find."""
    (folder / "arm.xml").write_text(ARM % "")
    (folder / "scene.xml").write_text(ARM % BOX)
    (folder / "scene.json").write_text(
        json.dumps({"boxes": [{"center": [0.55, 0, 0.75], "half_extents": [0.12, 0.3, 0.22]}]})
    )
    (folder / "scene.yaml").write_text(MOVEIT_SCENE)
    (folder / "request.yaml").write_text(MOVEIT_REQUEST)
    (folder / "map.bt").write_bytes(OCTOMAP)
    corners = np.array(list(itertools.product((-0.1, 0.1), repeat=3)))
    import trimesh

    trimesh.Trimesh(corners).convex_hull.export(folder / "shelf.stl")
    (folder / "assets").symlink_to(ROOT / "assets")
    points = np.random.default_rng(0).uniform(0.5, 0.6, (100, 3))
    names = {name: getattr(gnnjax, name) for name in gnnjax.__all__}
    heights = np.zeros((5, 5))
    return names | {"points": points, "heights": heights, "robot": gnnjax.load_robot("arm.xml")}


def run_command(words: list[str]) -> None:
    """Runs a command in this process, as `python -m` does; raises where it fails."""
    for option, value in PLACEHOLDERS.items():
        if option in words and words[words.index(option) + 1] == "...":
            at = words.index(option) + 1
            words[at : at + 1] = value.split()
    module, *arguments = words
    said = io.StringIO()
    # It was imported before by another one.
    warnings.filterwarnings("ignore", "'gnnjax", RuntimeWarning)
    if is_slow(words):
        # What follows the parsing of the options is left out.
        stop = mock.patch("gnnjax.errors.run_command", lambda main, *_, **__: main())
        parsed = mock.patch("tyro.cli", lambda config, **how: _parse(config, arguments))
        with stop, parsed, contextlib.suppress(_Parsed):
            runpy.run_module(module, run_name="__main__", alter_sys=True)
        return
    arguments = LEAVING.get(module, "").split() + arguments + SMALL.get(module, "").split()
    with mock.patch.object(sys, "argv", [module, *arguments]), contextlib.redirect_stderr(said):
        try:
            runpy.run_module(module, run_name="__main__", alter_sys=True)
        except SystemExit as ended:
            if ended.code:
                raise RuntimeError(f"status {ended.code}: {said.getvalue()}") from None


class _Parsed(Exception):
    """Raised in place of what a slow command does."""


def _parse(config: Any, arguments: list[str]) -> None:
    _REAL_CLI(config, args=arguments)
    raise _Parsed


def run_page(page: Path) -> list[str]:
    """Runs a page, and returns what failed, a line each."""
    failed = []
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        fragments = given(Path(folder))
        namespace: dict[str, Any] = {"__name__": "__main__"}
        for block in blocks_of(page.read_text(encoding="utf-8")):
            if block.not_run:
                continue
            began = time.process_time()
            where = f"{page.relative_to(ROOT)}:{block.line}"
            try:
                if block.kind in ("python", "py"):
                    if block.kind == "py":
                        namespace = fragments | namespace
                    # As many lines before it as on the page, for tracebacks.
                    code = "\n" * (block.line - 1) + block.code
                    exec(compile(code, str(page), "exec"), namespace)
                elif block.kind in ("sh", "bash"):
                    for words in commands_of(block.code):
                        print("+", *words, flush=True)
                        run_command(words)
            except (Exception, SystemExit) as error:
                traceback.print_exc()
                failed.append(f"{where}: {type(error).__name__}: {error}")
            print(f"{where}: {time.process_time() - began:.1f} s of CPU time", flush=True)
    return failed


def main(pages: list[Path]) -> int:
    """Runs pages, and returns 1 where something failed."""
    failed = [line for page in pages for line in run_page(page)]
    print(*failed, sep="\n", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    os.environ.setdefault("COLUMNS", "100")
    sys.exit(main([Path(page).resolve() for page in sys.argv[1:]] or PAGES))
