"""Trains the guidance network: `python -m gnnjax.train --data data/kuka_iiwa14_train`.

The preset `paper` learns as Diao, Chi and Wang do: walk k ~ U{1..10} steps with the network, then
learn the next node of the shortest path from the node reached. The default preset learns from every
step of the walk and from every node of the roadmap, and with a second head which edges are valid.

Options, data and loop of the command are together here, to be read from top to bottom; a step is in
`paper/step.py`.
"""

import argparse
import dataclasses
import functools
from pathlib import Path
from typing import Literal

import jax
import numpy as np
import optax
from flax import nnx
from jax.sharding import Mesh

from gnnjax.arguments import parse_arguments
from gnnjax.arm_options import ArmOptions, load_bare_arm
from gnnjax.cluster import UNCONNECTED, ConnectedCluster
from gnnjax.devices import cache_compilations
from gnnjax.errors import InputError, run_command
from gnnjax.paper.network import GuidanceNetwork, Part
from gnnjax.paper.step import LOSS_OPTIONS, make_step, validate
from gnnjax.paper.strategy import gnn
from gnnjax.planning.options import PlannerOptions
from gnnjax.planning.planner import SampledPlanner
from gnnjax.problems.labelled import (
    from_problem_set,
    generate_labelled,
    problem_keys,
)
from gnnjax.problems.shards import load_problems
from gnnjax.training.optimizer import warmed_adamw
from gnnjax.training.parallel import all_devices, dealt
from gnnjax.training.run import AGAIN, Training, TrainState, check_bounds, run_training


@dataclasses.dataclass(frozen=True)
class TrainConfig(ArmOptions):
    """Train a guidance network on a set of labelled roadmaps."""

    preset: str = "default"
    """Where all other options start from: default, paper or smoke."""
    data: Path = Path("data/kuka_iiwa14_train")
    """Folder or .npz made by `python -m gnnjax.generate`."""
    num_roadmaps: int | None = None
    """Learn from only the first so many roadmaps."""
    robot: str = "kuka_iiwa14"
    """The arm of the problems."""
    out: Path = Path("runs/kuka_iiwa14")
    """Checkpoints, logs and, at the end, the weights go here."""
    resume: bool = False
    """Go on from the last checkpoint in `out`; without one, start from the beginning."""
    seed: int = 0
    """Seed of the weights, the order of the data and the walks."""

    epochs: int = 24
    """Passes over the data."""
    batch_size: int = 16
    """Roadmaps per step."""
    optimizer: Literal["adamw", "sgd"] = "adamw"
    """AdamW warms up and decays by a cosine; SGD has a constant rate."""
    learning_rate: float = 3e-3
    """Peak rate."""
    weight_decay: float = 1e-3
    """Decay of all weights."""
    max_walk: int = 10
    """Longest walk; its length is uniform from 1 to this."""
    every_step: bool = True
    """Learn from every step of the walk, not only from its last."""
    all_nodes: bool = True
    """Learn from every node of the roadmap, too, as if the walk began there."""
    temperature: float = 0.15
    """Softness of the labels, in rad of detour; 0 names the best neighbor alone."""
    validity_weight: float = 0.3
    """Weight of learning which edges are valid; 0 for no such head."""
    geometric_features: bool = True
    """Let the network read configurations, edge lengths and distances to the goal directly, beside
    the codes that it computes."""
    workspace_points: int = 12
    """Points on the arm whose distances to the obstacles the network reads; 0 for none. Needs
    --geometric-features and a --validity-weight above 0."""
    num_dof: int = 7
    """Joints that the network is made for. An arm with fewer counts as having further joints fixed
    at zero."""
    channels: int = 32
    """Size of the codes that the network computes, a multiple of 4."""
    without: tuple[Part, ...] = ()
    """Parts of the network to leave out, for an ablation."""

    validate_every: int = 4
    """Epochs between validations, which plan, and checkpoints."""
    validation_problems: int = 100
    """Problems to plan, drawn apart from all others. They are of the paper's family, even if the
    data are of another; 0 to validate nothing."""
    figure: Path | None = None
    """Where a picture of the training curves goes, at each checkpoint (needs the viz extra)."""
    cluster: ConnectedCluster = UNCONNECTED


PRESETS = {
    "default": TrainConfig(),
    "paper": TrainConfig(
        preset="paper",
        out=Path("runs/kuka_iiwa14_paper"),
        batch_size=1,
        optimizer="sgd",
        learning_rate=1e-3,
        every_step=False,
        all_nodes=False,
        temperature=0.0,
        validity_weight=0.0,
        geometric_features=False,
        workspace_points=0,
    ),
    # A tiny network for a few steps, to see that everything runs.
    "smoke": TrainConfig(
        preset="smoke",
        out=Path("runs/smoke"),
        epochs=2,
        batch_size=4,
        channels=8,
        validate_every=1,
        validation_problems=4,
    ),
}


def make_optimizer(config: TrainConfig, num_steps: int) -> optax.GradientTransformation:
    """The optimizer of a run of `num_steps` steps."""
    if config.optimizer == "sgd":
        decay = optax.add_decayed_weights(config.weight_decay)
        return optax.chain(decay, optax.sgd(config.learning_rate))
    return warmed_adamw(config.learning_rate, num_steps, 200, config.weight_decay)


def train(config: TrainConfig) -> Path:
    """Trains and returns the file of the weights.

    The order of the data and the walks depend on seed and epoch alone, so that a run that was cut
    off and resumed comes to the same numbers, on any number of devices.
    """
    _check_config(config)
    with config.cluster.connected(config.out):
        return _train(config, all_devices(config.cluster, config.batch_size, "batch_size"))


def _train(config: TrainConfig, mesh: Mesh | None) -> Path:
    cache_compilations()
    robot = load_bare_arm(config.robot, config)
    if not config.data.exists():
        raise InputError(
            f"no training data at {str(config.data)!r}; make some with python -m gnnjax.generate "
            f"--split train --robot {config.robot} --out {config.data}"
            + (", and the same --joints, --hold and --allow" if robot.choice else "")
        )
    problems = load_problems(config.data, robot)
    if config.num_roadmaps is not None and not 1 <= config.num_roadmaps <= len(problems):
        raise InputError(
            f"num_roadmaps is {config.num_roadmaps}; choose 1 to {len(problems)}, the roadmaps in "
            f"{str(config.data)!r}"
        )
    data = from_problem_set(problems.take(slice(config.num_roadmaps)))
    num = len(data.problem.start)
    if not 1 <= config.batch_size <= num:
        raise InputError(f"batch_size is {config.batch_size}; choose 1 to {num}, the roadmaps")
    steps_an_epoch = num // config.batch_size
    num_steps = config.epochs * steps_an_epoch
    network = GuidanceNetwork(
        num_dof=config.num_dof,
        channels=config.channels,
        geometric_features=config.geometric_features,
        validity_head=config.validity_weight > 0,
        workspace_points=config.workspace_points,
        without=config.without,
        rngs=nnx.Rngs(config.seed),
    )
    num_nodes = int(data.roadmap.node_mask.sum(axis=1).max())
    options = PlannerOptions(planner="gnn", num_nodes=num_nodes, max_roadmaps=1)
    planner = SampledPlanner(robot, gnn(robot, network, options), options)
    validation = None
    if config.validation_problems:
        keys = problem_keys(config.seed, "validation", 0, config.validation_problems)
        validation = generate_labelled(robot, 0)(keys)
    graphdef, weights = nnx.split(network)
    optimizer = make_optimizer(config, num_steps)
    losses = {name: getattr(config, name) for name in LOSS_OPTIONS}
    step = make_step(graphdef, optimizer, robot, config.workspace_points, losses, mesh)
    state = TrainState(weights, optimizer.init(weights))

    def one_step(state: TrainState, epoch: int, number: int):
        order, walk_key = plan_epoch(epoch)
        rows = order[number * config.batch_size : (number + 1) * config.batch_size]
        batch = jax.tree.map(lambda x: x[rows], data)
        keys = jax.random.split(jax.random.fold_in(walk_key, number), len(rows))
        return step(state, *dealt((batch, keys), mesh))

    @functools.lru_cache(maxsize=1)
    def plan_epoch(epoch: int) -> tuple[np.ndarray, jax.Array]:
        key = jax.random.fold_in(jax.random.key(config.seed), epoch)
        order_key, walk_key = jax.random.split(key)
        return np.asarray(jax.random.permutation(order_key, num)), walk_key

    def validated(state: TrainState) -> tuple[dict[str, float], str]:
        if validation is None:
            return {}, ""
        planner.use_weights(state.weights)
        found = validate(planner, validation)
        words = (
            f", validation success {found['success']:.2f}, {found['edge_checks']:.1f} edge checks"
        )
        return {f"validation_{name}": value for name, value in found.items()}, words

    training = Training(
        network=network,
        state=state,
        unit="epoch",
        num_units=config.epochs,
        steps=steps_an_epoch,
        record_every=1,
        validate_every=config.validate_every,
        step=one_step,
        validate=validated,
        mesh=mesh,
    )
    return run_training(training, config)


def _check_config(config: TrainConfig) -> None:
    """Refuses numbers that nothing can be trained with, before anything is computed."""
    least = dict.fromkeys(("epochs", "validate_every", "max_walk", "num_dof"), 1)
    least |= {"channels": 4, "validation_problems": 0, "workspace_points": 0, "temperature": 0}
    least |= {"learning_rate": 0, "weight_decay": 0, "validity_weight": 0}
    check_bounds(config, least)
    if config.channels % 4:
        raise InputError(f"channels is {config.channels}; it must be a multiple of 4")
    if config.workspace_points and not (config.validity_weight and config.geometric_features):
        raise InputError(
            f"workspace_points is {config.workspace_points} and needs validity_weight > 0 and "
            "geometric_features; add --workspace-points 0 to go without"
        )


def parse() -> TrainConfig:
    """Reads the command line; `--preset` says what the other options start from."""
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--preset", nargs="?")
    preset = parser.parse_known_args()[0].preset or "default"
    if preset not in PRESETS:
        raise InputError(f"no preset {preset!r}; there are {list(PRESETS)}")
    return parse_arguments(TrainConfig, default=PRESETS[preset])


def main() -> None:
    """Trains what the command line asks for."""
    train(parse())


if __name__ == "__main__":
    run_command(main, AGAIN, "give a smaller --batch-size or fewer --channels")
