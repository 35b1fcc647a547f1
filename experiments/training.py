"""Motion networks of the experiments: trained where they are missing, and kept in `runs/`."""

import dataclasses
from pathlib import Path

from experiments.commands import command_line
from gnnjax.train_motion import TrainMotionConfig, train_motion


def trained(config: TrainMotionConfig) -> Path:
    """The weights of a training, which runs, or goes on, if they are not there."""
    weights = config.out / "weights.safetensors"
    if weights.exists():
        return weights
    return train_motion(dataclasses.replace(config, resume=True))


def command(config: TrainMotionConfig) -> str:
    """The command line of a training."""
    return command_line("train_motion", config, skip=["resume"])
