"""The collision benchmark runs, its backends agree, and it counts what the compiler emits."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tyro

from experiments.benchmark_collision import BenchmarkConfig, main
from experiments.operations import operations
from gnnjax.errors import InputError


def test_backends_agree_and_results_are_written(tiny_path, tmp_path, monkeypatch, capsys):
    cores = []
    monkeypatch.setattr("os.sched_setaffinity", lambda _, some: cores.append(len(some)))

    def run(command, **_):
        """The second process here in the first, which stays on all cores."""
        assert command[1:3] == ["-m", main.__module__]
        main(tyro.cli(BenchmarkConfig, args=command[3:]))

    monkeypatch.setattr("subprocess.run", run)
    path = tmp_path / "out.json"
    config = BenchmarkConfig(
        robot=str(tiny_path),
        batch=256,
        boxes=3,
        repeats=1,
        mjx_batch=64,
        engine_batch=128,
        json=path,
    )
    main(config)
    results = json.loads(path.read_text())
    assert results.keys() == {"all_cores", "one_core"}
    assert cores == [1]
    for result in results.values():
        assert "mjx rotated" in result["agreement"]["rotated"]["verdicts"]
        assert result["matrix_product_gflops"] > 0
        for kind in ("aligned", "rotated"):
            assert np.isfinite(result[f"fused_over_engine_{kind}"])
            found = result["agreement"][kind]
            assert 0 < found["valid"] < 1  # both outcomes must be there to agree on
            assert {f"fused {kind}", f"engine {kind}"} <= found["verdicts"].keys()
            for verdicts in found["verdicts"].values():
                assert 0 < verdicts["agree"] == verdicts["of"]
            row = result["rates"][f"fused {kind}"]
            assert 0 < row["min"] <= row["median"] <= row["max"]
            assert row["batch"] == 256
            assert row["operations"]["sine"] == row["operations"]["cosine"] == 3
            assert row["gflops"] > 0
            assert 0 < row["share_of_matrix_product"]
    assert "fused rotated clearance" in capsys.readouterr().out


def test_operations_are_counted_once_a_turn():
    boxes = jnp.arange(10.0)[:, None]

    def loop(x):
        def turn(i, x):
            part = jax.lax.dynamic_slice(boxes, (i * 2, 0), (2, 1))
            return jnp.sin(x) * part[0, 0] + part[1, 0]

        return jnp.sqrt(jax.lax.fori_loop(0, (x[0] > 0).astype(int) * 5, turn, x))

    program = jax.jit(loop).lower(jnp.ones(64)).compile().as_text()
    counts = operations(program, 64, boxes=9)
    assert counts == {"sine": 5, "multiply": 5, "add": 5, "sqrt": 1}


def test_sizes_that_cannot_be_are_refused(tiny_path):
    for wrong in ({"boxes": 0}, {"batch": 10, "mjx_batch": 20, "engine_batch": 5}):
        with pytest.raises(InputError, match="must"):
            main(BenchmarkConfig(robot=str(tiny_path), **wrong))
