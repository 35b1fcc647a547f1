"""The paper's claims beside what was measured here: writes docs/paper.md.

Called by `experiments.report`. Numbers come from `results/`; the paper's are those it states in
words, as its figures have no tables.
"""

from collections.abc import Callable
from pathlib import Path

from experiments.conclusions import conclusions
from experiments.published import (
    FIGURE5,
    FIGURE5_CHECK_SHARES,
    FIGURE5_SUCCESS_AT_1000,
    FIGURE7,
)
from experiments.results import Measured, Row, of_set
from experiments.style import label
from experiments.tables import listing, markdown, seconds

TEMPLATE = Path(__file__).with_name("paper_template.md")

RIVAL_COLUMNS = [
    *("planner", "N", "solved", "certified", "edge checks"),
    *("configuration checks, mean", "median", "cost", "total time, median, ms"),
]


def percent(value: float, digits: int = 1) -> str:
    """A share as a percentage."""
    return f"{100 * value:.{digits}f} %"


def claims(figure5: Row, figure7: Row) -> list[list[str]]:
    """Rows of the table: claim; paper; its network and protocol here; default network here."""
    seven, six = Measured(of_set(figure5, "test")), Measured(figure7["rows"])
    rows: list[list[str]] = []

    def row(claim: str, paper: str, here: Callable[[str], str]) -> None:
        rows.append([claim, paper, here("gnn_paper"), here("gnn"), here("gnn_lazy")])

    paper = FIGURE5["gnn"]
    row("success, R^7", percent(paper["success"], 0), lambda p: percent(seven.mean(p, "success")))
    row(
        "success at N = 1000",
        f"up to {percent(FIGURE5_SUCCESS_AT_1000, 0)}",
        lambda p: percent(seven.mean(p, "success", num_nodes=1000)),
    )
    for other, name in (("prm", "PRM"), ("ompl:bit_star", "BIT*"), ("ompl:rrt_star", "RRT*")):
        row(
            f"edge checks, share of {name}'s",
            percent(FIGURE5_CHECK_SHARES[other], 2),
            lambda p, other=other: percent(seven.ratio(p, other, "edge_checks"), 2),
        )
    row(
        "planning time, PRM's over its own",
        f"{FIGURE5['prm']['planning_time_s'] / paper['planning_time_s']:.0f} times",
        lambda p: f"{seven.ratio('prm', p, 'planning_time_s', key='median'):.1f} times",
    )
    row(
        "planning time's share of the total",
        percent(paper["planning_time_s"] / paper["total_time_s"], 0),
        lambda p: percent(
            seven.mean(p, "planning_time_s", key="median")
            / seven.mean(p, "total_time_s", key="median"),
            0,
        ),
    )
    row("path cost", f"{paper['cost']:.2f}", lambda p: f"{seven.mean(p, 'cost'):.2f}")
    row(
        "path cost over PRM's",
        f"{paper['cost'] / FIGURE5['prm']['cost']:.2f}",
        lambda p: f"{seven.ratio(p, 'prm', 'cost'):.2f}",
    )
    row(
        "standard deviation of the edge checks",
        "the smallest",
        lambda p: f"{seven.mean(p, 'edge_checks', key='std'):.1f}",
    )
    row(
        "R^6: fewer edge checks than PRM by",
        percent(FIGURE7["edge_checks"]["saved"]),
        lambda p: percent(1 - six.ratio(p, "prm", "edge_checks"), 2),
    )
    row(
        "R^6: less planning time than BIT* by",
        percent(FIGURE7["planning_time_s"]["saved"]),
        lambda p: percent(1 - six.ratio(p, "ompl:bit_star", "planning_time_s")),
    )
    return rows


def rivals(figure5: Row) -> list[list[str]]:
    """Rows of the table of planners that the paper leaves out, at two sizes, hard problems."""
    seven = Measured(of_set(figure5, "test"))
    lines = []
    for planner, sizes in (
        ("gnn_paper", (200, 1000)),
        ("gnn", (200, 1000)),
        ("gnn_lazy", (200, 1000)),
        ("distance", (200, 1000)),
        ("lazysp", (200, 1000)),
        ("oracle", (200, 1000)),
        ("ompl:rrt_connect", (None,)),
        ("ompl:bit_star", (None,)),
        ("ompl:rrt_star", (None,)),
        ("ompl:prm", (None,)),
    ):
        for size in sizes:

            def value(quantity: str, key: str = "mean", p: str = planner, n=size) -> float:
                return seven.mean(p, quantity, num_nodes=n, stratum="hard", key=key)

            lines.append(
                [
                    planner,
                    str(size or "-"),
                    percent(value("success")),
                    percent(value("certified")),
                    f"{value('edge_checks'):.1f}",
                    f"{value('configuration_checks'):.0f}",
                    f"{value('configuration_checks', 'median'):.0f}",
                    f"{value('cost'):.2f}",
                    f"{1e3 * value('total_time_s', 'median'):.1f}",
                ]
            )
    return lines


def swinging(failures: Row, planner: str, quantity: str, num_nodes: int) -> Row:
    """A failure's statistics."""
    return next(
        row[quantity]
        for row in failures["rows"]
        if row["planner"] == planner and row["num_nodes"] == num_nodes
    )


def weaknesses(failures: Row) -> list[list[str]]:
    """Rows of the table of weaknesses, at the smallest and the largest roadmap size."""
    sizes = sorted({row["num_nodes"] for row in failures["rows"]})

    def cells(quantity: str, write: Callable[[float], str]) -> list[str]:
        return [
            " / ".join(write(swinging(failures, p, quantity, n)["mean"]) for n in sizes)
            for p in ("gnn_paper", "gnn", "gnn_lazy", "distance")
        ]

    voxels = cells("failure_end_in_voxel", percent), cells("failure_ends_clear_of_voxels", percent)
    return [
        ["dead ends, of roadmaps that hold a path", *cells("dead_ends", percent)],
        ["cost over the roadmap's shortest path", *cells("cost_ratio", lambda x: f"{x:.2f}")],
        ["paths that turn back by more than 90 degrees", *cells("swinging", percent)],
        ["failed, start or goal in an occupied voxel", *voxels[0]],
        ["failed, both clear of occupied voxels", *voxels[1]],
    ]


def page(results: dict[str, Row]) -> str:
    """docs/paper.md."""
    figure5, figure7, failures = results["figure5"], results["figure7"], results["failures"]
    sizes = sorted({row["num_nodes"] for row in failures["rows"]})
    first = of_set(figure5, "test")[0]
    heads = ("its network and protocol, here", "default network, greedy", "default network, lazy")
    share = failures["grid"]["start_or_goal_in_a_voxel"]
    return TEMPLATE.read_text(encoding="utf-8").format(
        claims=markdown(["claim", "paper", *heads], claims(figure5, figure7)),
        rivals=markdown(
            RIVAL_COLUMNS,
            [[label(line[0]), *line[1:]] for line in rivals(figure5)],
        ),
        weaknesses=markdown(
            ["weakness", "paper's network", *heads[1:], "distance to the goal"],
            weaknesses(failures),
        ),
        sizes=" / ".join(str(n) for n in sizes),
        voxels=percent(share, 0),
        conclusions=conclusions(results),
        check=seconds(results["crossover"]["marks_s"]["our fused kernel"]),
        resolution=first["settings"]["resolution"],
        problems=first["summary"]["num_problems"],
        seven_sizes=listing([str(n) for n in Measured(of_set(figure5, "test")).sizes]),
        six_sizes=listing([str(n) for n in Measured(figure7["rows"]).sizes]),
    )
