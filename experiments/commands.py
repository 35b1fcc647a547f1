"""The command line that stands for a configuration, as results name what made them."""

import dataclasses
import shlex
from collections.abc import Collection
from typing import Any


def command_line(command: str, config: Any, default: Any = None, skip: Collection[str] = ()) -> str:
    """`python -m gnnjax.COMMAND` with the options that are not the default's.

    Args:
        command: a module, with options that come first if there are any.
        config: a dataclass of options.
        default: a configuration of the same kind that names the defaults; else those of the
            fields themselves.
        skip: options that are left out.
    """
    words = ["python", "-m", *f"gnnjax.{command}".split()]
    for field in dataclasses.fields(config):
        value, option = getattr(config, field.name), field.name.replace("_", "-")
        usual = field.default if default is None else getattr(default, field.name)
        if value == usual or field.name in skip:
            continue
        if isinstance(value, bool):
            words.append(f"--{option}" if value else f"--no-{option}")
        else:
            words += [f"--{option}", *map(str, value if isinstance(value, tuple) else [value])]
    return shlex.join(words)
