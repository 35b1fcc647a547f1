"""Networks of the experiments: trained where they are missing, and kept in `runs/`."""

import dataclasses
from pathlib import Path

from experiments.commands import command_line
from gnnjax.train import PRESETS, TrainConfig, train
from gnnjax.train_motion import TrainMotionConfig, train_motion


def trained(config: TrainConfig | TrainMotionConfig) -> Path:
    """The weights of a training, which runs, or goes on, if they are not there."""
    weights = config.out / "weights.safetensors"
    if weights.exists():
        return weights
    if isinstance(config, TrainMotionConfig):
        return train_motion(dataclasses.replace(config, resume=True))
    return train(dataclasses.replace(config, resume=True))


def command(config: TrainConfig | TrainMotionConfig) -> str:
    """The command line of a training."""
    if isinstance(config, TrainMotionConfig):
        return command_line("train_motion", config, skip=["resume"])
    preset = config.preset
    return command_line(f"train --preset {preset}", config, PRESETS[preset], skip=["resume"])
