"""Claim: every part of the network saves edge checks.

    python -m experiments.ablation

Networks that lack one part are trained on the same roadmaps, for as many steps and from the same
seed, and plan the Kuka's 300 test problems on the same roadmaps: one each, no second try. Parts are
taken out of the default network and of the paper's architecture, which learns here as the default
one does (from all nodes, soft labels, AdamW); the preset `paper` also learns as the paper's. It
takes a step a roadmap and so sees as many roadmaps, in more steps. With fewer training problems
there are more epochs, not fewer steps.

The budget is small, an eighth of the default's epochs on a third of its roadmaps: what is compared
are networks early in their training, one training each. Intervals are over problems and do not hold
how much a network changes from one seed of its training to the next.
"""

import dataclasses
import itertools
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import jax
import numpy as np
import tyro
from flax import nnx
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator

from experiments.cases import own_case
from experiments.measure import (
    ExperimentConfig,
    measure,
    problem_set,
    run_seed,
    save_results,
    statistics,
)
from gnnjax.errors import run_command
from gnnjax.evaluate import EvaluateConfig
from gnnjax.files import atomic_write
from gnnjax.generate import GenerateConfig, generate
from gnnjax.paper.network import Part
from gnnjax.train import PRESETS, TrainConfig, train
from gnnjax.training.weights import load_network, read_metadata

CLAIM = "Every part of the network saves edge checks."

_BATCH_SIZE = 10  # divides all numbers of training problems
_WITHOUT_NETWORK = {"distance to the goal": "distance", "exact cost-to-go": "oracle"}
_PAPER_NETWORK = {"geometric_features": False, "workspace_points": 0, "validity_weight": 0.0}


@dataclasses.dataclass(frozen=True)
class AblationConfig(ExperimentConfig):
    """Networks that lack a part, trained alike."""

    num_roadmaps: int = 1000
    """Training problems of all variants but those that have fewer."""
    fewer_roadmaps: tuple[int, ...] = (100, 300)
    """Training problems of these."""
    epochs: int = 3
    """Passes over all training problems."""
    num_nodes: int = 200
    """Nodes of the roadmaps."""
    num_problems: int = 300
    """Test problems."""
    trained: Path = Path("runs/ablation")
    """Where the networks go."""


def variants(config: AblationConfig) -> dict[str, dict[str, Any]]:
    """What differs from the default training, by the name of the variant."""
    found: dict[str, dict[str, Any]] = {}
    for network, base in {"default": {}, "paper's network": _PAPER_NETWORK}.items():
        found[network] = base
        for part in get_args(Part):
            found[f"{network} without {part}"] = base | {"without": (part,)}
        if network == "default":
            found["default without workspace points"] = {"workspace_points": 0}
            for num in config.fewer_roadmaps:
                found[f"default, {num} problems"] = {"num_roadmaps": num}
    found["paper's network and training"] = {"preset": "paper", "batch_size": 1}
    return found


def full_network(variant: str) -> str:
    """The variant that one is compared with."""
    return "paper's network" if variant.startswith("paper's") else "default"


def run(config: AblationConfig) -> None:
    """Trains and measures what is missing, and draws the figure."""
    if config.quick:
        config = dataclasses.replace(
            config,
            num_roadmaps=10,
            epochs=2,
            num_nodes=30,
            num_problems=3,
            seeds=config.seeds[:1],
        )
    rows = save_results(config, "ablation", CLAIM, _rows(config))
    draw(rows, config.out / "ablation.png")


def _rows(config: AblationConfig) -> Iterator[dict[str, Any]]:
    robot = config.robot or "kuka_iiwa14"
    path = problem_set(config, robot, num_problems=config.num_problems)
    cases: dict[str, EvaluateConfig] = {}

    def case(planner: str, **changes: Any) -> EvaluateConfig:
        made = own_case(path, robot, planner, config.num_nodes, config.num_problems)
        return dataclasses.replace(made, max_roadmaps=1, **changes)

    chosen, others = variants(config), dict(_WITHOUT_NETWORK)
    if config.quick:  # compiling all of them takes minutes
        chosen = dict(itertools.islice(chosen.items(), 2))
        del others["exact cost-to-go"]
    data = _training_data(config, robot)
    for name, changes in chosen.items():
        training = _training(config, name, data, robot, changes)
        weights = _trained(training)
        cases[name] = case("gnn", weights=weights)
        yield {
            "variant": name,
            "training": _command(training),
            "last_epoch": read_metadata(weights)["training"]["log"][-1],
            "num_weights": _num_weights(weights),
            **measure(cases[name], config.seeds, config.runs),
            "difference": _difference(config, cases[name], cases[full_network(name)]),
        }
    for name, planner in others.items():
        yield {
            "variant": f"no network, {name}",
            **measure(case(planner), config.seeds, config.runs),
            "difference": _difference(config, case(planner), cases["default"]),
        }


def _training_data(config: AblationConfig, robot: str) -> Path:
    """The folder of the training set, completed if it is not there."""
    path = config.data / f"{Path(robot).stem}_train{'_quick' if config.quick else ''}"
    small = {"num_problems": config.num_roadmaps, "num_nodes": config.num_nodes, "shard_size": 10}
    return generate(GenerateConfig(robot=robot, out=path, **(small if config.quick else {})))


def _training(
    config: AblationConfig, name: str, data: Path, robot: str, changes: dict[str, Any]
) -> TrainConfig:
    """The training of a variant."""
    num = changes.get("num_roadmaps", config.num_roadmaps)
    epochs = config.epochs * config.num_roadmaps // num
    folder = name.replace(" ", "-").replace("'", "").replace(",", "")
    common: dict[str, Any] = {
        "data": data,
        "num_roadmaps": num,
        "robot": robot,
        "out": config.trained / f"{Path(robot).stem}_{folder}_{num}x{epochs}",
        "epochs": epochs,
        "batch_size": _BATCH_SIZE,
        "validate_every": epochs,
        "validation_problems": 0,
    }
    if config.quick:
        common["channels"] = 8
    return dataclasses.replace(PRESETS[changes.get("preset", "default")], **(common | changes))


def _trained(config: TrainConfig) -> Path:
    """The weights of a training, which runs if it has not."""
    weights = config.out / "weights.safetensors"
    return weights if weights.exists() else train(config)


def _num_weights(weights: Path) -> int:
    return sum(x.size for x in jax.tree.leaves(nnx.state(load_network(weights), nnx.Param)))


def _command(config: TrainConfig) -> str:
    """The command line of a training."""
    words = ["python", "-m", "gnnjax.train", "--preset", config.preset]
    for field in dataclasses.fields(TrainConfig):
        value, option = getattr(config, field.name), field.name.replace("_", "-")
        if value == getattr(PRESETS[config.preset], field.name):
            continue
        if isinstance(value, bool):
            words.append(f"--{option}" if value else f"--no-{option}")
        else:
            words += [f"--{option}", *map(str, value if isinstance(value, tuple) else [value])]
    return shlex.join(words)


def _difference(config: AblationConfig, ours: EvaluateConfig, full: EvaluateConfig) -> Any:
    """How much more a planner needs than the full network, on the same problems and roadmaps."""
    made = [[run_seed(c, seed, config.runs) for seed in config.seeds] for c in (ours, full)]
    problems = [[seed["problems"] for seed in runs] for runs in made]
    valid = np.array([[row["valid"] for row in seed] for seed in problems[0]])
    found = {}
    for name in ("edge_checks", "success"):
        # Invalid problems have no numbers.
        ours_, full_ = (
            np.array([[float(row[name] or 0) for row in seed] for seed in runs])
            for runs in problems
        )
        found[name] = statistics(ours_ - full_, valid)
    return found


PANELS = (
    ("edge_checks", "edge checks", 1.0, True),
    ("success", "solved on the first roadmap [%]", 100.0, False),
    ("cost", "path cost [rad]", 1.0, True),
)


def draw(rows: list[dict[str, Any]], out: Path) -> None:
    """Draws means with 95 % intervals, a line a variant."""
    figure = Figure(figsize=(12, 1.6 + 0.28 * len(rows)), layout="constrained")
    axes = figure.subplots(1, len(PANELS), sharey=True)
    at = -np.arange(len(rows))
    for panel, (name, title, scale, logarithmic) in zip(axes, PANELS, strict=True):
        for stratum, color in {"all": "tab:blue", "hard": "tab:red"}.items():
            parts = [row["summary"][stratum][name] for row in rows]
            there = [i for i, part in enumerate(parts) if part is not None]
            mean, low, high = (
                np.array([scale * parts[i][key] for i in there]) for key in ("mean", "low", "high")
            )
            spread = np.maximum([mean - low, high - mean], 0.0)
            panel.errorbar(
                mean, at[there], xerr=spread, fmt=".", color=color, capsize=2, label=stratum
            )
        panel.set(title=title)
        panel.grid(axis="x", alpha=0.3)
        if logarithmic:
            panel.set_xscale("log")
            panel.xaxis.set_major_formatter("{x:g}")
            panel.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            panel.xaxis.set_minor_locator(NullLocator())
    axes[0].set_yticks(at, [_line_name(row) for row in rows])
    axes[0].legend()
    figure.suptitle(
        "Means with 95 % intervals; *: edge checks differ from those of the full network"
    )
    atomic_write(out, lambda file: figure.savefig(file, dpi=110))


def _line_name(row: dict[str, Any]) -> str:
    """The variant, with a star where its edge checks differ from the full network's."""
    difference = row["difference"]["edge_checks"]
    differs = difference is not None and not difference["low"] <= 0.0 <= difference["high"]
    return row["variant"] + " *" * differs


if __name__ == "__main__":
    run_command(lambda: run(tyro.cli(AblationConfig)))
