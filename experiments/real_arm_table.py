"""What the motions that an arm carried out say: picture, table and verdict."""

from collections.abc import Collection
from typing import Any

from matplotlib.figure import Figure

from experiments.carried_out import COUNTS
from experiments.published import REAL_ARM
from experiments.real_arm_parts import OWN, PAPER, PAPER_ARM, PLANNERS, RIVAL
from experiments.record import Finding, judge
from experiments.results import Row
from experiments.statistics import proportion
from experiments.style import draw_bars, label
from experiments.tables import cell, interval, listing, made_on, markdown

_NEARLY = 0.99  # of all problems


def draw(results: Row) -> Figure:
    """Draws bars of the shares that are suitable: a group an arm and payload, over all problems."""
    rows = results["rows"]
    groups = list(dict.fromkeys((row["arm"], row["payload"]) for row in rows))
    shares = {
        planner: [_together(rows, planner, arm, [kg])["share"] for arm, kg in groups]
        for planner in PLANNERS
    }
    figure = Figure(figsize=(11, 4), dpi=100, layout="constrained")
    axes = figure.subplots()
    draw_bars(axes, shares, [f"{arm}\n{kg:g} kg" for arm, kg in groups], 100)
    axes.axhline(100 * REAL_ARM["gnn"]["suitable"], color="0.4", linestyle=":", linewidth=1)
    axes.set_title("suitable motions, % of those whose ends are held (dotted: the paper's 6 of 10)")
    figure.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return figure


def _together(
    rows: list[Row], planner: str, arm: str, payloads: Collection[float]
) -> dict[str, Any]:
    """Counts of a planner over all kinds of problems, and which share of those that are held is
    suitable."""
    own = [
        row
        for row in rows
        if (row["planner"], row["arm"]) == (planner, arm) and row["payload"] in payloads
    ]
    names = ("accepted", "found_by_any", "suitable_held", *COUNTS)
    counts = {name: sum(row[name] for row in own) for name in names}
    # Payloads share their problems, which are what is drawn at random.
    times = max(1, len(payloads))
    share = proportion(counts["suitable_held"] / times, counts["held"] / times)
    return counts | {"share": share, "rows": {(row["family"], row["payload"]) for row in own}}


def _carried(rows: list[Row], arm: str) -> dict[float, bool]:
    """Payloads, and whether the arm can hold them at the ends of nearly all problems."""
    payloads = dict.fromkeys(row["payload"] for row in rows if row["arm"] == arm)
    found = {kg: _together(rows, OWN, arm, [kg]) for kg in payloads}
    return {kg: own["held"] >= _NEARLY * own["accepted"] for kg, own in found.items()}


def table(results: Row) -> str:
    """A line an arm, kind of problems, planner and payload."""
    settings, machine = results["settings"], results["machine"]
    words = (
        f"Up to {settings['num_problems']} problems of each kind and arm whose ends have "
        f"{1e3 * settings['margin']:g} mm to all obstacles, of up to {settings['drawn']} "
        f"that are drawn (`--draws {settings['draws']}`); found by any: by one "
        "of the planners at least. Where there is no path, or a joint swings along it, up to "
        f"{settings['planned']} seeds are tried, but "
        f"for the paper's network; RRT-Connect has {settings['time_limit']:g} s for each. Held: "
        "the arm can rest at both ends with its payload, without what motions leave to the "
        f"controller: {100 * settings['reserve']:g} % of the motors' torques. {_again(results)}The "
        "arm is "
        f"{100 * settings['mass_error']:g} % heavier than its model, has {settings['friction']:g} "
        f"N m of dry friction in each joint, and torques come {1e3 * settings['delay']:g} ms late; "
        "controller: computed torque. Proven: no point of the arm strayed from the curve by as "
        "much as that is proven to keep from all obstacles. Errors are largest ones of a motion. "
        f"{made_on(machine)}.\n"
    )
    head = "arm,problems,planner,payload [kg],drawn,accepted,found by any,found,held,timed,touched"
    columns = [*head.split(","), "swings", "not at rest", "proven", "suitable"]
    columns += [
        "suitable of held, %",
        "duration, s (mean)",
        "turning back (mean)",
        "tip error, mm (median)",
        "95 %",
    ]
    columns += ["stray, mm (95 %)", "largest", "torque of limits, % (95 %)"]
    return words + "\n" + markdown(columns, [_line(row) for row in results["rows"]])


def _again(results: Row) -> str:
    """How often planners had to be told of the payload."""
    number = sum(row["again"] for row in results["rows"])
    share = results["settings"]["rest_share"]
    return (
        f"Of {number} paths that lead through what the arm cannot hold, planners were told to rest "
        f"within {100 * share:g} % of the torques, and planned again (`at_rest_within`). "
    )


def _line(row: Row) -> list[str]:
    head = ("drawn", "accepted", "found_by_any", "found", "held", "timed", "touched", "swings")
    return [
        *(row["arm"], row["family"], label(row["planner"]), f"{row['payload']:g}"),
        *(str(row[name]) for name in head),
        str(row["timed"] - row["settled"]),
        *(str(row[name]) for name in ("proven", "suitable")),
        interval(row["suitable_share"], ".1f", 100),
        cell(row["duration"], ".2f"),
        cell(row["turns"], ".1f"),
        *(cell(row["tip_error"], ".1f", 1e3, key) for key in ("median", "p95")),
        *(cell(row["stray"], ".1f", 1e3, "p95"), f"{1e3 * row['most_stray']:.1f}"),
        cell(row["torque_use"], ".0f", 100, "p95"),
    ]


def verdict(results: Row) -> str:
    """Whether on each arm more motions are suitable than the paper's six of ten, by the interval,
    and at least as many as RRT-Connect's, and none of them touches anything."""
    rows, findings, beside = results["rows"], [], []
    paper = REAL_ARM["gnn"]
    for arm in dict.fromkeys(row["arm"] for row in rows):
        carried = _carried(rows, arm)
        light = [kg for kg, nearly in carried.items() if nearly]
        ours, theirs = (_together(rows, planner, arm, light) for planner in (OWN, RIVAL))
        own, other = ours["share"], theirs["share"]
        if own is not None:
            found = 100 * ours["found"]
            text = (
                f"{arm}, {listing([f'{kg:g}' for kg in light])} kg: of "
                f"{ours['accepted'] // len(light)} problems {found / ours['accepted']:.1f} % are "
                f"found, {found / max(1, ours['found_by_any']):.1f} % of what any planner finds, "
                f"and {interval(own, '.1f', 100)} % are suitable, "
                f"{100 * ours['suitable'] / max(1, ours['found']):.1f} % of those found"
            )
            findings.append(Finding(own["low"] > paper["suitable"], text))
            if ours["rows"] == theirs["rows"] and other is not None:  # of the same problems
                text = f"{arm}: RRT-Connect's, simplified, {interval(other, '.1f', 100)} %"
                findings.append(Finding(own["mean"] >= other["mean"], text))
            else:
                beside.append(f"RRT-Connect is not measured on all that guided is on {arm}.")
        for kg in (kg for kg, nearly in carried.items() if not nearly):
            heavy = _together(rows, OWN, arm, [kg])
            share = heavy["held"] / max(1, heavy["accepted"])
            beside.append(
                f"{arm} can hold {kg:g} kg at both ends of {100 * share:.0f} % of the problems; "
                f"of these {interval(heavy['share'], '.1f', 100)} % are suitable."
            )
    timed, touched = (sum(row[name] for row in rows) for name in ("timed", "touched"))
    findings.append(
        Finding(not touched, f"of {timed} motions {touched or 'none'} touched anything")
    )
    most = max((row["most_stray"] for row in rows), default=0.0)
    beside.append(f"No point of an arm strayed from its curve by more than {1e3 * most:.1f} mm.")
    network = _together(rows, PAPER, PAPER_ARM, _carried(rows, PAPER_ARM))
    if network["share"] is not None:
        beside += [
            f"The paper's network finds {100 * network['found'] / network['accepted']:.1f} %, and "
            f"{interval(network['share'], '.1f', 100)} % are suitable; the paper states "
            f"{100 * paper['found']:.0f} % found and {100 * paper['suitable']:.0f} % suitable."
        ]
    return judge(*findings, beside=beside)
