"""Writes the results into the texts: docs/results.md and the README's tables.

    python -m experiments.report

Every number comes from the JSON in `results/`; none is typed by hand.
"""

import dataclasses
from pathlib import Path

import tyro

from experiments import paper
from experiments.figure5 import BOUNDED
from experiments.measure import load_results
from experiments.price import GUIDES
from experiments.style import label
from experiments.tables import (
    DETAIL,
    MAIN,
    Row,
    both,
    cell,
    interval,
    markdown,
    planner_table,
    seconds,
)
from gnnjax.errors import InputError, run_command
from gnnjax.files import atomic_write

SETS = {"test": "The project's own 300 test problems", "public": "The first 300 public problems"}


@dataclasses.dataclass(frozen=True)
class ReportConfig:
    """Write all texts that hold results."""

    results: Path = Path("results")
    """Where the JSON is."""
    docs: Path = Path("docs")
    """Where results.md and paper.md go."""
    readme: Path = Path("README.md")
    """Whose tables are replaced."""


def measured_on(results: Row, row: Row) -> str:
    """Problems, seeds and machine, in a sentence."""
    summary, machine = row["summary"], results["machine"]
    num = summary["num_problems"]
    return (
        f"{num} problems, {num - summary['num_invalid']} of them valid "
        f"({summary['num_invalid']} have an end in collision) and "
        f"{summary['hard']['num_problems']} hard; {summary['num_seeds']} seeds. "
        f"{machine['processor']}, {machine['cores']} cores, jax {machine['jax']}, gnnjax "
        f"{machine['gnnjax']}."
    )


# What the README shows of Figure 5, in this order; everything is in docs/results.md.
SHORT_PLANNERS = (
    *("ompl:rrt_connect", "ompl:rrt_connect@simplified", "ompl:bit_star"),
    *("prm", "lazysp", "distance", "gnn_paper", "guided"),
)
SHORT_SIZES = (None, 200, 1000)


def main_tables(results: Row) -> dict[str, str]:
    """The README's short table of each problem set."""
    texts = {}
    for name in SETS:
        found = {
            (row["planner"], row["num_nodes"]): row for row in results["rows"] if row["set"] == name
        }
        keys = [(planner, n) for n in SHORT_SIZES for planner in SHORT_PLANNERS]
        chosen = [found[key] for key in keys if key in found]
        if chosen:
            commands = f"The last row is made by\n\n```sh\n{chosen[-1]['command']}\n```\n"
            texts[name] = "\n".join(
                [planner_table(chosen), measured_on(results, chosen[-1]) + " " + commands]
            )
    return texts


def bounds_table(rows: list[Row]) -> str:
    """Edge checks per edge of the path, hard problems whose first roadmap holds one."""

    def ratio(part: Row | None) -> str:
        return f"{interval(part, '.2f')}, {cell(part, '.1f', key='p95')}"

    lines = []
    for num_nodes in sorted({row["num_nodes"] for row in rows if row["num_nodes"]}):
        found = {row["planner"]: row for row in rows if row["num_nodes"] == num_nodes}
        for planner in BOUNDED:
            if planner not in found or "first_roadmap" not in found[planner]:
                continue  # not compared at this size
            part = found[planner]["first_roadmap"]
            lines.append(
                [str(num_nodes), label(planner)]
                + [cell(part["share"], ".1f", 100), cell(part["edges"], ".2f")]
                + [ratio(part[f"per_{kind}edge"]) for kind in ("", "guided_", "shortest_")]
                + [interval(part["cost_ratio"], ".3f")]
            )
    head = ["N", "planner", "found in it, %", "edges of the path", "checks an edge"]
    head += ["an edge of the guided path", "an edge of LazySP's, all", "cost over PRM's"]
    return markdown(head, lines)


def verification_table(rows: list[Row]) -> str:
    """Configuration checks over those of the returned path alone."""
    lines = []
    for row in rows:
        shown = row["planner"].startswith(("guided", "ompl:rrt_connect"))
        if shown and "per_verification" in row:
            parts = [row["per_verification"][stratum] for stratum in ("all", "hard")]
            line = [str(row["num_nodes"] or "-"), label(row["planner"])]
            line += [" / ".join(cell(part, ".2f", key="median") for part in parts)]
            line += [" / ".join(cell(part, ".2f") for part in parts)]
            lines.append(line)
    return markdown(["N", "planner", "median", "mean"], lines)


def replace_section(text: str, name: str, content: str, source: Path) -> str:
    """Replaces what is between the comments `<!-- name -->` and `<!-- /name -->`."""
    begin, end = f"<!-- {name} -->\n", f"<!-- /{name} -->"
    if begin not in text or end not in text:
        raise InputError(f"{source} lacks the comments {begin.strip()} and {end}; add them")
    head, rest = text.split(begin, 1)
    return head + begin + content + end + rest.split(end, 1)[1]


# An earlier measurement of RRT-Connect (OMPL 1.7) on 1,000 problems of the same public source, with
# PyBullet's checks every 0.02 rad: solved %, configuration checks median and mean, cost; all, hard.
EARLIER = (("all", 98.8, 450, 3567, 10.3), ("hard", 97.4, 764, 7243, 13.1))


def rrt_connect_table(results: Row) -> str:
    """RRT-Connect at both resolutions on the public problems, and the default planner at the finer
    one, beside the earlier measurement."""
    compared = ("ompl:rrt_connect", "ompl:rrt_connect@0.02", "guided@0.02")
    lines = [
        [f"PyBullet, 0.02 rad, {stratum}", f"{solved}", str(median), str(mean), f"{cost}", "-"]
        for stratum, solved, median, mean, cost in EARLIER
    ]
    for row in results["rows"]:
        if row["set"] == "public" and row["planner"] in compared:
            name = "here"
            if row["num_nodes"]:
                name = f"guided, N = {row['num_nodes']}"
            for stratum in ("all", "hard"):
                part = row["summary"][stratum]
                checks = part["configuration_checks"]
                lines.append(
                    [
                        f"{name}, {row['settings']['resolution']} rad, {stratum}",
                        cell(part["success"], ".1f", 100),
                        cell(checks, ".0f", key="median"),
                        cell(checks, ".0f"),
                        cell(part["cost"], ".2f"),
                        cell(part["certified"], ".1f", 100),
                    ]
                )
    head = ["measured", "solved, %", "configuration checks, median", "mean", "cost", "certified, %"]
    return markdown(head, lines)


def crossover_table(results: Row) -> str:
    """From which price of a configuration check on a guide is faster, hard problems."""
    there = {found["guide"] for found in results["crossovers"]}
    guides = [guide for guide in GUIDES if guide in there]
    columns = [(guide, average) for guide in guides for average in ("mean", "median")]
    lines: dict[tuple, dict[tuple, str]] = {}
    for found in results["crossovers"]:
        if found["set"] != "test" or found["stratum"] != "hard" or found["rival"] in GUIDES:
            continue
        rival = label(found["rival"]) + (", checks alone" if found["bound"] else "")
        line = lines.setdefault((str(found["num_nodes"]), rival), {})
        line[found["guide"], found["average"]] = seconds(found["from_s"])
    head = ["N", "against", *[f"{guide}, {average}" for guide, average in columns]]
    return markdown(
        head, [[*key, *[line[column] for column in columns]] for key, line in lines.items()]
    )


def strata_table(rows: list[Row]) -> str:
    """Success and configuration checks, a row a stratum and a column a planner."""

    def column(row: Row) -> tuple[str, int | None]:
        return row["planner"], row["num_nodes"]

    planners = list(dict.fromkeys(map(column, rows)))
    largest = max((num for _, num in planners if num), default=None)
    names = [
        label(p) + (f", N = {num}" if num not in (None, largest) else "") for p, num in planners
    ]
    lines = []
    for stratum in dict.fromkeys(row["stratum"] for row in rows):
        chosen = {column(row): row["summary"] for row in rows if row["stratum"] == stratum}
        num = chosen[planners[0]]["all"]["num_problems"]
        if not num:
            continue
        cells = []
        for planner in planners:
            part = chosen[planner]["all"]
            cells.append(
                f"{cell(part['success'], '.0f', 100)} %, "
                f"{cell(part['configuration_checks'], '.0f')} "
                f"({cell(part['configuration_checks'], '.0f', key='median')})"
            )
        lines.append([stratum.replace("\n", " "), str(num), *cells])
    return markdown(["stratum", "problems", *names], lines)


def failures_table(results: Row) -> str:
    """Dead ends, cost and swinging of each planner."""
    columns = (
        ("dead ends, %", "dead_ends", ".1f", 100.0),
        ("cost over the shortest path's", "cost_ratio", ".3f", 1.0),
        ("paths that turn back, %", "swinging", ".1f", 100.0),
        ("turns of more than 90 degrees a path", "reversals", ".2f", 1.0),
        ("failed where an end lies in a voxel, %", "failure_end_in_voxel", ".1f", 100.0),
        ("failed elsewhere, %", "failure_ends_clear_of_voxels", ".1f", 100.0),
    )
    lines = [
        [str(row["num_nodes"]), label(row["planner"])]
        + [interval(row[name], form, scale) for _, name, form, scale in columns]
        for row in results["rows"]
    ]
    return markdown(["N", "planner", *[title for title, *_ in columns]], lines)


def ablation_table(results: Row) -> str:
    """What each variant of the network does, one roadmap, no second try."""
    lines = [
        [row["variant"]] + [both(row, write) for _, write in DETAIL] for row in results["rows"]
    ]
    return markdown(["variant", *[title for title, _ in DETAIL]], lines)


def arms_table(results: Row) -> str:
    """The default planner on each arm, with weights of different arms."""
    columns = [column for column in DETAIL if column[0] in ARMS_COLUMNS]
    lines = []
    for row in results["rows"]:
        ratios = [interval(row["to_own"][name], ".2f") for name in ARMS_COMPARED]
        lines.append(
            [row["arm"], label(row["planner"])]
            + [both(row, write) for _, write in columns]
            + (ratios if row["planner"].startswith("guided") else ["-"] * len(ratios))
        )
    head = ["arm", "planner", *[title for title, _ in columns]]
    head += [f"{name.replace('_', ' ')} over those with its own weights" for name in ARMS_COMPARED]
    return markdown(head, lines)


ARMS_COLUMNS = ("solved, %", "edge checks", "configuration checks", "cost")
ARMS_COMPARED = ("edge_checks", "configuration_checks")


def predictor_table(results: Row) -> str:
    """Area under the curve and operations of each network and spacing."""
    checks = results["check_operations"]
    lines = []
    for row in results["rows"]:
        line = [row["network"], f"{row['spacing']:g}"]
        for arm, check in checks.items():
            part = row["arms"][arm]
            share = 100 * part["operations"] / check
            line += [f"{part['area']:.4f}", f"{part['operations'] / 1e3:.0f}", f"{share:.0f}"]
        lines.append(line)
    head = ["network", "pieces up to, rad"]
    for arm in checks:
        head += [f"{arm}: area", "thousand operations", "% of a check"]
    return markdown(head, lines)


def results_page(results: dict[str, Row]) -> str:
    """docs/results.md."""
    figure5, figure7, hard = results["figure5"], results["figure7"], results["hard"]
    parts = [
        "# Results\n",
        "Made by `python -m experiments.run_all`, which measures, draws and writes this page; the "
        "numbers are those of the JSON files in [results/](../results). Cells are for all problems "
        "/ for the hard ones, whose straight line is blocked. In brackets: 95 % intervals, "
        "bootstrapped over problems with all their seeds. Every configuration that a planner tests "
        "counts as a configuration check, sampling included, for every planner alike; edges are "
        "tested every 0.05 rad, unless stated otherwise, and a planner that takes more than 5 s a "
        "problem has failed. The machine was shared with other work: times are to be compared with "
        "each other, not with those of other machines.\n",
    ]

    def section(name: str, title: str, *body: str) -> None:
        found = results[name]
        parts.extend(
            [
                f"## {title}\n",
                f"Claim: {found['claim']} {VERDICTS.get(name, '')}".rstrip() + "\n",
                f"`python -m experiments.{name}`, [JSON](../results/{name}.json)\n",
                f"![{title}](../results/{name}.png)\n",
                *body,
            ]
        )

    tables = []
    for name, title in SETS.items():
        chosen = [row for row in figure5["rows"] if row["set"] == name]
        if chosen:
            tables += [f"### {title}\n", measured_on(figure5, chosen[0]) + "\n"]
            tables += ["#### As planners are seen\n", planner_table(chosen, MAIN)]
            tables += ["#### With intervals\n", planner_table(chosen, DETAIL)]
            if any("first_roadmap" in row for row in chosen):
                tables += ["#### Edge checks per edge of the path\n", BOUNDS_NOTE]
                tables += [bounds_table(chosen)]
                tables += ["#### Configuration checks over those of the path alone\n"]
                tables += [VERIFICATION_NOTE, verification_table(chosen)]
    section("figure5", "Seven joints, over roadmap sizes", *tables)
    if any(row["set"] == "public" for row in figure5["rows"]):
        parts += ["### Beside an earlier measurement of RRT-Connect\n", rrt_connect_table(figure5)]
        parts.append(RRT_CONNECT_NOTE)
    section(
        "figure7",
        "Six joints",
        measured_on(figure7, figure7["rows"][0]) + "\n",
        planner_table(figure7["rows"], DETAIL),
    )
    note = "From which price of a configuration check on a guide is faster, hard test problems.\n"
    section("crossover", "When a guide pays", note, crossover_table(results["crossover"]))
    strata = []
    for name, title in SETS.items():
        chosen = [row for row in hard["rows"] if row["set"] == name]
        if chosen:
            strata += [f"### {title}\n", strata_table(chosen)]
    families = [row for row in hard["rows"] if row["set"] not in SETS]
    strata += ["### Families of hard scenes\n", "![Families](families.png)\n"]
    note = "Solved, and configuration checks as mean (median).\n"
    section("hard", "Hard problems", note, *strata, strata_table(families))
    share = results["failures"]["grid"]["start_or_goal_in_a_voxel"]
    section(
        "failures",
        "How the paper's planner fails",
        failures_table(results["failures"]),
        f"Start or goal, free in the scene, collides with the occupancy grid (voxels of 15 cm) in "
        f"{100 * share:.0f} % of the problems.\n",
    )
    if "arms" in results:
        found = results["arms"]
        note = measured_on(found, found["rows"][0]) + "\n"
        section("arms", "One network for all arms", note, arms_table(found))
    if "predictor" in results:
        found = results["predictor"]
        checks = found["check_operations"].items()
        check = ", ".join(f"{count / 1e3:.0f} thousand ({arm})" for arm, count in checks)
        note = (
            f"Operations on an edge of {found['edge_length']:g} rad; checking it every "
            f"{found['resolution']:g} rad takes {check}.\n"
        )
        section("predictor", "Telling edges apart", note, predictor_table(found))
    section("ablation", "Parts of the guidance network", ablation_table(results["ablation"]))
    return "\n".join(parts)


BOUNDS_NOTE = """Hard problems whose first roadmap holds a path. "Found in it": the share of them
that the planner solves on that roadmap, and of which its edges, checks and cost are shown. Cells:
mean (95 % interval), 95th percentile. No search can do with less than one check an edge of its
path. "All" are also those where the planner found no path in that roadmap, and went on to others.
"""

VERIFICATION_NOTE = """Of solved problems, all / hard: configuration checks, sampling included, over
cost / resolution, which is what testing the returned path takes.
"""

RRT_CONNECT_NOTE = """The medians, the share solved and the cost are close to the earlier ones. What
differs: the problems are others of the same source; arms collide as spheres that stand out from the
links by up to 25 mm, which leaves some problems out as invalid and makes the rest a little harder;
and the means hang on the few problems that are not solved within 5 s, whose checks are as many as
the machine can do in that time. Testing every 0.05 rad instead of every 0.02 hardly changes paths
and certificates, only the number of configurations on the same edges.
"""


# What came of each claim.
VERDICTS = {
    "figure5": "It holds. Of edge checks, any search that checks lazily needs few; of "
    "configuration checks, sampling included, only the guided planner needs fewer than RRT-Connect "
    "in the median.",
    "figure7": "It holds for edge checks. It does not hold for planning time against BIT*, which "
    "is done sooner where checks are as cheap as here.",
    "crossover": "It holds against all of them, from the prices below.",
    "hard": "It holds for the guided planner, in every stratum and family where a guide can save "
    "anything.",
    "failures": "All of them are there, and the first three are those of a greedy walk without any "
    "network, too. The lazy search has no dead ends, and its paths are nearly as short as the "
    "roadmap's shortest.",
    "predictor": "It holds from pieces of 0.5 rad on.",
    "ablation": "It does not hold: only the workspace points do. The preset `paper` is far from "
    "converged on this budget.",
}


EXPERIMENTS = ("figure5", "figure7", "crossover", "hard", "failures", "ablation")
LATER = ("arms", "predictor")  # sections that are left out until they were measured


def texts(config: ReportConfig) -> dict[Path, str]:
    """What every file with results should hold."""
    results = {name: load_results(config.results / f"{name}.json") for name in EXPERIMENTS}
    for name in LATER:
        if (config.results / f"{name}.json").exists():
            results[name] = load_results(config.results / f"{name}.json")
    readme = config.readme.read_text(encoding="utf-8")
    for name, table in main_tables(results["figure5"]).items():
        readme = replace_section(readme, f"table-{name}", table, config.readme)
    return {
        config.readme: readme,
        config.docs / "results.md": results_page(results),
        config.docs / "paper.md": paper.page(results),
    }


def run(config: ReportConfig) -> None:
    """Writes the texts."""
    for path, text in texts(config).items():
        atomic_write(path, lambda file, text=text: file.write_text(text, encoding="utf-8"))
        print(f"wrote {path}")


if __name__ == "__main__":
    run_command(lambda: run(tyro.cli(ReportConfig)))
