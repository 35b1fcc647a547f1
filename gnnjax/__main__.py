"""Names the commands: `python -m gnnjax`."""

import sys

COMMANDS = {
    "plan": "plan one query, write its path, motion, picture or film",
    "view": "plan in the browser, where start, goal and obstacles can be dragged",
    "execute": "carry a motion out in simulation",
    "fit": "fit spheres to an arm of your own, and see them",
    "generate": "draw problems; for training also roadmaps and labels",
    "evaluate": "plan all problems of a set, and sum up",
    "planner_arena": "results of evaluate as a database for OMPL's Planner Arena",
    "train_motion": "train a motion network, a guide that learns",
    "train": "train a guidance network (the paper's with --preset paper)",
}


def main() -> int:
    """Prints what there is; 2 where something else was asked for."""
    lines = [f"  python -m gnnjax.{name:<15}{text}" for name, text in COMMANDS.items()]
    print("\n".join(["The commands, each of which has --help:", "", *lines]))
    unknown = [name for name in sys.argv[1:] if name not in ("-h", "--help")]
    if unknown:
        name = unknown[0]
        hint = f"write python -m gnnjax.{name}" if name in COMMANDS else "choose one of those above"
        print(f"error: no command {name!r} here; {hint}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
