"""The texts hold the numbers of the results files, and nothing typed by hand."""

import json

import pytest

from experiments.measure import load_results
from experiments.report import ReportConfig, replace_section, texts
from experiments.tables import markdown, seconds
from gnnjax.errors import InputError


def test_readme_and_docs_equal_the_results_files():
    for path, text in texts(ReportConfig()).items():
        assert path.read_text(encoding="utf-8") == text, f"run python -m experiments.report: {path}"


def test_results_of_another_format_are_refused(tmp_path):
    path = tmp_path / "figure5.json"
    path.write_text(json.dumps({"format": 0}))
    with pytest.raises(InputError, match="holds results of format 0, this version reads 1"):
        load_results(path)
    path.write_text("{")
    with pytest.raises(InputError, match="holds no results; remove it"):
        load_results(path)
    with pytest.raises(InputError, match=r"no results .*; run python -m experiments.run_all"):
        load_results(tmp_path / "missing.json")


def test_a_text_without_the_comments_is_refused(tmp_path):
    with pytest.raises(InputError, match="lacks the comments <!-- table-x -->"):
        replace_section("text", "table-x", "rows", tmp_path)
    marked = "a\n<!-- t -->\nold\n<!-- /t -->\nb\n"
    assert replace_section(marked, "t", "new\n", tmp_path) == marked.replace("old", "new")


def test_tables_and_prices_read_well():
    assert markdown(["a", "b"], [["1", "2"]]) == "| a | b |\n| --- | --- |\n| 1 | 2 |\n"
    assert [seconds(x) for x in (None, 1e-8, 2.5e-7, 3e-6, 0.04, 1.0)] == [
        "never",
        "always",
        "250 ns",
        "3 us",
        "40 ms",
        "1 s",
    ]
