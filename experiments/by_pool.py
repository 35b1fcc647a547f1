"""Throughput by pool and planner: pictures, tables and ratios."""

import numpy as np
from matplotlib.figure import Figure

from experiments.published import VAMP_PLAN_S
from experiments.results import Row
from experiments.style import COLORS, label, make_logarithmic
from experiments.tables import cell, made_on, markdown, seconds

OWN = ("guided", "guided_roadmap")
RIVALS = {"guided": "ompl:rrt_connect@simplified", "guided_roadmap": "ompl:rrt_connect"}
STRATA = {"accepted": "all accepted problems", "solved": "problems that guided solves"}


def of_stratum(results: Row, stratum: str) -> dict[tuple[str, int | None], Row]:
    """The rows of a stratum by planner and pool."""
    rows = [row for row in results["rows"] if row["stratum"] == stratum]
    return {(row["planner"], row["pool"]): row for row in rows}


def ratio(ours: Row, theirs: Row) -> float:
    """Median over the turns of one's plans a second over the other's."""
    return float(np.median(np.array(ours["per_s"]) / np.array(theirs["per_s"])))


def ratio_a_core(ours: Row, theirs: Row) -> float:
    """The same of plans a second of CPU time, which other work on the machine changes less."""
    per_core = (np.array(row["per_s"]) / np.array(row["cores"]) for row in (ours, theirs))
    return float(np.median(np.divide(*per_core)))


def draw(results: Row) -> Figure:
    """Draws plans a second over the pool: median and span of the turns, a panel a stratum."""
    figure = Figure(figsize=(11, 4.2), dpi=100, layout="constrained")
    panels = figure.subplots(1, 2, sharex=True, sharey=True)
    for (stratum, title), axes in zip(STRATA.items(), panels, strict=True):
        rows = of_stratum(results, stratum)
        for planner in (*OWN, *RIVALS.values()):
            color, name = COLORS[planner], label(planner)
            here = sorted(
                (row["pool"] or 0, row["per_s"])
                for row in rows.values()
                if row["planner"] == planner
            )
            if not here:
                continue
            pools, rates = [pool for pool, _ in here], [rate for _, rate in here]
            low, middle, high = np.array([(min(r), np.median(r), max(r)) for r in rates]).T
            if planner in OWN:
                error = [middle - low, high - middle]
                axes.errorbar(pools, middle, error, fmt="o-", color=color, label=name, capsize=3)
            else:
                axes.axhline(middle[0], color=color, linestyle="--", label=name)
                axes.axhspan(low[0], high[0], color=color, alpha=0.12, lw=0)
        axes.set(title=title, xlabel="problems planned at once")
        make_logarithmic(axes, "xy")
    panels[0].set_ylabel("problems a second")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    return figure


def table(results: Row) -> str:
    """Plans a second beside what they are worth, a table a stratum."""
    settings, memory = results["settings"], results["peak_memory"]
    machine = results["machine"]
    parts = [
        f"{settings['num_problems']} distinct problems of {settings['set']}.npz, shared by "
        f"{settings['processes']} processes; RRT-Connect takes at most "
        f"{settings['time_limit']:g} s a problem. Pools of one plan the first "
        f"{settings['singles']} problems in one process. {made_on(machine)}. A process "
        f"that plans {memory['pool']} problems at once needs {memory['MiB']:.0f} MiB at most. "
        f"VAMP's own figures, on another machine and other problems (C++ with SIMD, the Panda in "
        f"MotionBenchMaker's scenes): {seconds(VAMP_PLAN_S['first path'])} a plan, "
        f"{seconds(VAMP_PLAN_S['simplified'])} with simplification, in the mean.\n"
    ]
    head = [
        "planner",
        "pool",
        "plans/s (least to most)",
        "cores busy",
        "plans a second of CPU time",
    ]
    head += [
        "solved of all, %",
        "of accepted, %",
        "paths certified, %",
        "cost, mean",
        "configuration checks, median",
    ]
    head += ["mean", "total of single queries, ms, median", "mean", "95th percentile"]
    for stratum, title in STRATA.items():
        rows = list(of_stratum(results, stratum).values())
        rows.sort(
            key=lambda row: ((*OWN, *RIVALS.values()).index(row["planner"]), row["pool"] or 0)
        )
        if rows:
            num, valid = rows[-1]["num_problems"], rows[-1]["num_accepted"]
            parts.append(f"{title.capitalize()} ({valid} of {num}):\n")
            parts.append(markdown(head, [_line(row) for row in rows]))
    return "\n".join(parts)


def _line(row: Row) -> list[str]:
    rates, checks = row["per_s"], row["configuration_checks"]
    single = row["total_time_s"] if row["pool"] in (1, None) else None

    def percent(share: float | None) -> str:
        return "-" if share is None else f"{100 * share:.1f}"

    return [
        label(row["planner"]),
        str(row["pool"] or "-"),
        f"{np.median(rates):.1f} ({min(rates):.1f} to {max(rates):.1f})",
        f"{np.median(row['cores']):.2f}",
        f"{np.median(np.array(rates) / row['cores']):.1f}",
        *(percent(row[name]) for name in ("success_of_all", "success", "certified_paths")),
        cell(row["cost"], ".2f"),
        *(cell(checks, ".0f", key=key) for key in ("median", "mean")),
        *(cell(single, ".1f", 1e3, key) for key in ("median", "mean", "p95")),
    ]
