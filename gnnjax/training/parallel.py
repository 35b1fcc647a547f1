"""Data parallel steps: each device, of all processes, takes its rows of a batch; all take one step.

What a batch holds does not depend on the devices, so that a run is the same, to rounding, on any
number of them.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

from gnnjax.cluster import ConnectedOptions
from gnnjax.errors import InputError

_ROWS = "rows"  # the axis of the mesh


def all_devices(options: ConnectedOptions, rows: int, what: str) -> Mesh | None:
    """All devices of all processes; None where the run is not distributed.

    Args:
        options: of the command.
        rows: of a batch, which they share out.
        what: the option that says how many.

    Raises:
        InputError: some would have more rows than others.
    """
    if not options.distributed:
        return None
    devices = jax.devices()
    if rows % len(devices):
        raise InputError(
            f"{what} is {rows} and there are {len(devices)} devices; choose a multiple of them"
        )
    return Mesh(np.array(devices), (_ROWS,))


def everywhere(tree: Any, mesh: Mesh | None) -> Any:
    """Arrays, as a whole on each device; as they are without a mesh."""
    return tree if mesh is None else jax.tree.map(lambda x: _put(x, mesh, P()), tree)


def dealt(tree: Any, mesh: Mesh | None) -> Any:
    """Arrays `[B, ...]` that all processes have, each device's rows on it; without a mesh, as they
    are."""
    return tree if mesh is None else jax.tree.map(lambda x: _put(x, mesh, P(_ROWS)), tree)


def here(tree: Any, mesh: Mesh | None) -> Any:
    """What is everywhere, as arrays of this process alone."""
    return tree if mesh is None else jax.tree.map(lambda x: x.addressable_data(0), tree)


def _put(x: Any, mesh: Mesh, spec: P) -> jax.Array:
    if jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
        return jax.random.wrap_key_data(_put(jax.random.key_data(x), mesh, spec))
    value = np.asarray(x)
    sharding = NamedSharding(mesh, spec)
    return jax.make_array_from_callback(value.shape, sharding, lambda at: value[at])


def mean_over_devices(
    function: Callable[[Any, Any], Any], mesh: Mesh | None
) -> Callable[[Any, Any], Any]:
    """`(weights, rows) -> means over the rows`: those of each device's rows, averaged."""
    if mesh is None:
        return function

    def mean(weights: Any, rows: Any) -> Any:
        return jax.lax.pmean(function(weights, rows), _ROWS)

    return jax.shard_map(mean, mesh=mesh, in_specs=(P(), P(_ROWS)), out_specs=P(), check_vma=False)


def on_each_device(function: Callable[[Any], Any], mesh: Mesh | None) -> Callable[[Any], Any]:
    """`rows -> rows`, each device its own."""
    if mesh is None:
        return function
    return jax.shard_map(
        function, mesh=mesh, in_specs=P(_ROWS), out_specs=P(_ROWS), check_vma=False
    )
