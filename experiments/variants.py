"""The networks of the ablation: what each lacks, and its training."""

import dataclasses
from pathlib import Path
from typing import Any, get_args

import jax
from flax import nnx

from experiments.measure import ExperimentConfig
from gnnjax.generate import GenerateConfig, generate
from gnnjax.paper.network import Part
from gnnjax.train import PRESETS, TrainConfig
from gnnjax.training.weights import load_network

_BATCH_SIZE = 10  # divides all numbers of training problems
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


def training_set(
    config: ExperimentConfig, robot: str, num_problems: int | None, num_nodes: int
) -> Path:
    """The folder of the training set, completed if it is not there; a quick look's is small."""
    path = config.data / f"{Path(robot).stem}_train{'_quick' if config.quick else ''}"
    small = {"num_problems": num_problems, "num_nodes": num_nodes, "shard_size": 10}
    return generate(GenerateConfig(robot=robot, out=path, **(small if config.quick else {})))


def training(
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


def num_weights(weights: Path) -> int:
    """How many numbers a network has."""
    return sum(x.size for x in jax.tree.leaves(nnx.state(load_network(weights), nnx.Param)))
