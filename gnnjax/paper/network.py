"""The guidance network: which neighbor of a node should the path go to next?

One class, in the order of the paper's equations, and so longer than other modules.

Symbols, as in the paper: `h_i = [x_i, x_goal]` the data of a node, `x` its code after
`ReLU(GCN(ReLU(GAT(h))))`, `y` the code of the obstacles, `o` the environment code of a node, `P`
the codes of the path walked so far. C is `channels`, the paper's d.

Everything that does not depend on the path is computed once a query by `encode`, projections
included, so a step of the search costs one GRU cell (`extend_path`), one row of attention and K
rows of the decoder (`guidance_values`). All methods take one problem; under `vmap`, split the
model first:

    graphdef, params = nnx.split(model)
    encodings = jax.vmap(lambda r, s: nnx.merge(graphdef, params).encode(r, s))(roadmaps, scenes)
"""

import functools
import inspect
from collections.abc import Callable, Sequence
from typing import Any, Literal, get_args

import jax
import jax.numpy as jnp
import jraph
from flax import nnx
from jaxtyping import Array, Float, Int

from gnnjax.errors import InputError
from gnnjax.paper.encoding import (
    EdgeOutputs,
    Encoding,
    PathState,
    attend_to_path,
    edge_geometry,
    empty_path,
    remember,
)
from gnnjax.paper.graphs import graphs_tuple
from gnnjax.paper.occupancy import HalvingConv, occupancy_grid
from gnnjax.paper.validity import ValidityHead, cost_through
from gnnjax.roadmap.graph import GOAL, Roadmap
from gnnjax.scene.scene import Scene

Part = Literal["gat", "gcn", "grid", "path", "attention"]  # what a network can do without
Graph = Any  # jraph.GraphsTuple, whose fields are typed too widely for a type checker to be of use


class GuidanceNetwork(nnx.Module):
    """The paper's network, and the extensions that make it the better default.

    With both flags off this is the paper's network. Where the paper leaves a choice open: the
    environment code is the mean over a node's edges, the GRU reads the node codes `x`, and the far
    end `x_j` of an edge enters the decoder as attended with an empty path, which is computed once
    a query instead of K times a step.

    Args:
        num_dof: joints the network is made for. Robots with fewer count as having fixed extra
            joints at zero, as the paper treats its 6-joint arm.
        channels: size C of every code, a multiple of 4.
        grid_size: voxels along each axis of the occupancy grid.
        max_path: nodes of the path that attention can look back on; the GRU state has no limit.
        workspace_lower: corner of the occupancy grid [m], in the frame of the robot's base.
        workspace_upper: opposite corner [m].
        geometric_features: gives encoder and decoder the node data next to its code (two rounds of
            averaging over neighbors blur it), and the decoder the length of an edge, the distance
            of its ends to the goal, and the progress made per length. The untrained network then
            ranks neighbors by their distance to the goal.
        validity_head: adds the logit that an edge is collision-free.
        workspace_points: points of the arm whose distances to the obstacles the validity head
            reads; it needs that head. Guidance values then start as minus the likely cost of the
            way through a neighbor (see `validity.py`), and the network learns what to add. 0: none.
        without: parts to leave out, each for the plainest thing that keeps the shapes. "gat" and
            "gcn" become linear layers on the node alone; "grid" an obstacle code of zeros; without
            "path" a node attends to nothing but itself, and without "attention" not even to itself:
            what is attended is its environment code.
        rngs: source of the initial weights.
    """

    def __init__(
        self,
        num_dof: int = 7,
        channels: int = 32,
        grid_size: int = 16,
        max_path: int = 64,
        workspace_lower: Sequence[float] = (-1.2, -1.2, -0.4),
        workspace_upper: Sequence[float] = (1.2, 1.2, 1.6),
        geometric_features: bool = True,
        validity_head: bool = True,
        workspace_points: int = 0,
        without: Sequence[str] = (),
        *,
        rngs: nnx.Rngs,
    ):
        self.num_dof = num_dof
        self.channels = channels
        self.grid_size = grid_size
        self.max_path = max_path
        self.workspace_lower = tuple(workspace_lower)
        self.workspace_upper = tuple(workspace_upper)
        self.geometric_features = geometric_features
        self.validity_head = validity_head
        self.workspace_points = workspace_points
        if workspace_points and not (validity_head and geometric_features):
            raise InputError(
                f"workspace_points is {workspace_points} and needs validity_head and "
                "geometric_features; give 0 to go without"
            )
        if unknown := sorted(set(without) - set(get_args(Part))):
            raise InputError(f"no parts {unknown} to do without; there are {list(get_args(Part))}")
        self.without = tuple(part for part in get_args(Part) if part in without)
        self.reads_path = not {"path", "attention"} & set(without)

        c, features = channels, 2 * num_dof
        pair_features = c + features if geometric_features else c

        def linear(inputs: int, outputs: int = c, bias: bool = False) -> nnx.Linear:
            return nnx.Linear(inputs, outputs, use_bias=bias, rngs=rngs)

        # Node embedding. `a` of the GAT acts on [W h_i || W h_j].
        self.gat_weight = linear(features)
        if "gat" not in without:
            self.gat_attention = linear(2 * c, 1)
        self.gcn_weight = linear(c, bias=True)

        # Obstacles: m^3 occupancy to C.
        if "grid" not in without:
            sizes = (1, c // 4), (c // 4, c // 2), (c // 2, c)
            self.convs = nnx.List([HalvingConv(i, o, rngs=rngs) for i, o in sizes])
            self.grid_linear = linear(c * (-(-grid_size // 8)) ** 3, bias=True)

        # Pair MLPs. The first layer of an MLP on [a, b, c] is a sum of three linear maps, which
        # need to be computed once a node, not once an edge.
        self.pair_near = linear(pair_features, bias=True)
        self.pair_far = linear(pair_features)
        self.pair_obstacles = linear(c)
        self.pair_norm = nnx.LayerNorm(c, rngs=rngs)
        self.pair_out = linear(c, bias=True)

        # Path, and Attention*.
        if self.reads_path:
            self.gru = nnx.GRUCell(c, c, rngs=rngs)
            self.query_environment = linear(c)
            self.key_environment = linear(c)
        if "attention" not in without:
            self.value_environment = linear(c)
        if self.reads_path:
            self.query_path = linear(c)
            self.value_path = linear(c)
        self.attention_norm = nnx.LayerNorm(c, rngs=rngs)

        # Decoder h_x, and the MLP to the guidance value.
        self.decoder_node = linear(c, bias=True)
        self.decoder_difference = linear(c)
        self.decoder_environment = linear(c)
        self.decoder_out = linear(c, bias=True)
        self.value_hidden = linear(c, bias=True)
        self.value_out = linear(c, 1, bias=True)
        if geometric_features:
            self.decoder_near_data = linear(features)
            self.decoder_far_data = linear(features)
            shares = [0.0, 0.0, -jnp.pi, 0.0]
            # The untrained network goes by the distance of the far end to the goal in rad, which is
            # a fair guess, or by the likely cost of the way, as sharply as labels are soft.
            if workspace_points:
                shares = [0.0, 0.0, 0.0, 0.0, -4.0 * jnp.pi]
            self.decoder_geometry = linear(len(shares))
            self.value_geometry = linear(len(shares), 1)
            self.value_out.kernel[...] = jnp.zeros((c, 1))
            self.value_geometry.kernel[...] = jnp.array(shares)[:, None]
        if validity_head:
            self.validity = ValidityHead(pair_features + c, c, workspace_points, rngs=rngs)

    @property
    def config(self) -> dict[str, Any]:
        """The constructor's arguments: `GuidanceNetwork(**config, rngs=...)` has equal shapes."""
        names = list(inspect.signature(GuidanceNetwork.__init__).parameters)[1:-1]
        return {name: getattr(self, name) for name in names}  # all but self and rngs

    # ---------------------------------------------------------------- once a query

    def encode(
        self,
        roadmap: Roadmap,
        scene: Scene,
        max_edges: int | None = None,
        point_distances: Callable[[Scene, jax.Array], jax.Array] | None = None,
    ) -> Encoding:
        """Codes of all nodes, and every projection of them that a search step needs.

        Args:
            roadmap: nodes and edges, without a batch axis.
            scene: the obstacles.
            max_edges: room for directed edges; edges beyond it are ignored. All slots if None,
                which is always enough but slow, as most slots are padding.
            point_distances: from `guide/view.py`; needed if the network has `workspace_points`.
        """
        if self.workspace_points and point_distances is None:
            raise InputError(
                f"the network reads distances of {self.workspace_points} points of the arm; give "
                "point_distances"
            )
        max_edges = max_edges or roadmap.neighbors.size
        data = self.node_data(roadmap)
        graph: Graph = graphs_tuple(roadmap, max_edges)
        code = self.embed_nodes(graph, data)
        features = jnp.concatenate([code, data], axis=-1) if self.geometric_features else code
        environment = self.encode_environment(graph, features, self.encode_obstacles(scene))
        key = value = jnp.zeros_like(environment)
        self_score = jnp.zeros(len(environment))
        if "attention" not in self.without:
            value = self.value_environment(environment)
        if self.reads_path:
            key = self.key_environment(environment)
            self_score = jnp.sum(self.query_environment(environment) * key, axis=-1)
        # Of an empty path, attention is all on the node itself.
        path_free = self.attention_norm(value + environment)
        decoder_near = self.decoder_environment(environment)
        decoder_far = -self.decoder_difference(path_free)
        if self.geometric_features:
            decoder_near += self.decoder_near_data(data)
            decoder_far += self.decoder_far_data(data)
        validity = through = jnp.zeros(roadmap.neighbors.shape)
        if self.validity_head:
            ends = jnp.concatenate([features, environment], axis=-1)
            near = functools.partial(point_distances, scene) if point_distances else None
            validity = self.validity(roadmap, ends, near, max_edges)
        if self.workspace_points:
            through = cost_through(roadmap, validity) / jnp.pi
        return Encoding(
            code=code,
            environment=environment,
            key=key,
            value=value,
            self_score=self_score,
            decoder_near=decoder_near,
            decoder_far=decoder_far,
            validity=validity,
            through=through,
            goal_distance=jnp.linalg.norm(jnp.subtract(*jnp.split(data, 2, axis=-1)), axis=-1),
        )

    def node_data(self, roadmap: Roadmap) -> Float[Array, "N F"]:
        """`h_i = [x_i, x_goal]`, joints in units of pi and padded with zeros to `num_dof`."""
        num_dof = roadmap.nodes.shape[-1]
        if num_dof > self.num_dof:
            raise InputError(
                f"the network is made for up to {self.num_dof} joints, the robot has {num_dof}; "
                f"train one with num_dof={num_dof}"
            )
        nodes = jnp.pad(roadmap.nodes / jnp.pi, ((0, 0), (0, self.num_dof - num_dof)))
        return jnp.concatenate([nodes, jnp.broadcast_to(nodes[GOAL], nodes.shape)], axis=-1)

    def embed_nodes(self, graph: Graph, data: Float[Array, "N F"]) -> Float[Array, "N C"]:
        """`x = ReLU(GCN(ReLU(GAT(h))))`, with self edges in both layers."""
        num_nodes = data.shape[0]
        own = jnp.arange(num_nodes + 1)  # jraph's GAT expects self edges; the last is the dummy's
        graph = graph._replace(
            nodes=_add_dummy(data),
            senders=jnp.concatenate([graph.senders, own]),
            receivers=jnp.concatenate([graph.receivers, own]),
            edges=None,
        )
        gat: Any = jraph.GAT
        gcn: Any = jraph.GraphConvolution
        if "gat" in self.without:
            graph = graph._replace(nodes=jax.nn.relu(self.gat_weight(graph.nodes)))
        else:
            graph = gat(self.gat_weight, self._gat_logit, node_update_fn=jax.nn.relu)(graph)
        if "gcn" in self.without:
            graph = graph._replace(nodes=self.gcn_weight(graph.nodes))
        else:
            graph = gcn(self.gcn_weight, symmetric_normalization=True)(graph)
        return jax.nn.relu(graph.nodes[:num_nodes])

    def _gat_logit(
        self, sent: Float[Array, "E C"], received: Float[Array, "E C"], edges: None
    ) -> Float[Array, "E 1"]:
        del edges
        return jax.nn.leaky_relu(self.gat_attention(jnp.concatenate([received, sent], axis=-1)))

    def encode_obstacles(self, scene: Scene) -> Float[Array, " C"]:
        """`y`: occupancy grid, 3D CNN, linear layer."""
        if "grid" in self.without:
            return jnp.zeros(self.channels)
        grid = occupancy_grid(scene, self.workspace_lower, self.workspace_upper, self.grid_size)
        grid = grid[..., None]
        for conv in self.convs:
            grid = jax.nn.relu(conv(grid))
        return self.grid_linear(grid.reshape(-1))

    def encode_environment(
        self,
        graph: Graph,
        features: Float[Array, "N F"],
        obstacles: Float[Array, " C"],
    ) -> Float[Array, "N C"]:
        """`o_i`: mean over the edges of node i of a two-layer MLP on `(x_i, x_j, y)`.

        The second layer is linear, so it is applied after the mean, once a node.
        """
        near = _add_dummy(self.pair_near(features))
        far = _add_dummy(self.pair_far(features))
        pairs = near[graph.receivers] + far[graph.senders] + self.pair_obstacles(obstacles)
        hidden = jax.nn.relu(self.pair_norm(pairs))
        mean = jraph.segment_mean(hidden, graph.receivers, near.shape[0])
        return self.pair_out(mean[:-1])

    # ---------------------------------------------------------------- once a step

    def init_path(self) -> PathState:
        """The empty path."""
        return empty_path(self.max_path, self.channels)

    def extend_path(
        self, encoding: Encoding, state: PathState, node: Int[Array, ""] | int
    ) -> PathState:
        """Appends a node to the path. Past `max_path` nodes, the oldest leaves the memory."""
        if not self.reads_path:
            return state._replace(length=state.length + 1)
        hidden, _ = self.gru(state.hidden, encoding.code[node])
        return remember(state, hidden, self.query_path(hidden), self.value_path(hidden))

    def attend(
        self, encoding: Encoding, state: PathState, node: Int[Array, ""] | int
    ) -> Float[Array, " C"]:
        """Attention*: softmax of `[Q_e,i K_e,i | Q_p K_e,i]` weighs `[V_e,i | V_p]`."""
        attention = encoding.value[node]
        if self.reads_path:
            key, self_score = encoding.key[node], encoding.self_score[node]
            attention = attend_to_path(state, key, self_score, attention)
        return self.attention_norm(attention + encoding.environment[node])

    def guidance_values(
        self,
        encoding: Encoding,
        state: PathState,
        roadmap: Roadmap,
        node: Int[Array, ""] | int,
    ) -> Float[Array, " K"]:
        """Guidance values of a node's slots, larger is better; padded slots are not masked."""
        neighbors = roadmap.neighbors[node]
        near = self._decoder_near(self.attend(encoding, state, node)) + encoding.decoder_near[node]
        geometry = edge_geometry(
            roadmap.lengths[node],
            encoding.goal_distance[node],
            encoding.goal_distance[neighbors],
            encoding.through[node],
        )
        return self._decode(near + encoding.decoder_far[neighbors], geometry)

    def _decoder_near(self, attended: Float[Array, "*rows C"]) -> Float[Array, "*rows C"]:
        """The attended code of node i in the first layer of `h_x(x_i, x_i - x_j, o_i)`."""
        return self.decoder_node(attended) + self.decoder_difference(attended)

    def _decode(
        self, first: Float[Array, "rows C"], geometry: Float[Array, "rows G"]
    ) -> Float[Array, " rows"]:
        """The rest of `h_x`, then the MLP to the guidance value."""
        if self.geometric_features:
            geometry = geometry[:, : self.decoder_geometry.in_features]
            first = first + self.decoder_geometry(geometry)
        decoded = jax.nn.relu(self.decoder_out(jax.nn.relu(first)))
        values = self.value_out(jax.nn.relu(self.value_hidden(decoded)))
        if self.geometric_features:
            values = values + self.value_geometry(geometry)
        return values[:, 0]

    # ---------------------------------------------------------------- all edges at once

    def edge_outputs(
        self, encoding: Encoding, roadmap: Roadmap, max_edges: int | None = None
    ) -> EdgeOutputs:
        """Guidance values and validity logits of all edges.

        The values of node i are those of a search that starts there: its path is i alone.

        Args:
            encoding: of this roadmap.
            roadmap: nodes and edges, without a batch axis.
            max_edges: as in `encode`; outputs of edges beyond it are zero.
        """
        mask = roadmap.neighbor_mask
        max_edges = max_edges or mask.size
        graph: Graph = graphs_tuple(roadmap, max_edges)
        lengths = graph.edges[:, 0]

        attention = encoding.value
        if self.reads_path:
            hidden, _ = self.gru(jnp.zeros_like(encoding.code), encoding.code)
            path_score = jnp.sum(self.query_path(hidden) * encoding.key, axis=-1)
            scores = jnp.stack([encoding.self_score, path_score], axis=-1)
            weights = jax.nn.softmax(scores / jnp.sqrt(self.channels))
            attention = weights[:, :1] * attention + weights[:, 1:] * self.value_path(hidden)
        attended = self.attention_norm(attention + encoding.environment)

        # One wide gather an end, as each costs a scatter in the gradient.
        near_nodes = self._decoder_near(attended) + encoding.decoder_near
        shared = encoding.goal_distance[:, None]
        near = _add_dummy(jnp.concatenate([near_nodes, shared], axis=-1))[graph.receivers]
        far = _add_dummy(jnp.concatenate([encoding.decoder_far, shared], axis=-1))[graph.senders]
        # Row e of the compact list is the e-th slot that holds an edge; its padding is dropped.
        slots = jnp.nonzero(mask.ravel(), size=max_edges, fill_value=mask.size)[0]
        through = encoding.through.ravel()[jnp.minimum(slots, mask.size - 1)]
        geometry = edge_geometry(lengths, near[:, -1], far[:, -1], through)
        values = self._decode(near[:, :-1] + far[:, :-1], geometry)
        values = jnp.zeros(mask.size).at[slots].set(values, mode="drop").reshape(mask.shape)
        return EdgeOutputs(values, encoding.validity)


def _add_dummy(rows: Float[Array, "N F"]) -> Float[Array, "M F"]:
    """Adds the node that the padding edges of `graphs_tuple` run from and to."""
    return jnp.pad(rows, ((0, 1), (0, 0)))
