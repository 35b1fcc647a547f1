"""Planners made by name: what each needs is loaded, and a guide or scorer of one's own put in."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from gnnjax.arm.robot import Robot, load_robot
from gnnjax.devices import cache_compilations, on_host, run_where_called
from gnnjax.errors import InputError
from gnnjax.guide.field import field_guide
from gnnjax.guide.guide import Guide
from gnnjax.guide.rest import with_rest
from gnnjax.planning import strategy
from gnnjax.planning.guided import Guided
from gnnjax.planning.options import PlannerOptions, check_options, make_options
from gnnjax.planning.planner import GuidedPlanner, Planner, SampledPlanner
from gnnjax.planning.query import QueryPlanner
from gnnjax.roadmap.graph import Roadmap
from gnnjax.scene.scene import Scene
from gnnjax.search.greedy import Scorer

_STRATEGIES = {
    "distance": strategy.distance,
    "lazysp": strategy.lazysp,
    "prm": strategy.prm,
    "oracle": strategy.oracle,
}
# Of `load_planner`: ranks neighbors on one roadmap in one scene.
MakeScorer = Callable[[Roadmap, Scene], Scorer]


def load_planner(
    robot: str | Path | Robot,
    planner: str = "guided",
    *,
    guide: Guide | None = None,
    scorer: MakeScorer | None = None,
    **options: Any,
) -> Planner:
    """Loads a robot, and weights where they are needed, and makes a planner on roadmaps.

    Args:
        robot: name of a shipped robot, path of an MJCF or URDF, or an arm that is loaded already.
        planner: one of `PLANNERS`, but for OMPL's, which `evaluate` makes.
        guide: for "guided": your own, in place of the distance field.
        scorer: for "greedy": `(roadmap, scene) -> Scorer`.
        options: see `PlannerOptions`: num_nodes, max_roadmaps, effort, weights, shorten, sampled,
            checker, resolution, margin, time_limit.

    Raises:
        InputError: an unknown robot, planner or option, or options that do not fit the planner.
    """
    arm = robot if isinstance(robot, Robot) else load_robot(robot)
    return own_planner(arm, make_options(planner, **options), guide, scorer)


def own_planner(
    robot: Robot,
    options: PlannerOptions,
    guide: Guide | None = None,
    scorer: MakeScorer | None = None,
) -> Planner:
    """`make_planner` for all but OMPL's, whose paths nobody certifies before they are returned."""
    made = make_planner(robot, options, guide, scorer)
    if not isinstance(made, Planner):
        raise InputError(
            f"planner {options.planner!r} is one of OMPL's; python -m gnnjax.evaluate takes it"
        )
    return made


@on_host()
def make_planner(
    robot: Robot,
    options: PlannerOptions,
    guide: Guide | None = None,
    scorer: MakeScorer | None = None,
) -> QueryPlanner:
    """The planner that options name; see `load_planner`."""
    check_options(options)
    cache_compilations()  # before a guide compiles
    run_where_called()
    name = options.planner
    if guide is not None and name != "guided":
        raise InputError(f"a guide with planner {name!r}; only planner 'guided' takes one")
    if guide is not None and options.weights is not None:
        raise InputError(
            f"weights={options.weights} with a guide of your own, which has its own; leave them out"
        )
    if scorer is not None and name != "greedy":
        raise InputError(f"a scorer with planner {name!r}; only planner 'greedy' takes one")
    if scorer is None and name == "greedy":
        raise InputError(
            "planner 'greedy' has no scorer; give it one from Python, "
            "load_planner(robot, 'greedy', scorer=...), or choose another planner"
        )
    if options.is_classical:
        from gnnjax.baselines.ompl import ClassicalPlanner

        return ClassicalPlanner(robot, options)
    if name == "guided":
        chosen = with_rest(robot, guide or _guide(robot, options))
        return GuidedPlanner(robot, Guided(robot, chosen, options), options, {"guide": guide})
    if name in ("gnn", "gnn_lazy"):
        from gnnjax.paper import strategy as paper

        return SampledPlanner(robot, paper.from_weights(robot, options), options)
    if scorer is not None:
        chosen = strategy.greedy(robot, options, scorer)
        return SampledPlanner(robot, chosen, options, {"scorer": scorer})
    return SampledPlanner(robot, _STRATEGIES[name](robot, options), options)


def _guide(robot: Robot, options: PlannerOptions) -> Guide:
    """The distance field, or the motion network whose weights the options name."""
    if options.weights is None:
        return field_guide(robot)
    from gnnjax.guide.motion import MotionNetwork, motion_guide
    from gnnjax.training.weights import load_network_as

    return motion_guide(robot, load_network_as(MotionNetwork, options.weights, "guided"))
