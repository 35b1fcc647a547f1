"""How the guidance network ranks the neighbors of a node."""

from gnnjax.paper.encoding import Encoding
from gnnjax.paper.network import GuidanceNetwork
from gnnjax.roadmap.graph import Roadmap
from gnnjax.search.greedy import Scorer


def network_scorer(network: GuidanceNetwork, encoding: Encoding, roadmap: Roadmap) -> Scorer:
    """Prefers what the guidance network does, which remembers the path walked so far."""
    return Scorer(
        init=network.init_path,
        advance=lambda carry, node: network.extend_path(encoding, carry, node),
        values=lambda carry, node: network.guidance_values(encoding, carry, roadmap, node),
    )
