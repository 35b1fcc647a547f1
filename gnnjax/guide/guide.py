"""The contract of a guide: prices of motions that nobody has checked."""

from collections.abc import Callable
from typing import NamedTuple

import jax

# rad a nat: what an edge costs more for each nat by which it is unlikely to be free.
RISK_WEIGHT = 1.0


class Prices(NamedTuple):
    """What the network says of one scene, in nats: 0 for surely free, large for surely not."""

    nodes: Callable[[jax.Array], jax.Array]  # `[B D] -> [B]`
    # `(starts [E D], ends [E D], most pieces) -> [E]`; longer motions get longer pieces.
    motions: Callable[[jax.Array, jax.Array, int], jax.Array]
