"""Names and colors of the planners, the same in all figures and tables."""

COLORS = {
    "gnn": "tab:red",
    "gnn_lazy": "tab:pink",
    "gnn_paper": "tab:brown",
    "distance": "tab:orange",
    "lazysp": "tab:green",
    "prm": "tab:blue",
    "oracle": "black",
    "ompl:rrt_connect": "tab:purple",
    "ompl:bit_star": "tab:olive",
    "ompl:rrt_star": "tab:gray",
    "ompl:prm": "tab:cyan",
}

_LABELS = {
    "gnn_paper": "paper's network, one roadmap",
    "ompl:rrt_connect": "RRT-Connect",
    "ompl:rrt_connect@0.02": "RRT-Connect, every 0.02 rad",
    "ompl:bit_star": "BIT*",
    "ompl:rrt_star": "RRT*",
    "ompl:prm": "PRM (OMPL)",
    "ompl:lazy_prm": "LazyPRM",
    "ompl:ait_star": "AIT*",
    "ompl:eit_star": "EIT*",
}


def label(planner: str) -> str:
    """What a planner is called in figures and tables."""
    return _LABELS.get(planner, planner)
