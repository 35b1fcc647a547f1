"""Which edges are likely free, and the way to the goal that follows from it.

The head reads, beside the codes of an edge's ends, how far a dozen points of the arm are from the
obstacles at five places along the edge. Its probabilities price the edges, and one pass of
Bellman-Ford over the prices tells every node how dear the way to the goal through each of its
neighbors is likely to be.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Array, Float, Int

from gnnjax.roadmap.graph import Roadmap, reverse_slots
from gnnjax.roadmap.paths import cost_to_go

# rad a nat: what an edge costs more for each nat by which it is unlikely to be free.
RISK_WEIGHT = 1.0

_FRACTIONS = (0.25, 0.5, 0.75)  # where an edge is looked at, besides its ends
_RANGE = 0.15  # m; distances beyond about twice this tell nothing more
_FARTHEST = 50.0  # rad; stands for "no way to the goal"

_ROWS_A_BLOCK = 1024

PointDistances = Callable[[jax.Array], jax.Array]  # `[B D] -> [B P]`, m


class ValidityHead(nnx.Module):
    """Logits that edges are free of collisions, the same in both directions by construction.

    Args:
        features: length of a node's code.
        channels: width, even.
        num_points: points of the arm whose distances are read, P; 0 for codes alone.
        rngs: source of the initial weights.
    """

    def __init__(self, features: int, channels: int, num_points: int, *, rngs: nnx.Rngs):
        self.num_points = num_points
        self.node = nnx.Linear(features, channels, rngs=rngs)
        self.length = nnx.Linear(1, channels // 2, use_bias=False, rngs=rngs)
        if num_points:
            self.distance = nnx.Linear(5 * num_points, channels, rngs=rngs)
        width = 2 * channels if num_points else channels
        self.hidden = nnx.Linear(width, channels, rngs=rngs)
        self.out = nnx.Linear(channels, 1, rngs=rngs)

    def __call__(
        self,
        roadmap: Roadmap,
        codes: Float[Array, "N F"],
        point_distances: PointDistances | None,
        max_edges: int,
    ) -> Float[Array, "N K"]:
        """Logits for all slots; zero on padding.

        Args:
            roadmap: one roadmap.
            codes: of its nodes.
            point_distances: of the arm in this scene; None if `num_points` is 0.
            max_edges: room for directed edges; those beyond it count as even.
        """
        mask = roadmap.neighbor_mask
        num, num_slots = mask.shape
        once = mask & (jnp.arange(num)[:, None] < roadmap.neighbors)
        room = min(-(-max_edges // 2), mask.size)
        (slots,) = jnp.nonzero(once.ravel(), size=room, fill_value=mask.size)
        inside = jnp.minimum(slots, mask.size - 1)
        near, far = inside // num_slots, roadmap.neighbors.ravel()[inside]

        rows = self.node(codes)
        half = rows.shape[-1] // 2
        lengths = roadmap.lengths.ravel()[inside, None] / jnp.pi
        total = rows[near, :half] + rows[far, :half] + self.length(lengths)
        difference = jnp.abs(rows[near, half:] - rows[far, half:])
        first = [jax.nn.relu(total), difference]
        if self.num_points:
            assert point_distances is not None
            features = edge_distances(roadmap.nodes, near, far, once.sum(), point_distances)
            first.append(jax.nn.relu(self.distance(jnp.tanh(features / _RANGE))))
        hidden = jax.nn.relu(self.hidden(jnp.concatenate(first, axis=-1)))
        logits = self.out(hidden)[:, 0]
        back = reverse_slots(roadmap).ravel()[inside]
        back = jnp.where(slots < mask.size, back, mask.size)
        flat = jnp.zeros(mask.size).at[slots].set(logits, mode="drop")
        return flat.at[back].set(logits, mode="drop").reshape(mask.shape)


def edge_distances(
    nodes: Float[Array, "N D"],
    near: Int[Array, " E"],
    far: Int[Array, " E"],
    count: int | Int[Array, ""],
    point_distances: PointDistances,
) -> Float[Array, "E F"]:
    """Distances [m] of the arm's P points along edges, F = 5 P, whichever end comes first.

    For each point the nearer and the farther of both ends, the middle, and the nearer and the
    farther of both quarters.

    Args:
        nodes: configurations.
        near: one end of each edge.
        far: the other.
        count: edges to look at; what is said of those after them means nothing.
        point_distances: of the arm in one scene.
    """
    num, num_edges = len(nodes), len(near)
    start, stop = nodes[near], nodes[far]
    along = jnp.stack([start + t * (stop - start) for t in _FRACTIONS], axis=1)
    rows = jnp.concatenate([nodes, along.reshape(-1, nodes.shape[1])])
    # Nodes and places along edges in one loop: each call of the kinematics takes a second or two
    # to compile. Block by block: a block stays in the processor's cache, and padding costs nothing.
    size = min(_ROWS_A_BLOCK, len(rows))
    rows = jnp.pad(rows, ((0, -len(rows) % size), (0, 0)))

    def look(i: jax.Array, distances: jax.Array) -> jax.Array:
        block = point_distances(jax.lax.dynamic_slice_in_dim(rows, i * size, size))
        return jax.lax.dynamic_update_slice_in_dim(distances, block, i * size, axis=0)

    shape = jax.eval_shape(point_distances, rows)
    blocks = (num + len(_FRACTIONS) * count + size - 1) // size
    distances = jax.lax.fori_loop(0, blocks, look, jnp.zeros(shape.shape, shape.dtype))
    at_node = distances[:num]
    along = distances[num : num + len(_FRACTIONS) * num_edges].reshape(num_edges, 3, -1)
    pairs = [(at_node[near], at_node[far]), (along[:, 0], along[:, 2])]
    ordered = [order(*pair) for pair in pairs for order in (jnp.minimum, jnp.maximum)]
    return jnp.concatenate([*ordered, along[:, 1]], axis=-1)


def edge_price(logits: Float[Array, "N K"]) -> Float[Array, "N K"]:
    """What edges cost beside their length for being unlikely to be free, rad."""
    return RISK_WEIGHT * jax.nn.softplus(-logits)


def cost_through(roadmap: Roadmap, logits: Float[Array, "N K"]) -> Float[Array, "N K"]:
    """What the way to the goal through each neighbor is likely to cost, rad.

    Lengths plus `RISK_WEIGHT` nats; finite everywhere. No gradient flows through it.
    """
    logits = jax.lax.stop_gradient(logits)
    price = roadmap.lengths + edge_price(logits)
    cost = jnp.minimum(cost_to_go(roadmap, price), _FARTHEST)
    return price + cost[roadmap.neighbors]
