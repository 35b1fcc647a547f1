"""Families of what is all around the arm: blocks and plates, and pipes."""

import jax
import jax.numpy as jnp

from gnnjax.problems.structures import (
    FAR,
    FamilyScene,
    Region,
    about,
    joined,
    round_ones,
    uniform,
    unit,
)
from gnnjax.scene.scene import box_scene


def draw_clutter(key: jax.Array) -> FamilyScene:
    """10 to 20 blocks, thin pillars and plates, turned anyhow, all around the arm."""
    number_key, kind_key, size_key, place_key, far_key, turn_key = jax.random.split(key, 6)
    num = 20
    kind = jax.random.randint(kind_key, (num,), 0, 3)  # block, pillar, plate
    low = jnp.array([[0.03, 0.03, 0.03], [0.01, 0.01, 0.15], [0.01, 0.08, 0.08]])
    high = jnp.array([[0.10, 0.10, 0.10], [0.03, 0.03, 0.45], [0.015, 0.22, 0.22]])
    half_extents = jax.random.uniform(size_key, (num, 3), minval=low[kind], maxval=high[kind])
    direction = unit(jax.random.normal(place_key, (num, 3)))
    distance = jax.random.uniform(far_key, (num, 1), minval=0.35, maxval=0.85)
    quats = unit(jax.random.normal(turn_key, (num, 4)))
    exists = jnp.arange(num) < jax.random.randint(number_key, (), 10, num + 1)
    anywhere = Region(jnp.zeros(3), jnp.full(3, FAR), about(2, jnp.zeros(())))
    scene = box_scene(distance * direction, half_extents, quats, exists)
    return FamilyScene(joined(scene), anywhere, anywhere)


def draw_pipes(key: jax.Array) -> FamilyScene:
    """8 to 14 pipes, half of them with round ends, that cross the workspace beside the arm."""
    keys = jax.random.split(key, 6)
    number_key, kind_key, size_key, place_key, far_key, axis_key = keys
    num = 14
    direction = unit(jax.random.normal(place_key, (num, 3)))
    # Across the way from the arm, so that none leads into its base.
    axis = jax.random.normal(axis_key, (num, 3))
    axis = unit(axis - jnp.sum(axis * direction, axis=1, keepdims=True) * direction)
    distance = jax.random.uniform(far_key, (num, 1), minval=0.35, maxval=0.9)
    radius, half = uniform(size_key, [0.015, 0.5], [0.06, 1.2], num).T
    is_capsule = jax.random.bernoulli(kind_key, 0.5, (num,))
    exists = jnp.arange(num) < jax.random.randint(number_key, (), 8, num + 1)
    # The shortest rotation of z to the axis; opposite to z, that is never drawn, it has none.
    quats = unit(jnp.stack([1 + axis[:, 2], -axis[:, 1], axis[:, 0], 0 * radius], axis=1))
    anywhere = Region(jnp.zeros(3), jnp.full(3, FAR), about(2, jnp.zeros(())))
    scene = round_ones(distance * direction, radius, half, quats, is_capsule, exists)
    return FamilyScene(joined(scene), anywhere, anywhere)
