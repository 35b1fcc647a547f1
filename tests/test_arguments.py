"""Command lines: what is refused is said in one sentence."""

import dataclasses
import io
from pathlib import Path
from typing import Annotated, Literal

import pytest
import tyro

from gnnjax.arguments import parse_arguments
from gnnjax.errors import InputError


@dataclasses.dataclass(frozen=True)
class More:
    """Options."""

    far: int = 0
    """As it is written here, this begins in one
    line and ends in another."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Base:
    """What others inherit."""

    near: int = 0
    """As it is written here, that begins in one
    line and ends in another."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Config(Base):
    """Do something."""

    name: tyro.conf.Positional[str]
    """Of a thing, which takes so many words to tell that they do not all find room in a line."""
    scene: Path
    """File of the obstacles."""
    goal: tuple[float, ...] | None = None
    """Joint values, rad."""
    steps: int = 3
    """Batches."""
    split: Literal["train", "test"] = "test"
    """Of the data."""
    hold: Annotated[tuple[tuple[str, float], ...], tyro.conf.arg(metavar="JOINT VALUE ...")] = ()
    """Joints."""
    more: Annotated[More, tyro.conf.arg(name="")] = dataclasses.field(default_factory=More)


GOOD = ["arm", "--scene", "scene.json"]


def test_a_command_line_becomes_a_configuration():
    parsed = parse_arguments(Config, args=[*GOOD, "--goal", "1", "2"])
    assert parsed == Config(name="arm", scene=Path("scene.json"), goal=(1.0, 2.0))


@pytest.mark.parametrize(("columns", "in_box"), [("40", True), ("80", True), ("80", False)])
@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["arm"], "--scene is missing; do --help tells of all options"),
        ([], "STR and --scene are missing; do"),
        (["arm", "--scen", "x"], "--scene is missing; there is no --scen x; do"),
        ([*GOOD, "--step", "4"], "there is no --step 4; perhaps you meant --steps; do"),
        ([*GOOD, "--steps", "1.5"], "--steps: invalid literal for int() with base 10: '1.5'; do"),
        ([*GOOD, "--steps"], "Missing value for argument '--steps'. Expected 1 values; do"),
        (
            [*GOOD, "--split", "all"],
            "invalid choice 'all' for argument '--split'. Expected one of ('train', 'test'); do",
        ),
        ([*GOOD, "--goal", "a"], "--goal takes FLOAT [FLOAT ...], not ['a']; do"),
        ([*GOOD, "--hold", "a"], "--hold takes JOINT VALUE ..., not ['a']; do"),
        ([*GOOD, "--hold", "a", "b"], "--hold takes JOINT VALUE ..., not ['a', 'b']; do"),
    ],
)
def test_what_is_wrong_is_one_sentence(monkeypatch, columns, in_box, args, message):
    monkeypatch.setenv("COLUMNS", columns)
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setattr(
        "sys.stdout", io.TextIOWrapper(io.BytesIO(), "utf-8" if in_box else "ascii")
    )
    monkeypatch.setattr("sys.stderr", told := io.StringIO())
    with pytest.raises(InputError) as refused:
        parse_arguments(Config, args=args, prog="do")
    said = str(refused.value)
    assert said.startswith(message)
    assert said.endswith("; do --help tells of all options")
    assert not set(said) & set("│─╭\x1b?")
    assert told.getvalue() == ""


def test_help_goes_where_it_always_does(capsys):
    with pytest.raises(SystemExit) as ended:
        parse_arguments(Config, args=["--help"], prog="do")
    assert not ended.value.code
    printed = capsys.readouterr()
    assert printed.out.startswith("usage: do [-h]")
    assert printed.err == ""


@pytest.mark.parametrize("columns", ["80", "140"])
def test_help_fills_the_width_of_the_terminal(monkeypatch, capsys, columns):
    monkeypatch.setenv("COLUMNS", columns)
    with pytest.raises(SystemExit):
        parse_arguments(Config, args=["--help"], prog="do")
    lines = [line.strip("│ ") for line in capsys.readouterr().out.splitlines()]
    for word in ("this", "that"):
        (at,) = [i for i, line in enumerate(lines) if f"here, {word}" in line]
        assert "begins in one line and" in " ".join(lines[at : at + 2])
        # Where the docstring has the next line, none begins here.
        assert not lines[at].endswith("begins in one")
