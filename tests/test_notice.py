"""A line for whoever waits: when it is printed, and where."""

import io
import time
from types import SimpleNamespace

import pytest

from gnnjax import notice


@pytest.fixture
def terminal(monkeypatch):
    """What is printed to the errors, as if somebody saw it."""
    stream = io.StringIO()
    monkeypatch.setattr(stream, "isatty", lambda: True, raising=False)
    for name, value in {"silent": False, "waited": 0.0, "told": False, "ended": 0.0}.items():
        monkeypatch.setattr(notice._State, name, value)
    monkeypatch.setattr(notice, "_AFTER_S", 0.1)
    monkeypatch.setattr(notice, "sys", SimpleNamespace(stderr=stream))
    return stream


def wait(seconds):
    with notice.told_if_long("compiling"):
        time.sleep(seconds)


def test_what_takes_long_is_told_once(terminal):
    wait(0.2)
    wait(0.2)
    assert terminal.getvalue() == "compiling\n"


def test_much_that_is_short_takes_long_together(terminal):
    wait(0.0)
    assert terminal.getvalue() == ""
    for _ in range(40):  # of which none takes as long
        wait(0.01)
    assert terminal.getvalue() == "compiling\n"


def test_what_is_short_or_begins_later_is_told_for_itself(terminal, monkeypatch):
    wait(0.0)
    assert terminal.getvalue() == ""
    monkeypatch.setattr(notice, "_APART_S", 0.0)
    for _ in range(2):
        wait(0.2)
    assert terminal.getvalue() == 2 * "compiling\n"


def test_nothing_is_told_in_pipes_commands_and_of_streams_that_are_closed(terminal, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(terminal, "isatty", lambda: False)
        wait(0.2)
    notice.silence()
    wait(0.2)
    assert terminal.getvalue() == ""
    monkeypatch.setattr(notice._State, "silent", False)
    terminal.close()
    wait(0.2)
