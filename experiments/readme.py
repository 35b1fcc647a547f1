"""The README's tables: a few planners of Figure 5, between comments that name each table."""

from pathlib import Path

from experiments.results import Row, of_set
from experiments.tables import SETS, measured_on, planner_table
from gnnjax.errors import InputError

# What the README shows of Figure 5, in this order; everything is in docs/results.md.
SHORT_PLANNERS = (
    *("ompl:rrt_connect", "ompl:rrt_connect@simplified", "ompl:bit_star"),
    *("prm", "lazysp", "distance", "gnn_paper", "guided_dear", "guided"),
)
SHORT_SIZES = (None, 200, 1000)


def main_tables(results: Row) -> dict[str, str]:
    """The README's short table of each problem set."""
    texts = {}
    for name in SETS:
        found = {(row["planner"], row["num_nodes"]): row for row in of_set(results, name)}
        keys = [(planner, n) for n in SHORT_SIZES for planner in SHORT_PLANNERS]
        chosen = [found[key] for key in keys if key in found]
        if chosen:
            default = found.get(("guided", None), chosen[-1])
            made_by = f"The row of {default['planner']} is made by"
            command = f"{made_by}\n\n```sh\n{default['command']}\n```\n"
            measured = f"{measured_on(results, default)} {command}"
            texts[name] = f"{planner_table(chosen)}\n{measured}"
    return texts


def replace_section(text: str, name: str, content: str, source: Path) -> str:
    """Replaces what is between the comments `<!-- name -->` and `<!-- /name -->`."""
    begin, end = f"<!-- {name} -->\n", f"<!-- /{name} -->"
    if begin not in text or end not in text:
        raise InputError(f"{source} lacks the comments {begin.strip()} and {end}; add them")
    head, rest = text.split(begin, 1)
    return head + begin + content + end + rest.split(end, 1)[1]


def readme(text: str, figure5: Row, source: Path) -> str:
    """The README with its tables made anew."""
    for name, table in main_tables(figure5).items():
        text = replace_section(text, f"table-{name}", table, source)
    return text
