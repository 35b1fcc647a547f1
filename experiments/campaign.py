"""What campaigns against the certificate share: blocks of motions, what is found of each, and sums.

Blocks are kept as they come, in a folder of this very code and the settings that they depend on, so
that what an older certificate went through never counts for this one. The same command goes on
where it was cut off, and one with more blocks, or of more arms, from there.
"""

import json
import zlib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from experiments.judge import NEAR, Scan
from experiments.turns import folder_of, kept
from gnnjax.files import atomic_write
from gnnjax.measure.machine import describe_machine
from gnnjax.scene.shapes import Shape

SHIPPED = ("kuka_iiwa14", "kinova_gen3", "franka_panda")
# m; smaller overlaps are counted, and refute nothing: what single precision rounds off of a scene,
# and of a half-space, whose box has its middle 50 m away.
_NOISE, _NOISE_OF_HALF_SPACES = 1e-6, 1e-5


class Block(NamedTuple):
    """Motions of an arm that are looked at between two writes."""

    arm: str
    file: str  # name, of what is found
    measure: Callable[[], dict]


def folder_of_campaign(runs: Path, name: str, step: float, seed: int) -> Path:
    """Where blocks are kept: those of other code, or of other draws, lie elsewhere."""
    return folder_of(runs, name, {"step": step, "seed": seed})


def seed_of(seed: int, arm: str, number: int) -> tuple[int, int, int]:
    """The seed of an arm's block, which is the same whatever other arms there are."""
    return seed, zlib.crc32(arm.encode()), number


def run_blocks(
    folder: Path,
    blocks: Iterable[Block],
    summarize: Callable[[list[dict]], dict],
    path: Path,
    settings: dict[str, Any],
    doing: str,
) -> dict:
    """Measures the blocks that are missing, writes the summary, shows it and returns it.

    Args:
        folder: of what is found.
        blocks: of all arms, in the order in which they are measured.
        summarize: makes one row of an arm's blocks.
        path: of the summary.
        settings: of the campaign, to be told.
        doing: what the progress bar says.
    """
    found: dict[str, list[dict]] = {}
    for block in track(list(blocks), description=doing):
        own = found.setdefault(block.arm, [])
        own.append(kept(folder / block.file, block.measure))
        if own[-1]["refuted"]:
            print(f"refuted: see {folder / block.file}")
    found["all"] = [each for own in found.values() for each in own]
    summary = {name: summarize(own) for name, own in found.items()}
    told = {"machine": describe_machine(), "settings": settings, "arms": summary}
    text = json.dumps(told, indent=1) + "\n"
    atomic_write(path, lambda file: file.write_text(text, encoding="utf-8"))
    _show(summary)
    return summary


def _show(summary: dict[str, dict]) -> None:
    table = Table("arm", *(name.replace("_", " ") for name in summary["all"]))
    for name, part in summary.items():
        texts = [
            "-" if x is None else f"{x:.0f}" if isinstance(x, float) else str(x)
            for x in part.values()
        ]
        table.add_row(name, *texts)
    Console().print(table)


def told(shapes: list[Shape]) -> list[dict]:
    """Obstacles as JSON has them."""
    return [
        {"kind": shape.kind, **{k: np.asarray(v).tolist() for k, v in shape.values.items()}}
        for shape in shapes
    ]


def enter(found: dict, seen: Scan, kind: str, motion: dict) -> None:
    """Adds what was seen along a motion to what was found: how near what should graze comes, and
    the motion itself if it is refuted."""
    gap = seen.gap
    found["scanned"] += seen.num_configurations
    found["least"] = min(found["least"], gap)
    if kind != "plain" and gap < NEAR:
        found["gaps"].append(round(gap, 9))
    if gap >= 0:
        return
    noise = _NOISE_OF_HALF_SPACES if "half_space" in str(seen.between) else _NOISE
    if -gap <= noise:
        found["noise"] += 1
        return
    found["refuted"].append({"kind": kind, "gap": gap, "between": seen.between, **motion})


def how_near(blocks: list[dict]) -> dict[str, Any]:
    """How close those of some blocks come that graze."""
    near = np.concatenate([block["gaps"] for block in blocks])
    return {
        "within_2mm": len(near),
        "median_gap_of_those_um": float(1e6 * np.median(near)) if len(near) else None,
        "least_gap_um": float(1e6 * min(block["least"] for block in blocks)),
    }
