"""What a motion network learns from: scenes drawn without end, and motions tested in them."""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Array, Bool, Float

from gnnjax.arm.robot import Robot
from gnnjax.collision.checker import make_checker
from gnnjax.collision.fused import obstacles_clear
from gnnjax.devices import map_first
from gnnjax.problems.families import BOX_FAMILIES
from gnnjax.problems.family_problem import draw_family_scene
from gnnjax.problems.problem import sample_scene
from gnnjax.scene.scene import OBSTACLE_BUCKETS, Scene, pad_scene
from gnnjax.training.parallel import on_each_device

_MAX_BOXES = OBSTACLE_BUCKETS[2]  # what the largest family has
_PAPER_SHARE = 0.5  # of the scenes; the families share the rest


class Motions(NamedTuple):
    """Motions in one scene, and whether they are free."""

    starts: Float[Array, "*batch M D"]  # configurations, rad or m
    ends: Float[Array, "*batch M D"]
    valid: Bool[Array, "*batch M"]  # at both ends and in between


def scene_sampler(robot: Robot) -> Callable[[jax.Array], Scene]:
    """Makes `key -> Scene`: the paper's, or of a family drawn at random, half of each."""
    zero = np.clip(np.zeros(robot.num_dof, np.float32), robot.joint_lower, robot.joint_upper)
    clear = functools.partial(obstacles_clear, robot, q=jnp.asarray(zero))

    def paper(key: jax.Array) -> Scene:
        return pad_scene(sample_scene(key, clear), _MAX_BOXES)

    def family(name: str, key: jax.Array) -> Scene:
        scene = draw_family_scene(key, name, robot).scene
        # Boxes in the arm's base would block every motion.
        scene = scene._replace(mask=scene.mask & clear(scene, base_only=True))
        return pad_scene(scene, _MAX_BOXES)

    kinds = [paper, *(functools.partial(family, name) for name in BOX_FAMILIES)]
    shares = [_PAPER_SHARE] + [(1 - _PAPER_SHARE) / len(BOX_FAMILIES)] * len(BOX_FAMILIES)

    def sample(key: jax.Array) -> Scene:
        kind_key, scene_key = jax.random.split(key)
        kind = jax.random.choice(kind_key, len(kinds), p=jnp.array(shares))
        return jax.lax.switch(kind, kinds, scene_key)

    return sample


def make_scene_batches(robot: Robot, mesh: Mesh | None = None) -> Callable[[jax.Array, int], Scene]:
    """Makes `(keys [S], how many on each device) -> Scenes [S]`, which takes seconds to compile."""
    sample = scene_sampler(robot)

    def of_motions(key: jax.Array) -> Scene:
        return sample(_split(key)[0])

    @jax.jit
    def batch(keys: jax.Array, num: jax.Array) -> Scene:
        return on_each_device(lambda keys: map_first(of_motions, num, keys), mesh)(keys)

    return batch


def _split(key: jax.Array) -> jax.Array:
    """Keys of a scene, and of the motions in it."""
    return jax.random.split(key, 5)


def motion_sampler(
    robot: Robot, num: int, lengths: tuple[tuple[float, float, float], ...], free_share: float
) -> Callable[[jax.Array, Scene], Motions]:
    """Makes `(key, Scene) -> Motions [M]`, where the scene is of that key, too.

    Args:
        robot: the arm.
        num: motions, M.
        lengths: least and largest length, configuration units, and share of each kind.
        free_share: share of the motions that begin at a free configuration where there are enough.
    """
    checker = make_checker(robot)
    lower, upper = jnp.asarray(robot.joint_lower), jnp.asarray(robot.joint_upper)
    least, largest, share = (jnp.array(x) for x in zip(*lengths, strict=True))
    chosen_free = int(free_share * num)

    def draw(key: jax.Array, scene: Scene) -> Motions:
        keys = _split(key)
        q = jax.random.uniform(keys[1], (2 * num, robot.num_dof), minval=lower, maxval=upper)
        free_first = jnp.argsort(~checker.check_configurations(scene, q))
        starts = jnp.concatenate([q[free_first[:chosen_free]], q[: num - chosen_free]])
        kind = jax.random.choice(keys[2], len(lengths), (num,), p=share)
        length = jax.random.uniform(keys[3], (num,), minval=least[kind], maxval=largest[kind])
        direction = jax.random.normal(keys[4], starts.shape)
        direction /= jnp.linalg.norm(direction, axis=-1, keepdims=True)
        ends = jnp.clip(starts + length[:, None] * direction, lower, upper)
        at_ends = checker.check_configurations(scene, jnp.concatenate([starts, ends]))
        valid = checker.check_edges(scene, starts, ends).valid
        return Motions(starts, ends, valid & at_ends[:num] & at_ends[num:])

    return draw
