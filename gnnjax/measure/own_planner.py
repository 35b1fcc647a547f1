"""Planners that a caller made, beside what the settings of their results tell."""

import dataclasses
from pathlib import Path
from typing import Any

from gnnjax.errors import InputError, brief
from gnnjax.planning.options import PlannerOptions
from gnnjax.planning.planner import Planner
from gnnjax.planning.query import QueryPlanner


def own_settings(planner: QueryPlanner, options: PlannerOptions, results: Path) -> dict[str, Any]:
    """What to tell of a planner beside the options that its results are said to be of.

    The time limit is that of the options, whatever the planner's.

    Raises:
        InputError: the planner has other options; or a guide or scorer of its own, where there are
            results already: whether these are of the same one, no file tells.
    """
    if not isinstance(planner, Planner):
        return {}
    for field in dataclasses.fields(PlannerOptions):
        theirs, ours = (getattr(x, field.name) for x in (planner.options, options))
        if field.name != "time_limit" and str(theirs) != str(ours):
            raise InputError(
                f"the planner has {field.name} {brief(theirs)}, and results would tell "
                f"{brief(ours)}; give both the same"
            )
    own = [name for name, value in planner.given.items() if value is not None]
    if not own:
        return {}
    if results.exists():
        raise InputError(
            f"{str(results)!r} is there, and whether its rows are of the same {own[0]} of your "
            "own, nobody can tell; remove it, or name another file"
        )
    return {"own": own}
