"""What ten million plans take on many machines, by the plans a second of one: in docs/cluster.md.

Called by `experiments.report`. The number comes from `results/throughput.json`.
"""

import statistics
from pathlib import Path

from experiments.readme import replace_section
from experiments.results import Row

PLANS, MACHINES, POOL = 10_000_000, 64, 1024


def page(text: str, throughput: Row, source: Path) -> str:
    """docs/cluster.md with that paragraph made anew."""
    return replace_section(text, "ten-million", _paragraph(throughput), source)


def _paragraph(throughput: Row) -> str:
    (row,) = (
        row
        for row in throughput["rows"]
        if (row["planner"], row["stratum"], row["pool"]) == ("guided", "accepted", POOL)
    )
    per_s, cores = (statistics.median(row[name]) for name in ("per_s", "cores"))
    seconds, hours = PLANS / MACHINES / per_s, PLANS / per_s * cores / 3600
    return (
        f"**{per_s:.0f} plans a second** on one machine, by {throughput['settings']['processes']} "
        f"processes. Ten million take {seconds:.0f} s on {MACHINES} such machines, and "
        f"{hours:.0f} hours of CPU time in all.\n"
    )
