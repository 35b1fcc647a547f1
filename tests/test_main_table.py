"""The README's tables are those of the results file, and the script writes both."""

import itertools
import json
from typing import get_args

import pytest

import experiments.main_table as main_table
from experiments.main_table import SETS, TableConfig, replace_section, run, table
from gnnjax.errors import InputError
from gnnjax.generate import GenerateConfig, generate
from gnnjax.planner import Method


def test_the_readme_shows_the_results_file():
    text = main_table.README.read_text(encoding="utf-8")
    rows = json.loads(main_table.RESULTS.read_text(encoding="utf-8"))
    for name in SETS:
        assert replace_section(text, f"table-{name}", table(rows, name)) == text
        chosen = [row for row in rows if row["set"] == name]
        assert {(row["planner"], row["num_nodes"]) for row in chosen} == set(
            itertools.product(get_args(Method), TableConfig().num_nodes)
        )
        assert all(row["complete"] for row in chosen)


def test_a_run_fills_the_tables_and_keeps_rows_that_are_done(tiny_path, tmp_path, monkeypatch):
    monkeypatch.setattr(main_table, "RESULTS", tmp_path / "results.json")
    monkeypatch.setattr(main_table, "README", tmp_path / "README.md")
    path = tmp_path / "test.npz"
    generate(GenerateConfig(split="test", robot=str(tiny_path), num_problems=3, out=path))
    monkeypatch.setattr(main_table, "SETS", {"test": path})
    text = "before\n<!-- table-test -->\nold\n<!-- /table-test -->\nafter\n"
    main_table.README.write_text(text)
    config = TableConfig(
        robot=str(tiny_path), planners=("lazysp",), num_nodes=(30,), runs=tmp_path / "runs"
    )
    run(config)
    first = main_table.README.read_text()
    assert "| 30 | lazysp | " in first
    assert "--planner lazysp --num-nodes 30" in first
    assert first.startswith("before\n<!-- table-test -->\n| N |")
    assert first.endswith("<!-- /table-test -->\nafter\n")
    run(config)
    assert main_table.README.read_text() == first  # times too: nothing was run again


def test_a_readme_without_the_comments_is_refused():
    with pytest.raises(InputError, match="lacks the comments <!-- table-x -->"):
        replace_section("text", "table-x", "rows")
