"""The planner of Diao, Chi and Wang: its network, and what it needs."""

from gnnjax.paper.encoding import EdgeOutputs, Encoding, PathState
from gnnjax.paper.graphs import graphs_tuple
from gnnjax.paper.network import GuidanceNetwork
from gnnjax.paper.occupancy import occupancy_grid
from gnnjax.paper.strategy import gnn, gnn_lazy, network_scorer

__all__ = [
    "EdgeOutputs",
    "Encoding",
    "GuidanceNetwork",
    "PathState",
    "gnn",
    "gnn_lazy",
    "graphs_tuple",
    "network_scorer",
    "occupancy_grid",
]
