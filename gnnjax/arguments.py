"""Command lines, read by tyro; what it refuses is said in one sentence, like all bad input."""

import contextlib
import io
import re
import sys
import textwrap
from pathlib import Path
from typing import Any, TypeVar

import tyro

from gnnjax.errors import InputError

_Config = TypeVar("_Config")
_COLOR = re.compile(r"\x1b\[[0-9;]*m")
# Of an option that may be left out, or takes values of a kind.
_NO_TYPE = re.compile(
    r"(\S+): no type matching \{None\}\|\{?\[?([^{}]*?\]?)\]?\}? could be instantiated from "
    r"(\[.*\])"
)
_RULE = re.compile(r"^ *[─-]{9,}$", re.MULTILINE)


def parse_arguments(config: type[_Config], **how: Any) -> _Config:
    """Reads the command line into a configuration.

    Args:
        config: a dataclass of options.
        how: further arguments of `tyro.cli`.

    Raises:
        InputError: an option that is missing, that there is not, or that has a bad value.
        SystemExit: `--help`, once it is printed.
    """
    prog, said = how.pop("prog", None) or _command(), io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            return tyro.cli(config, prog=prog, **how)
    except SystemExit as error:
        if error.code != 2:
            raise
        fault = _sentence(said.getvalue())
        said = io.StringIO()
        raise InputError(f"{fault}; {prog} --help tells of all options") from None
    finally:
        sys.stderr.write(said.getvalue())  # warnings


def _command() -> str:
    """The command that runs, as it is typed."""
    spec = getattr(sys.modules["__main__"], "__spec__", None)
    return f"python -m {spec.name}" if spec else Path(sys.argv[0]).name


def _sentence(said: str) -> str:
    """What tyro says: a title, then parts between rules, of which the last are advice. They are in
    a box where the terminal knows its characters."""
    said = _COLOR.sub("", said).strip()
    in_box = said.startswith("╭")
    lines = [line.strip("│").rstrip() for line in said.splitlines() if line[0] not in "╭╰"]
    found = []
    for part in _RULE.split("\n".join(lines))[not in_box :]:
        part = textwrap.dedent(part).strip("\n")
        heading, _, rest = part.partition(":")
        # Options stand four columns in, what is said of them farther.
        named = re.findall(r"^    (\S+)", rest, re.MULTILINE)
        if heading.startswith("Missing from"):
            found.append(f"{' and '.join(named)} {'are' if len(named) > 1 else 'is'} missing")
        elif heading == "Unrecognized options":
            found.append(f"there is no {' '.join(named or rest.split()).replace(',', '')}")
        elif heading == "Perhaps you meant":
            found.append(f"perhaps you meant {' or '.join(dict.fromkeys(named))}")
        elif heading != "Argument helptext" and not part.startswith("For full helptext"):
            fault = " ".join(part.partition("Got errors:")[0].split()).rstrip(" .")
            fault = fault.removeprefix("Error parsing ")
            if several := _NO_TYPE.fullmatch(fault):
                option, wanted, given = several.groups()
                fault = f"{option} takes {wanted}, not {given}"
            found.append(fault)
    return "; ".join(found)
