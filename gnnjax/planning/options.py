"""The planners there are and their options, once: for commands and for `load_planner`."""

import dataclasses
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from gnnjax.collision.checker import EDGE_RESOLUTION
from gnnjax.errors import InputError, brief, check_number, check_option_names

DEFAULT_MAX_ROADMAPS = 8
CHEAP = 10.0  # us; a check that takes longer is dearer than a look at the guide

# Planners by name, and what each does.
PLANNERS = {
    "guided": "two trees, which grow by branches that a guide finds likely; where checks are dear, "
    "lazy search for the path that is cheapest by length and its doubts, shortened before it is "
    "checked",
    "gnn": "the paper's greedy search by the values of the guidance network",
    "gnn_lazy": "lazy search by length and the guidance network's doubts",
    "distance": "greedy search by the distance to the goal",
    "lazysp": "lazy search for the shortest path",
    "prm": "all edges are checked, then the shortest path is taken",
    "oracle": "greedy search by the exact cost-to-go: a bound, not a planner",
    "greedy": "greedy search by a scorer of your own, from Python alone",
    "ompl:rrt_connect": "RRT-Connect of OMPL",
    "ompl:rrt_star": "RRT* of OMPL, to its first path",
    "ompl:bit_star": "BIT* of OMPL, to its first path",
    "ompl:prm": "PRM of OMPL, to its first path",
    "ompl:lazy_prm": "LazyPRM of OMPL 1.7",
    "ompl:ait_star": "AIT* of OMPL 1.7, to its first path",
    "ompl:eit_star": "EIT* of OMPL 1.7, to its first path",
}
CHECKERS = ("fused", "mjx", "mujoco")

# Options that not all planners use: those that do, and what they are called. To others they are not
# given in silence.
_GUIDED = ("guided",), "planner 'guided'"
_OMPL = tuple(name for name in PLANNERS if name.startswith("ompl:")), "OMPL's planners"
_OURS = tuple(name for name in PLANNERS if name not in _OMPL[0]), "our own planners"
_USED_BY = {
    "num_nodes": _OURS,
    "max_roadmaps": _OURS,
    "weights": (("guided", "gnn", "gnn_lazy"), "planners 'guided', 'gnn' and 'gnn_lazy'"),
    "effort": _GUIDED,
    "shorten": _GUIDED,
    "sampled": _GUIDED,
    "check_cost": _GUIDED,
    "simplify": _OMPL,
}

# No command can make `greedy`, which needs a scorer.
_PLANNER_HELP = "How a path is found: " + "; ".join(
    f"{name} ({what})" for name, what in PLANNERS.items() if name != "greedy"
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class PlannerOptions:
    """How queries are planned."""

    planner: Annotated[str, tyro.conf.arg(help=_PLANNER_HELP)] = "guided"
    num_nodes: int = 200
    """Nodes per roadmap, start and goal included; for guided, of the first roadmap. guided uses
    roadmaps only with --check-cost above 10, --sampled or --no-shorten; OMPL's planners do not use
    this."""
    max_roadmaps: int = DEFAULT_MAX_ROADMAPS
    """Roadmaps to try before giving up; 1 is the paper's way. Used where --num-nodes is; guided
    tries at most four per step of --effort."""
    effort: int = 1
    """How much to try before giving up (guided only). Each step is 64 rounds of growing two trees;
    with --check-cost above 10, it is four roadmaps (up to --max-roadmaps) with 40 rounds of search
    on each, then 100 rounds of trees with fewer branches."""
    weights: Path | None = None
    """File of weights, folder of a checkpoint, or name of shipped weights. Default: none for guided
    (distance field); the shipped ones for gnn and gnn_lazy. guided takes those of a motion network
    (motion is shipped)."""
    shorten: bool = True
    """Shorten paths (guided only): by tested shortcuts, or with dear checks in the guide's estimate
    before checking. Without it, guided searches roadmaps."""
    sampled: bool = False
    """Draw a roadmap of checked nodes for each query, as the other roadmap planners do, and search
    it (guided only)."""
    simplify: bool = False
    """Let OMPL simplify the path that its planner found (OMPL's planners only)."""
    checker: str = "fused"
    """Collision backend: fused, mjx (only the spheres around the arm's links) or mujoco (MuJoCo's C
    engine; OMPL's planners only)."""
    resolution: float = EDGE_RESOLUTION
    """Largest distance between neighbouring configurations tested along an edge, rad (or m)."""
    margin: float = 0.0
    """Clearance to keep from obstacles, m; certified like the path itself."""
    check_cost: float = 1.0
    """Microseconds that a configuration check takes where the plans are used (guided only). Up to
    10, guided grows trees and shortens paths by tested shortcuts. Above 10, it uses roadmaps and
    the guide, which need fewer checks."""
    time_limit: float = np.inf
    """Seconds of search that a query may take. Checked between rounds (guided) or roadmaps
    (others), so one of these may exceed it."""

    @property
    def is_classical(self) -> bool:
        """Whether the planner is one of OMPL's."""
        return self.planner.startswith("ompl:")


def make_options(planner: str, **options: Any) -> PlannerOptions:
    """Options by name.

    Raises:
        InputError: a name that is no option.
    """
    check_option_names(PlannerOptions, options, "a planner")
    if options.get("weights") is not None:
        options["weights"] = Path(options["weights"])
    return PlannerOptions(planner=planner, **options)


def check_options(options: PlannerOptions) -> None:
    """Refuses what no planner, or not this one, can work with.

    Raises:
        InputError: names the option.
    """
    name = options.planner
    if name not in PLANNERS:
        raise InputError(f"no planner {name!r}; there are {list(PLANNERS)}")
    if options.checker not in CHECKERS:
        raise InputError(f"no checker {options.checker!r}; there are {list(CHECKERS)}")
    backends = ("fused", "mujoco") if options.is_classical else ("fused", "mjx")
    if options.checker not in backends:
        raise InputError(
            f"checker {options.checker!r} with planner {name!r}; it takes {list(backends)}"
        )
    for field in dataclasses.fields(PlannerOptions):
        value = getattr(options, field.name)
        if field.type in (int, float):
            check_number(value, field.name)
        is_whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
        if field.type is int and not is_whole:
            raise InputError(f"{field.name} is {brief(value)}; give a whole number")
    if options.num_nodes < 2:
        raise InputError(
            f"num_nodes is {options.num_nodes}; a roadmap needs at least start and goal"
        )
    if options.max_roadmaps < 1:
        raise InputError(f"max_roadmaps is {options.max_roadmaps}; it must be at least 1")
    if options.effort < 1:
        raise InputError(f"effort is {options.effort}; it must be at least 1")
    # NaN fails both comparisons.
    if not options.resolution >= 1e-3:
        raise InputError(
            f"resolution is {options.resolution}; it must be at least 0.001 rad (or m)"
        )
    if not 0 <= options.margin <= 1:
        raise InputError(f"margin is {options.margin}; it must be between 0 and 1 m")
    if options.margin and options.checker == "mujoco":
        raise InputError("margin with checker 'mujoco', which has none; use the checker 'fused'")
    if not options.check_cost >= 0:
        raise InputError(f"check_cost is {options.check_cost}; it must be 0 us or more")
    if not options.time_limit > 0:
        raise InputError(f"time_limit is {options.time_limit}; it must be more than 0 s")
    if options.is_classical and not np.isfinite(options.time_limit):
        raise InputError(f"time_limit with planner {name!r} is infinite; choose some seconds")
    defaults = {field.name: field.default for field in dataclasses.fields(PlannerOptions)}
    for option, (users, called) in _USED_BY.items():
        value = getattr(options, option)
        if name not in users and value != defaults[option]:
            given = option if value is True else f"{option}={value}"
            raise InputError(f"{given} with planner {name!r}; it is for {called}, leave it out")
