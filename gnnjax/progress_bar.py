"""How far something is, for whoever waits: in terminals, and in notebooks that can show it."""

import importlib.util
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn


def progress_bar(console: Console | None = None, **options: Any) -> Progress:
    """A bar with a task's description, how much of it is done, and the time that is left.

    In notebooks without ipywidgets nothing is shown, where rich would warn at every bar.

    Args:
        console: to show it on; by default what rich has for all.
        options: of rich's `Progress`.
    """
    bar = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        console=console,
        **options,
    )
    if bar.console.is_jupyter and importlib.util.find_spec("ipywidgets") is None:
        bar.disable = True
    return bar
