"""Command lines, read by tyro; what it refuses is said in one sentence, like all bad input."""

import ast
import contextlib
import dataclasses
import functools
import inspect
import io
import itertools
import re
import sys
import textwrap
from pathlib import Path
from typing import Annotated, Any, TypeVar, get_type_hints

import tyro

from gnnjax.errors import InputError, name_options

_Config = TypeVar("_Config")
_COLOR = re.compile(r"\x1b\[[0-9;]*m")
# Of an option that may be left out, or takes values of a kind.
_NO_TYPE = re.compile(
    r"(\S+): no type matching \{None\}\|\{?\[?([^{}]*?\]?)\]?\}? could be instantiated from "
    r"(\[.*\])"
)
# Of an option whose values are not by so many of such kinds.
_NO_PARSE = re.compile(r"(\S+): Could not find valid parse for arguments: (\[.*\])")
_QUOTED = re.compile(r"'\('(\S+)',\)'")  # an option, by the first versions of tyro
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
    _fill_help(config)
    name_options(field.name for field in dataclasses.fields(config))
    prog, said = how.pop("prog", None) or _command(), io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            return tyro.cli(config, prog=prog, **how)
    except SystemExit as error:
        if error.code != 2:
            raise
        fault = _sentence(said.getvalue(), _metavars(config))
        said = io.StringIO()
        raise InputError(f"{fault}; {prog} --help tells of all options") from None
    finally:
        sys.stderr.write(said.getvalue())  # warnings


def _command() -> str:
    """The command that runs, as it is typed."""
    spec = getattr(sys.modules["__main__"], "__spec__", None)
    return f"python -m {spec.name}" if spec else Path(sys.argv[0]).name


@functools.cache
def _fill_help(config: type) -> None:
    """Has tyro take docstrings of options as paragraphs, which fill the terminal's width. By itself
    it begins a line wherever one begins in the code."""
    for kind in config.__mro__:
        if not dataclasses.is_dataclass(kind):
            continue
        (defined,) = ast.parse(textwrap.dedent(inspect.getsource(kind))).body
        assert isinstance(defined, ast.ClassDef)
        for field, text in itertools.pairwise(defined.body):
            match field, text:
                case (
                    ast.AnnAssign(target=ast.Name(name)),
                    ast.Expr(ast.Constant(str() as said)),
                ):
                    filled = tyro.conf.arg(help=" ".join(said.split()))
                    kind.__annotations__[name] = Annotated[kind.__annotations__[name], filled]
    for hint in get_type_hints(config).values():
        if dataclasses.is_dataclass(hint):
            _fill_help(hint)


def _metavars(config: type) -> dict[str, str]:
    """What the options take that say so themselves."""
    found = {}
    for name, hint in get_type_hints(config, include_extras=True).items():
        said = [getattr(x, "metavar", None) for x in getattr(hint, "__metadata__", ())]
        found |= {f"--{name.replace('_', '-')}": words for words in said if words}
    return found


def _sentence(said: str, metavars: dict[str, str]) -> str:
    """What tyro says: a title, then parts between rules, of which the last are advice. They are in
    a box where the terminal knows its characters.

    Args:
        said: all of it.
        metavars: what options take, by their names, where tyro does not say it.
    """
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
            fault = _QUOTED.sub(r"'\1'", fault)
            if (given := _NO_PARSE.fullmatch(fault)) and given[1] in metavars:
                fault = f"{given[1]} takes {metavars[given[1]]}, not {given[2]}"
            found.append(fault)
    return "; ".join(found)
