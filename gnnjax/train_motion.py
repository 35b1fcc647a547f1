"""Trains the motion network, the default planner's guide: `python -m gnnjax.train_motion`.

There is no data set. Every step draws scenes of all kinds, motions of the arms in them, and tests
these with the collision checker, all on the device; no scene is ever seen twice.

Options, batches, step and loop of the command are together here, to be read from top to bottom;
what is drawn is in `training/motions.py`.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import nnx
from jax.sharding import Mesh

from gnnjax.arguments import parse_arguments
from gnnjax.arm.robot import Robot
from gnnjax.arm_options import JointOptions, load_bare_arm
from gnnjax.cluster import UNCONNECTED, ConnectedCluster
from gnnjax.devices import cache_compilations, map_first
from gnnjax.errors import InputError, run_command
from gnnjax.guide.motion import MotionNetwork, make_prices
from gnnjax.guide.view import ArmView, arm_view
from gnnjax.scene.scene import Scene
from gnnjax.training.motions import make_scene_batches, motion_sampler
from gnnjax.training.optimizer import warmed_adamw
from gnnjax.training.parallel import all_devices, dealt, mean_over_devices, on_each_device
from gnnjax.training.run import AGAIN, Training, TrainState, check_bounds, run_training

_FREE_SHARE = 0.8  # of the motions: begin at a free configuration
# Lengths of motions, rad, and how many are of each kind: none at all, as for nodes; pieces as they
# are looked at; and longer pieces, as of very long motions.
_LENGTHS = ((0.0, 0.0, 0.1), (0.1, 0.7, 0.6), (0.6, 1.5, 0.3))
_EDGE_LENGTHS = (1.5, 4.0)  # rad, of the motions that validation looks at, like a roadmap's edges
_VALIDATION_STEPS = 8


@dataclasses.dataclass(frozen=True)
class TrainMotionConfig(JointOptions):
    """Train a motion network on scenes and motions drawn without end."""

    robots: tuple[str, ...] = ("kuka_iiwa14", "kinova_gen3")
    """Arms that take turns: shipped ones, or paths of MJCFs or URDFs."""
    out: Path = Path("runs/motion")
    """Checkpoints, logs and, at the end, the weights go here."""
    resume: bool = False
    """Go on from the last checkpoint in `out`; without one, start from the beginning."""
    seed: int = 0
    """Seed of weights and data."""
    steps: int = 3000
    """Steps; each learns from one batch."""
    scenes: int = 16
    """Scenes per batch."""
    motions: int = 512
    """Motions per scene."""
    learning_rate: float = 4e-3
    """Peak rate of AdamW, which warms up and decays by a cosine."""
    num_points: int = 12
    """Points on the arm whose distances to the obstacles the network reads."""
    channels: int = 48
    """Width of both hidden layers."""
    save_every: int = 100
    """Steps between checkpoints and log records, which validate."""
    figure: Path | None = None
    """Where a picture of the training curves goes, at each checkpoint (needs the viz extra)."""
    cluster: ConnectedCluster = UNCONNECTED


def make_batches(
    robot: Robot, config: TrainMotionConfig, draw_scenes: Callable, mesh: Mesh | None = None
) -> Callable[[jax.Array], tuple[ArmView, ArmView, jax.Array, jax.Array]]:
    """Makes the function `key -> (start, end, length, valid)`, all scenes' in one row.

    Args:
        robot: the arm.
        config: of the training.
        draw_scenes: from `make_scene_batches`, of the same mesh.
        mesh: of the devices.
    """
    draw = motion_sampler(robot, config.motions, _LENGTHS, _FREE_SHARE)
    view = arm_view(robot, config.num_points)

    def one(given: tuple[jax.Array, Scene]):
        key, scene = given
        motions = draw(key, scene)
        seen = view(scene, jnp.concatenate([motions.starts, motions.ends]))
        start, end = (
            jax.tree.map(lambda x, p=part: x[p], seen)
            for part in (slice(config.motions), slice(config.motions, None))
        )
        length = jnp.linalg.norm(motions.ends - motions.starts, axis=-1)
        return start, end, length, motions.valid

    @jax.jit
    def batch(keys: jax.Array, scenes: Scene, num: jax.Array):
        def some(given: tuple[jax.Array, Scene]):
            drawn = map_first(one, num, given)
            return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), drawn)

        return on_each_device(some, mesh)((keys, scenes))

    each = config.scenes // (1 if mesh is None else mesh.size)

    def of_key(key: jax.Array):
        keys = dealt(jax.random.split(key, config.scenes), mesh)
        return batch(keys, draw_scenes(keys, each), each)

    return of_key


def make_step(
    graphdef: Any, optimizer: optax.GradientTransformation, mesh: Mesh | None = None
) -> Callable:
    """The jitted step: two updates from one batch, a half each."""

    def loss(weights: Any, start: ArmView, end: ArmView, length: jax.Array, valid: jax.Array):
        logits = nnx.merge(graphdef, weights)(start, end, length)
        entropy = optax.sigmoid_binary_cross_entropy(logits, valid.astype(jnp.float32))
        return entropy.mean(), jnp.mean((logits > 0) == valid)

    gradient = jax.value_and_grad(loss, has_aux=True)

    def of_half(half: int, weights: Any, batch: tuple):
        # Every second motion: both halves have all scenes.
        return gradient(weights, *jax.tree.map(lambda x: x[half::2], batch))

    @jax.jit
    def step(state: TrainState, batch: tuple) -> tuple[TrainState, dict[str, jax.Array]]:
        found = []
        for half in range(2):
            mean = mean_over_devices(functools.partial(of_half, half), mesh)
            found_now, gradients = mean(state.weights, batch)
            updates, optimizer_state = optimizer.update(gradients, state.optimizer, state.weights)
            state = TrainState(optax.apply_updates(state.weights, updates), optimizer_state)
            found.append(jnp.stack(found_now))
        mean = jnp.stack(found).mean(axis=0)
        return state, {"loss": mean[0], "accuracy": mean[1]}

    return step


def area_under_curve(scores: np.ndarray, valid: np.ndarray) -> float:
    """Chance that a valid motion scores higher than one that is not (area under the ROC curve)."""
    order = np.argsort(scores, kind="stable")
    _, first, counts = np.unique(scores[order], return_index=True, return_counts=True)
    ranks = np.empty(len(scores))
    ranks[order] = np.repeat(first + (counts + 1) / 2, counts)  # ties share their mean rank
    num_valid = int(valid.sum())
    above = ranks[valid].sum() - num_valid * (num_valid + 1) / 2
    return float(above / max(1, num_valid * (len(valid) - num_valid)))


def make_validation(
    robot: Robot, config: TrainMotionConfig, draw_scenes: Callable, graphdef: Any
) -> Callable[[Any, jax.Array], tuple[np.ndarray, np.ndarray]]:
    """Makes `(weights, key) -> (scores, valid)` of motions as long as a roadmap's edges.

    Args:
        robot: the arm.
        config: of the training.
        draw_scenes: from `make_scene_batches`, without a mesh.
        graphdef: of the network.
    """
    num, most = 128, 8
    draw = motion_sampler(robot, num, ((*_EDGE_LENGTHS, 1.0),), 1.0)
    view = arm_view(robot, config.num_points)

    @jax.jit
    def validate(weights: Any, keys: jax.Array, scenes: Scene, num: jax.Array):
        def one(given: tuple[jax.Array, Scene]):
            key, scene = given
            motions = draw(key, scene)
            network = nnx.merge(graphdef, weights)
            prices = make_prices(network, functools.partial(view, scene))
            return -prices.motions(motions.starts, motions.ends, most), motions.valid

        return map_first(one, num, (keys, scenes))

    def on_host(weights: Any, key: jax.Array) -> tuple[np.ndarray, np.ndarray]:
        keys, num = jax.random.split(key, config.scenes), config.scenes
        scores, valid = validate(weights, keys, draw_scenes(keys, num), num)
        return np.asarray(scores).ravel(), np.asarray(valid).ravel()

    return on_host


def train_motion(config: TrainMotionConfig) -> Path:
    """Trains and returns the file of the weights.

    A batch depends on seed and step alone, so that a run that was cut off and resumed comes to the
    same numbers, on any number of devices.
    """
    _check_config(config)
    with config.cluster.connected(config.out):
        return _train_motion(config, all_devices(config.cluster, config.scenes, "scenes"))


def _train_motion(config: TrainMotionConfig, mesh: Mesh | None) -> Path:
    cache_compilations()
    robots = [load_bare_arm(name, config) for name in config.robots]
    network = MotionNetwork(config.num_points, config.channels, rngs=nnx.Rngs(config.seed))
    graphdef, weights = nnx.split(network)
    # Two updates a step; of the warm-up there are as many as a tenth of the steps.
    warmup = min(100, config.steps // 10 + 1)
    optimizer = warmed_adamw(config.learning_rate, 2 * config.steps, warmup)
    step = make_step(graphdef, optimizer, mesh)
    batches, validations = [], []
    for robot in robots:
        draw_scenes = make_scene_batches(robot)
        dealt_out = draw_scenes if mesh is None else make_scene_batches(robot, mesh)
        batches.append(make_batches(robot, config, dealt_out, mesh))
        validations.append(make_validation(robot, config, draw_scenes, graphdef))
    state = TrainState(weights, optimizer.init(weights))
    train_key, validation_key = jax.random.split(jax.random.key(config.seed))

    def one_step(state: TrainState, number: int, _: int):
        return step(state, batches[number % len(robots)](jax.random.fold_in(train_key, number)))

    def validated(state: TrainState) -> tuple[dict[str, float], str]:
        areas = {}
        for name, validate in zip(names_apart(config.robots), validations, strict=True):
            keys = jax.random.split(validation_key, _VALIDATION_STEPS)
            scores, valid = zip(*(validate(state.weights, key) for key in keys), strict=True)
            area = area_under_curve(np.concatenate(scores), np.concatenate(valid))
            areas[f"edge_auc_{name}"] = area
        words = ", ".join(f"{area:.4f}" for area in areas.values())
        return areas, f", area under the curve of edges {words}"

    training = Training(
        network=network,
        state=state,
        unit="step",
        num_units=config.steps,
        steps=1,
        record_every=config.save_every,
        validate_every=config.save_every,
        step=one_step,
        validate=validated,
        mesh=mesh,
    )
    return run_training(training, config)


def names_apart(robots: Sequence[str]) -> list[str]:
    """What the log calls some arms: by their files' names, or where those of two are the same as
    they were given."""
    stems = [Path(name).stem for name in robots]
    return stems if len(set(stems)) == len(set(robots)) else list(robots)


def _check_config(config: TrainMotionConfig) -> None:
    """Refuses numbers that nothing can be trained with, before anything is computed."""
    least = dict.fromkeys(("steps", "scenes", "num_points", "channels", "save_every"), 1)
    least |= {"motions": 2, "learning_rate": 0}
    check_bounds(config, least)
    if config.cluster.distributed and config.motions % 2:
        raise InputError(
            f"motions is {config.motions}; distributed, it must be even, or the halves of a batch "
            "would depend on the devices"
        )
    if not config.robots:
        raise InputError("robots is empty; name at least one arm")
    chosen = [
        field.name for field in dataclasses.fields(JointOptions) if getattr(config, field.name)
    ]
    if chosen and len(config.robots) > 1:
        raise InputError(
            f"{chosen[0]} is of one arm, and robots names {len(config.robots)}; name that alone"
        )


if __name__ == "__main__":
    run_command(
        lambda: train_motion(parse_arguments(TrainMotionConfig)) and None,
        AGAIN,
        "give fewer --scenes or --motions",
    )
