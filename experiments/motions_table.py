"""What motions in time say, beside those along RRT-Connect's paths and toppra's: picture, table and
verdict."""

import numpy as np
from matplotlib.figure import Figure

from experiments.record import Finding, judge
from experiments.results import Row
from experiments.style import draw_bars, label
from experiments.tables import made_on, markdown

OWN, RIVAL = "guided", "ompl:rrt_connect@simplified"
_SLACK, _CLOSE = 1e-3, 0.01  # of limits; of toppra's durations
_MANY, _SOON = 250, 0.02  # motions a second of a core; s


def draw(results: Row) -> Figure:
    """Draws durations beside RRT-Connect's, and over toppra's."""
    rows = results["rows"]
    figure = Figure(figsize=(11, 4), dpi=100, layout="constrained")
    left, right = figure.subplots(1, 2)
    groups = [(row, name) for row in rows for name in row["durations"]]
    heights = {p: [row["durations"][name][p] for row, name in groups] for p in (OWN, RIVAL)}
    draw_bars(left, heights, [f"{row['arm']}\n{name}" for row, name in groups])
    left.tick_params(axis="x", labelsize=7)
    left.set_title("duration, mean [s]")
    left.legend()
    right.boxplot([row["toppra"]["ratios"] for row in rows], whis=(0, 100))
    right.set_xticks(range(1, len(rows) + 1), [row["arm"] for row in rows])
    right.axhline(1.0, color="gray", linewidth=0.8)
    right.set_title("duration over toppra's, same curves")
    return figure


def table(results: Row) -> str:
    """A line an arm and planner, and one an arm beside toppra."""
    lines, beside = [], []
    for row in results["rows"]:
        for planner, own in row["planners"].items():
            means = [f"{part[planner]:.2f}" for part in row["durations"].values()]
            lines.append(
                [
                    row["arm"],
                    label(planner),
                    f"{own['motions']} of {own['paths']}",
                    str(own["certified"]),
                    str(own["stops"]),
                    f"{100 * own['largest_use']:.2f}",
                    " / ".join(means),
                ]
            )
        ratios, lone = np.array(row["toppra"]["ratios"]), row["lone_s"]
        beside.append(
            [
                row["arm"],
                f"{row['per_s']:.0f} ({row['cores']:.1f})",
                f"{1e3 * lone['median']:.1f} / {1e3 * lone['p95']:.1f}",
                str(len(ratios)),
                f"{ratios.mean():.4f} ({ratios.min():.4f} to {ratios.max():.4f})",
                f"{row['toppra']['failed']} / {row['toppra']['theirs_failed']}",
            ]
        )
    settings = results["settings"]
    head = ["arm", "paths of", "motions", "certified", "corners stopped at"]
    head += ["largest use of a limit, %", "duration, s, mean, all / hard"]
    more = ["arm", "motions/s (cores)", "one by one, ms, median / 95th", "beside toppra"]
    more += ["duration over its own", "none found, here / there"]
    return "\n".join(
        [
            f"{settings['num_problems']} test problems an arm; batches of {settings['batch']}. "
            f"{made_on(results['machine'])}.\n",
            markdown(head, lines),
            markdown(more, beside),
        ]
    )


def verdict(results: Row) -> str:
    """Whether limits hold, durations are toppra's, and shorter than those of the rival's paths."""
    rows = results["rows"]
    parts = [own for row in rows for own in row["planners"].values()]
    num, use = sum(own["motions"] for own in parts), max(own["largest_use"] for own in parts)
    ratios = np.concatenate([row["toppra"]["ratios"] for row in rows])
    failed = sum(row["toppra"]["failed"] for row in rows)
    findings = [
        Finding(use <= 1 + _SLACK, f"{num} motions use {100 * use:.2f} % of a limit at most"),
        Finding(
            bool((np.abs(ratios - 1) <= _CLOSE).all()) and not failed,
            f"{len(ratios)} take {ratios.min():.4f} to {ratios.max():.4f} times as long as "
            f"toppra's, which finds {failed} that are not found here",
        ),
    ]
    for row in rows:
        shares = [part[OWN] / part[RIVAL] for part in row["durations"].values()]
        words = " and ".join(
            f"{share:.2f} ({name})" for share, name in zip(shares, row["durations"], strict=True)
        )
        findings.append(
            Finding(max(shares) < 1, f"{row['arm']}: {words} times as long as {label(RIVAL)}")
        )
    for row in rows:
        lone = row["lone_s"]["median"]
        findings.append(
            Finding(
                row["per_s"] / row["cores"] >= _MANY and lone < _SOON,
                f"{row['arm']}: {row['per_s'] / row['cores']:.0f} motions a second of a core, one "
                f"alone in {1e3 * lone:.1f} ms",
            )
        )
    return judge(*findings)
