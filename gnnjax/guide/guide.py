"""The contract of a guide: what prices motions that nobody has checked.

A guide tells which motions are likely free, at no collision check. Searches take the way that is
cheapest by length and price, and check only that. Any function of this form will do, see
`examples/own_guide.py`.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax

# rad a nat: what an edge costs more for each nat by which it is unlikely to be free.
RISK_WEIGHT = 1.0


class Prices(NamedTuple):
    """What a guide says of one scene, in nats: 0 for surely free, large for surely not.

    Never negative, and the same for a motion and its reverse. Prices of the pieces of a motion add
    up, like logarithms of probabilities.
    """

    nodes: Callable[[jax.Array], jax.Array]  # `[B D] -> [B]`
    # `(starts [E D], ends [E D], most pieces) -> [E]`; longer motions get longer pieces.
    motions: Callable[[jax.Array, jax.Array, int], jax.Array]


class Guide(NamedTuple):
    """A guide for one arm. Weights are arguments, so that others need no compilation.

    What is called inside of jit is written for one scene, but for `stored`.
    """

    weights: Any  # arrays
    # `(weights, Scene) -> reading`: what is computed once a scene, a distance field for example.
    read: Callable[[Any, Any], Any]
    prices: Callable[[Any, Any], Prices]  # `(weights, reading) -> Prices`
    # Of guides that can look at all edges of a stored roadmap at once: `Roadmap -> table`, on the
    # host, once an arm; and `(weights, readings [P], table) -> [P N K]`, nats.
    tabulate: Callable[[Any], Any] | None = None
    stored: Callable[[Any, Any, Any], jax.Array] | None = None
