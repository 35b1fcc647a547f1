"""The motion network: is the straight line between two configurations free of collisions?

It never sees joint angles, so it serves any arm. Of a configuration it reads how far a dozen points
of the arm are from the obstacles, and how close the arm comes to itself; of a motion, what it reads
at both ends and how far each point travels between them. Longer motions are cut into pieces, which
all have to be free, so that probabilities multiply and their logarithms, the prices, add up along
an edge, a path, or any other line.

Along a roadmap, prices become messages: one min-plus pass after the other (`labels.cost_to_go`)
tells every node what the way to the goal is likely to cost.
"""

import functools
import inspect
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float

from gnnjax.arm.robot import Robot
from gnnjax.guide.guide import Guide, Prices
from gnnjax.guide.view import ArmView, arm_view
from gnnjax.scene.scene import Scene

SPACING = 0.5  # rad (or m); pieces of a motion are no longer than this where they are looked at


_SCALES = (0.05, 0.2)  # m; distances are read at two scales
_JOINT_SCALE = 0.3  # m a rad; how far the arm's distance to itself changes

View = Callable[[jax.Array], ArmView]  # of configurations `[B D]`, in one scene


class MotionNetwork(nnx.Module):
    """Logits that motions are free, the same in both directions by construction.

    Args:
        num_points: points of the arm that are looked at, P.
        channels: width of both hidden layers.
        rngs: source of the initial weights.
    """

    def __init__(self, num_points: int = 12, channels: int = 48, *, rngs: nnx.Rngs):
        self.num_points, self.channels = num_points, channels
        features = 7 * (num_points + 1) + 1
        self.first = nnx.Linear(features, channels, rngs=rngs)
        self.second = nnx.Linear(channels, channels, rngs=rngs)
        self.out = nnx.Linear(channels, 1, rngs=rngs)

    @property
    def config(self) -> dict[str, Any]:
        """The constructor's arguments: `MotionNetwork(**config, rngs=...)` has equal shapes."""
        names = list(inspect.signature(MotionNetwork.__init__).parameters)[1:-1]
        return {name: getattr(self, name) for name in names}

    def __call__(
        self, start: ArmView, end: ArmView, length: Float[Array, "*batch"]
    ) -> Float[Array, "*batch"]:
        """Logits of motions, each taken as one piece.

        Args:
            start: the arm at one end.
            end: the arm at the other.
            length: of the motion, configuration units.
        """
        hidden = jax.nn.relu(self.first(_features(start, end, length)))
        return self.out(jax.nn.relu(self.second(hidden)))[..., 0]


def _features(
    start: ArmView, end: ArmView, length: Float[Array, "*batch"]
) -> Float[Array, "*batch F"]:
    def scaled(distance: jax.Array) -> jax.Array:
        return jnp.concatenate([jnp.tanh(distance / scale) for scale in _SCALES], axis=-1)

    squared = jnp.sum(jnp.square(start.points - end.points), axis=-1)
    length = length[..., None]
    travel = jnp.concatenate([jnp.sqrt(squared + 1e-12), _JOINT_SCALE * length], axis=-1)
    # A distance changes no faster than its point travels: what is left of it at the worst moment.
    least = (start.clearance + end.clearance - travel) / 2
    near, far = scaled(start.clearance), scaled(end.clearance)
    return jnp.concatenate(
        [near + far, jnp.abs(near - far), scaled(least), travel, length], axis=-1
    )


def make_prices(
    network: MotionNetwork, view: View, spacing: float | Float[Array, ""] = SPACING
) -> Prices:
    """The prices of configurations and motions in one scene, `-log p(free)`.

    Args:
        network: the motion network.
        view: of the arm in the scene, from `workspace.arm_view`.
        spacing: largest length of a piece, configuration units.
    """

    def nodes(q: Float[Array, "B D"]) -> Float[Array, " B"]:
        seen = view(q)
        return jax.nn.softplus(-network(seen, seen, jnp.zeros(len(q))))

    def motions(
        starts: Float[Array, "E D"], ends: Float[Array, "E D"], most: int
    ) -> Float[Array, " E"]:
        length = jnp.linalg.norm(ends - starts, axis=-1)
        pieces = jnp.clip(jnp.ceil(length / spacing), 1, most)
        fraction = jnp.minimum(jnp.arange(most + 1) / pieces[:, None], 1.0)
        along = starts[:, None] + fraction[..., None] * (ends - starts)[:, None]
        seen = view(along.reshape(-1, along.shape[-1]))
        seen = jax.tree.map(lambda x: x.reshape(*along.shape[:2], *x.shape[1:]), seen)
        first, last = (jax.tree.map(lambda x, i=i: x[:, i : i + most], seen) for i in (0, 1))
        each = jnp.broadcast_to((length / pieces)[:, None], (len(starts), most))
        price = jax.nn.softplus(-network(first, last, each))
        return jnp.sum(price, axis=1, where=jnp.arange(most) < pieces[:, None])

    return Prices(nodes, motions)


def motion_guide(robot: Robot, network: MotionNetwork) -> Guide:
    """The motion network as a guide for an arm."""
    graphdef, weights = nnx.split(network)
    view = arm_view(robot, network.num_points)

    def prices(weights: Any, scene: Scene) -> Prices:
        return make_prices(nnx.merge(graphdef, weights), functools.partial(view, scene))

    return Guide(weights, lambda weights, scene: scene, prices)
