"""Bars, in terminals and notebooks."""

import io
import warnings

import pytest
from rich.console import Console

from gnnjax import progress_bar as module
from gnnjax.progress_bar import progress_bar


def shown(**console) -> str:
    """What a bar of three prints."""
    stream = io.StringIO()
    with progress_bar(Console(file=stream, **console)) as bar:
        task = bar.add_task("planning", total=3)
        bar.console.print("compiling")
        bar.update(task, advance=3)
    return stream.getvalue()


@pytest.mark.parametrize("terminal", [True, False])
def test_a_bar_shows_what_is_done(terminal):
    said = shown(force_terminal=terminal, width=80)
    assert "compiling" in said
    assert "planning" in said
    assert "3/3" in said


def test_a_notebook_that_cannot_show_a_bar_gets_none_and_no_warning(monkeypatch):
    printed = []
    monkeypatch.setattr("rich.jupyter.display", lambda segments, text: printed.append(text))
    monkeypatch.setattr(module.importlib.util, "find_spec", lambda name: None)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        shown(force_jupyter=True)
    assert printed == ["compiling\n"]
