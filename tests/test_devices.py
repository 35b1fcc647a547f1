"""How rows are mapped, and spread over cores and devices."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gnnjax import devices
from gnnjax.devices import map_first
from gnnjax.errors import InputError


def test_the_first_rows_are_mapped_with_one_trace_and_the_others_are_zero():
    traces = []

    @jax.jit
    def mapped(scale, rows, num):
        def function(row):
            traces.append(row)
            a, b = row
            return a @ a * scale, jnp.where(b, a, -a)

        return map_first(function, num, rows)

    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(5, 3)).astype(np.float32), rng.random(5) < 0.5
    for num in (0, 3, 5):
        squares, signed = mapped(2.0, (a, b), num)
        wanted = np.arange(5) < num
        np.testing.assert_allclose(squares, wanted * 2 * (a * a).sum(1), rtol=1e-5)
        np.testing.assert_array_equal(
            signed, np.where(wanted[:, None], np.where(b[:, None], a, -a), 0)
        )
    assert len(traces) == 1


@pytest.mark.parametrize("cores", [1, 2, 3, 7, 16])
def test_rows_come_back_in_order_whatever_the_cores(monkeypatch, cores):
    monkeypatch.setattr(devices, "num_cores", lambda: cores)
    args = {"x": np.random.default_rng(0).random((7, 3), np.float32), "n": np.arange(7)}
    traces = []

    @jax.jit
    def roots(num, args):
        traces.append(num)
        return devices.map_first(lambda row: (jnp.sqrt(row["x"]), row["n"] + 1), num, args)

    for num in (7, 3):  # compiled once for both
        some = {name: x[:num] for name, x in args.items()}
        root, following = devices.on_all_cores(roots, some)
        np.testing.assert_array_equal(root, np.sqrt(some["x"]))
        np.testing.assert_array_equal(following, np.arange(1, num + 1))
    assert len(traces) == 1


def test_what_goes_wrong_in_a_part_is_heard_of(monkeypatch):
    monkeypatch.setattr(devices, "num_cores", lambda: 2)

    def fails(num, args):
        if num and args[0] >= 2:
            raise MemoryError("no room")
        return args

    with pytest.raises(MemoryError, match="no room"):
        devices.on_all_cores(fails, np.arange(4))


def test_searches_run_on_the_host_where_there_is_an_accelerator(monkeypatch):
    host = jax.local_devices(backend="cpu")[0]

    @devices.on_host()
    def where():
        shares = devices.shares_of(1000)
        return devices.platform(), jax.config.jax_default_device, {share.device for share in shares}

    assert where() == ("cpu", None, {None})
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert devices.platform() == "gpu"
    # Threads begin anew, so that each share names the device.
    assert where() == ("cpu", host, {host})
    assert jax.config.jax_default_device is None

    def missing(backend=None):
        raise RuntimeError("Unknown backend cpu")

    monkeypatch.setattr(jax, "local_devices", missing)
    with pytest.raises(InputError, match="searches need the CPU, too; leave it out, or add ',cpu'"):
        where()
