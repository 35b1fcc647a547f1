"""The package as a whole: its table of contents, and the texts that describe it."""

import ast
import inspect
import re
from pathlib import Path

import pytest

import gnnjax

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize("name", gnnjax.__all__)
def test_everything_public_is_there_and_documented(name):
    thing = getattr(gnnjax, name)
    assert inspect.getdoc(thing)
    assert thing.__module__.startswith("gnnjax.")


def test_the_table_of_contents_is_complete():
    tree = ast.parse((ROOT / "gnnjax" / "__init__.py").read_text())
    imported = {a.name for n in tree.body if isinstance(n, ast.ImportFrom) for a in n.names}
    assert imported == set(gnnjax.__all__)


def test_files_that_the_texts_name_exist():
    for text in ROOT.glob("*.md"):
        for target in re.findall(r"\]\((?!http)([^)#]+)\)", text.read_text()):
            assert (ROOT / target).exists(), f"{text.name} names {target}"


def test_no_module_imports_one_that_comes_after_it():
    order = """
    interruption errors files mjcf robot kinematics geometry components scene world collision
    mjx_backend certify sampling roadmap labels problem workspace validity occupancy encoding model
    motion checkpoint run search shorten stored guided compilation query guided_planner planner
    ledger classical families family_problem generate losses train train_motion evaluate plot plan
    """.split()
    modules = {path.stem for path in (ROOT / "gnnjax").glob("*.py")} - {"__init__"}
    assert modules == set(order)
    for module in order:
        tree = ast.parse((ROOT / "gnnjax" / f"{module}.py").read_text())
        for node in tree.body:
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("gnnjax."):
                used = node.module.removeprefix("gnnjax.")
                assert order.index(used) < order.index(module), f"{module} imports {used}"
