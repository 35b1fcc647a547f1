"""What is concluded about the paper: statements, each with what the results say of it.

A statement stays when results change, and so does what it is judged by; numbers and judgement are
computed.
"""

from collections.abc import Callable

from experiments.published import FIGURE5
from experiments.record import Finding, judge
from experiments.results import Measured, Row, of_set
from experiments.style import label
from experiments.tables import SETS, interval, listing, span

CLOSE = 0.01  # shares that differ by less than this count as about the same


def conclusions(results: dict[str, Row]) -> str:
    """A list of all statements in Markdown."""
    return "\n".join(
        f"- **{statement}** {judge(*findings(results))}"
        for statement, findings in STATEMENTS.items()
    )


def lazy_checking(results: dict[str, Row]) -> list[Finding]:
    """Planners without a network save about what the paper's saves of PRM's edge checks."""
    seven = Measured(of_set(results["figure5"], "test"))
    planners = ("gnn_paper", "distance", "lazysp")
    saved = {p: 1 - seven.ratio(p, "prm", "edge_checks") for p in planners}
    words = listing([f"{label(p)} {100 * share:.2f} %" for p, share in saved.items()])
    close = max(saved.values()) - min(saved.values()) < CLOSE
    return [Finding(close, f"of PRM's edge checks are saved by {words}")]


def paper_network(results: dict[str, Row]) -> list[Finding]:
    """On the same roadmaps, one each, intervals of the distance and of every training overlap."""
    rows = results["converged"]["rows"]
    settings, trainings = rows[0]["settings"], [row for row in rows if row["difference"]]
    (distance,) = (row["summary"]["all"] for row in rows if not row["difference"])
    networks = [row["summary"]["all"] for row in trainings]
    findings = [
        Finding(
            all(_overlap(network[name], distance[name]) for network in networks),
            f"{words} {listing([interval(network[name], form, scale) for network in networks])} "
            f"with it, {interval(distance[name], form, scale)} with the distance",
        )
        for name, words, form, scale in (
            ("success", f"% solved at N = {settings['num_nodes']}, one roadmap", ".1f", 100),
            ("edge_checks", "edge checks", ".1f", 1),
            ("cost", "cost", ".2f", 1),
        )
    ]
    figure5 = Measured(of_set(results["figure5"], "test"))
    solved, stated = figure5.mean("gnn_paper", "success"), FIGURE5["gnn"]["success"]
    text = f"{100 * solved:.1f} % solved over all sizes, of the {100 * stated:.0f} % it states"
    return [*findings, Finding(solved < stated, text)]


def parts(results: dict[str, Row]) -> list[Finding]:
    """No part of the paper's network saves edge checks by more than the interval."""
    begin = "paper's network without "
    saved = {
        name.removeprefix(begin): row["difference"]["edge_checks"]
        for name, row in _variants(results).items()
        if name.startswith(begin)
    }
    none = all(more["low"] <= 0 for more in saved.values())
    words = listing([f"{part} {interval(more, '.1f')}" for part, more in saved.items()])
    return [Finding(none, f"edge checks a problem that the parts save: {words}")]


def workspace(results: dict[str, Row]) -> list[Finding]:
    """Without its workspace points the default network is as the distance; few problems do."""
    rows = _variants(results)
    checks = {name: row["summary"]["all"]["edge_checks"] for name, row in rows.items()}
    blind, distance = "default without workspace points", "no network, distance to the goal"
    shown = f"without its points {interval(checks[blind], '.1f')}, of the distance to the goal "
    shown += interval(checks[distance], ".1f")
    fewest = min(
        (name for name in rows if name.startswith("default, ")),
        key=lambda name: int(name.split()[1]),
    )
    learned = f"the default network {interval(checks['default'], '.1f')}"
    few = rows[fewest]["difference"]["edge_checks"]
    return [
        Finding(checks["default"]["high"] < checks[blind]["low"], f"edge checks of {learned}"),
        Finding(_overlap(checks[blind], checks[distance]), shown),
        Finding(
            few["low"] <= 0,
            f"trained with {fewest.split(', ')[1]} alone, {interval(few, '.1f')} more a problem",
        ),
    ]


def dead_ends(results: dict[str, Row]) -> list[Finding]:
    """The lazy search has none, and its paths are about the shortest."""
    rows = [row for row in results["failures"]["rows"] if row["planner"] == "gnn_lazy"]
    shares, costs = ([row[n]["mean"] for row in rows] for n in ("dead_ends", "cost_ratio"))
    return [
        Finding(max(shares) == 0, f"the lazy search has {span(shares, '.1f', 100)} % dead ends"),
        Finding(max(costs) < 1 + CLOSE, f"its paths are {span(costs, '.3f')} times the shortest"),
    ]


def nodes(results: dict[str, Row]) -> list[Finding]:
    """Sampling alone costs more than RRT-Connect; guided costs less, and less than simplifying."""
    seven = Measured(of_set(results["figure5"], "test"))
    rrt, simplified = "ompl:rrt_connect", "ompl:rrt_connect@simplified"

    def medians(planner: str, quantity: str, stratum: str = "all") -> list[float]:
        return seven.each(planner, quantity, stratum=stratum, key="median")

    checks = "configuration_checks"
    found = []
    sampled, needed = medians("gnn_lazy", "sampling_checks"), medians(rrt, checks)
    text = f"in the median gnn_lazy samples with {span(sampled, '.0f')} configuration checks, "
    text += f"where RRT-Connect needs {span(needed, '.0f')} in all"
    found.append(Finding(min(sampled) > max(needed), text))
    for stratum, words in {"all": "guided needs", "hard": "on hard problems guided needs"}.items():
        ours, theirs = (medians(planner, checks, stratum) for planner in ("guided", rrt))
        text = f"{words} {span(ours, '.0f')}, RRT-Connect {span(theirs, '.0f')}"
        found.append(Finding(max(ours) < min(theirs), text))
    costs = [seven.each(planner, "cost") for planner in ("guided", simplified)]
    ratio, of_hard = (
        min(medians(simplified, checks, stratum)) / max(medians("guided", checks, stratum))
        for stratum in ("all", "hard")
    )
    text = f"RRT-Connect with simplification takes {ratio:.0f} times the checks of guided in the "
    text += f"median over all problems, {of_hard:.1f} times on hard ones, to cost "
    text += f"{span(costs[1], '.2f')} beside {span(costs[0], '.2f')}"
    return [*found, Finding(min(ratio, of_hard) > 1, text)]


def hard_scenes(results: dict[str, Row]) -> list[Finding]:
    """In every family guided checks least where checks are dear, and solves as many as RRT-Connect.

    Where they are cheap it spends them, so that its factor is told and not judged.
    """
    rows = [row for row in results["hard"]["rows"] if row["set"] not in SETS]
    families = list(dict.fromkeys(row["set"] for row in rows))
    means = {
        (name, row["planner"], row["set"]): row["summary"]["all"][name]["mean"]
        for name in ("configuration_checks", "success")
        for row in rows
    }
    guided = ("guided_dear", "guided")
    rivals = dict.fromkeys(row["planner"] for row in rows if row["planner"] not in guided)
    dear, cheap = (
        [
            means["configuration_checks", planner, family]
            / means["configuration_checks", p, family]
            for family in families
            for p in rivals
        ]
        for planner in guided
    )
    solved = [
        sum(means["success", planner, family] for family in families) / len(families)
        for planner in ("guided_dear", "ompl:rrt_connect")
    ]
    text = f"it tests {span(dear, '.0f', 100)} % of the configurations of the others (guided, for "
    text += f"which a check costs next to nothing, {span(cheap, '.0f', 100)} %)"
    both = f"{100 * solved[0]:.1f} % solved, {100 * solved[1]:.1f} % by RRT-Connect"
    return [Finding(max(dear) < 1, text), Finding(solved[0] > solved[1] - CLOSE, both)]


def sooner(results: dict[str, Row]) -> list[Finding]:
    """RRT-Connect's median time is below the guided planner's."""
    seven = Measured(of_set(results["figure5"], "test"))
    times = [seven.each(p, "total_time_s", key="median") for p in ("ompl:rrt_connect", "guided")]
    theirs, ours = (span(part, ".1f", 1e3) for part in times)
    return [Finding(max(times[0]) < min(times[1]), f"RRT-Connect {theirs} ms, guided {ours} ms")]


def transfer(results: dict[str, Row]) -> list[Finding]:
    """Networks of the other arm are as good as the arm's own, within the intervals."""
    rows = {row["planner"]: row["summary"]["all"] for row in results["figure7"]["rows"]}
    return [
        Finding(
            _overlap(rows[planner]["edge_checks"], rows[f"{planner}_own"]["edge_checks"]),
            f"edge checks of {planner} with the Kuka's network "
            f"{interval(rows[planner]['edge_checks'], '.1f')}, with its own "
            f"{interval(rows[f'{planner}_own']['edge_checks'], '.1f')}",
        )
        for planner in ("gnn", "gnn_lazy")
        if f"{planner}_own" in rows
    ]


def certification(results: dict[str, Row]) -> list[Finding]:
    """Some planners return paths that cannot be certified; the guided one returns none."""
    rows = of_set(results["figure5"], "test")

    def lost(row: Row) -> float:
        return row["summary"]["all"]["success"]["mean"] - row["summary"]["all"]["certified"]["mean"]

    most = max(rows, key=lost)
    ours = max(lost(row) for row in rows if row["planner"] == "guided")
    return [
        Finding(
            lost(most) > 0,
            f"in {100 * lost(most):.1f} % of the problems {label(most['planner'])} returns a path "
            "that is not certified",
        ),
        Finding(ours == 0, f"guided in {100 * ours:.1f} %"),
    ]


STATEMENTS: dict[str, Callable[[dict[str, Row]], list[Finding]]] = {
    "Few edge checks come from checking lazily, not from the network.": lazy_checking,
    "The paper's network adds nothing measurable to the distance to the goal.": paper_network,
    "Nor do its parts.": parts,
    "Seeing the arm in the workspace is what makes a guide.": workspace,
    "Dead ends belong to the greedy walk, not to the network.": dead_ends,
    "Most checks of a roadmap are those of its nodes, which can be tested lazily, too.": nodes,
    "On scenes that are hard on purpose, guided tests least where checks are dear.": hard_scenes,
    "Where checks are as cheap as here, RRT-Connect is done sooner in the median.": sooner,
    "The transfer to six joints works.": transfer,
    "Certification matters.": certification,
}


def _variants(results: dict[str, Row]) -> dict[str, Row]:
    return {row["variant"]: row for row in results["ablation"]["rows"]}


def _overlap(one: Row, other: Row) -> bool:
    """Whether two intervals have a number in common."""
    return one["low"] <= other["high"] and other["low"] <= one["high"]
