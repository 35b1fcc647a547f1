"""Motion networks of the experiments: trained where they are missing, and kept in `runs/`."""

import dataclasses
import shlex
from pathlib import Path

from gnnjax.train_motion import TrainMotionConfig, train_motion


def trained(config: TrainMotionConfig) -> Path:
    """The weights of a training, which runs, or goes on, if they are not there."""
    weights = config.out / "weights.safetensors"
    if weights.exists():
        return weights
    return train_motion(dataclasses.replace(config, resume=True))


def command(config: TrainMotionConfig) -> str:
    """The command line of a training."""
    words = ["python", "-m", "gnnjax.train_motion"]
    for field in dataclasses.fields(TrainMotionConfig):
        value = getattr(config, field.name)
        if value != field.default and field.name != "resume":
            words += [f"--{field.name.replace('_', '-')}"]
            words += map(str, value if isinstance(value, tuple) else [value])
    return shlex.join(words)
