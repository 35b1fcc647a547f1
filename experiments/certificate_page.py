"""What was looked at of certified motions, arm by arm: writes docs/certificate.md.

Called by `experiments.report`. Numbers come from `results/certify_campaign.json` and
`results/certify_curves.json`, those of an earlier certificate from `published.py`.
"""

import json
from pathlib import Path
from typing import Any

from experiments.published import BY_REACH_ALONE
from experiments.tables import markdown
from gnnjax.errors import InputError

TEMPLATE = Path(__file__).with_name("certificate_template.md")
CAMPAIGNS = ("certify_campaign", "certify_curves")

EDGES = {
    "certified edges": "edges",
    "of these that graze": "grazing",
    "nearer than 2 mm": "within_2mm",
    "their median, um": "median_gap_of_those_um",
    "least gap, um": "least_gap_um",
    "configurations": "configurations",
    "within rounding": "within_rounding",
    "refuted": "refuted",
}
CURVES = {
    "paths": "solved",
    "straight pieces": "straight",
    "corners": "corners",
    "corners again, an obstacle pushed": "pushed",
    "nearer than 2 mm": "within_2mm",
    "their median, um": "median_gap_of_those_um",
    "least gap, um": "least_gap_um",
    "configurations": "scanned",
    "within rounding": "noise",
    "refuted": "refuted",
}


def load_campaigns(folder: Path) -> dict[str, Any]:
    """What both campaigns found."""
    paths = {name: folder / f"{name}.json" for name in CAMPAIGNS}
    for name, path in paths.items():
        if not path.exists():
            raise InputError(f"no results {str(path)!r}; run python -m experiments.{name}")
    return {name: json.loads(path.read_text(encoding="utf-8")) for name, path in paths.items()}


def page(campaigns: dict[str, Any]) -> str:
    """docs/certificate.md."""
    edges, curves = (campaigns[name] for name in CAMPAIGNS)
    of_edges, of_curves = (found["arms"]["all"] for found in (edges, curves))
    return TEMPLATE.read_text(encoding="utf-8").format(
        edges_verdict=_verdict(of_edges["edges"], of_edges["refuted"], "edges"),
        curves_verdict=_verdict(of_curves["pieces"], of_curves["refuted"], "pieces of curves"),
        edges=_table(edges["arms"], EDGES),
        curves=_table(curves["arms"], CURVES),
        step=edges["settings"]["step"],
        edges_command=_command("certify_campaign", edges["settings"], "num_edges"),
        curves_command=_command("certify_curves", curves["settings"], "num_problems"),
        edge_ms=of_edges["cpu_ms_an_edge"],
        piece_ms=of_curves["cpu_ms_a_piece"],
        processor=edges["machine"]["processor"],
        version=edges["machine"]["gnnjax"],
        **{f"earlier_{name}": number for name, number in BY_REACH_ALONE.items()},
    )


def _verdict(number: int, refuted: int, things: str) -> str:
    if refuted:
        return f"**{refuted} of {number:,} {things} are refuted.**"
    # The chance of finding none is 5 % if that many are wrong: exp(-3).
    return (
        f"**0 of {number:,} {things} are refuted**: with 95 % confidence no more than "
        f"{3e6 / number:.0f} in a million of those that are drawn like these are wrong."
    )


def _table(arms: dict[str, dict], columns: dict[str, str]) -> str:
    lines = [
        [f"**{name}**" if name == "all" else name, *(_cell(found[key]) for key in columns.values())]
        for name, found in arms.items()
    ]
    return markdown(["arm", *columns], lines)


def _cell(value: float | None) -> str:
    if value is None:
        return "-"
    return (
        f"{value:,}" if isinstance(value, int) else f"{value:.3g}" if value < 1 else f"{value:.0f}"
    )


def _command(name: str, settings: dict[str, Any], key: str) -> str:
    return f"python -m experiments.{name} --{key.replace('_', '-')} {settings[key]}"
