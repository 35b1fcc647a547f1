"""The optimizer of trainings: its rate over a run."""

import jax.numpy as jnp
import pytest

from gnnjax.training.optimizer import warmed_adamw


def rates(optimizer, num):
    """What each update is of a weight whose gradient is always the same: AdamW's rate."""
    weight = jnp.zeros(())
    state, found = optimizer.init(weight), []
    for _ in range(num):
        update, state = optimizer.update(jnp.ones(()), state, weight)
        found.append(-float(update))
    return found


@pytest.mark.parametrize(("num", "most", "warmup"), [(40, 200, 5), (40, 3, 3)])
def test_the_rate_warms_up_and_comes_down_to_nothing(num, most, warmup):
    found = rates(warmed_adamw(0.1, num, most, weight_decay=0.0), num + 1)
    assert found[0] == 0
    assert found[warmup] == pytest.approx(0.1, rel=1e-4)
    assert found[warmup // 2] == pytest.approx(0.1 * (warmup // 2) / warmup, rel=1e-4)
    middle = warmup + (num - warmup) // 2
    assert found[: warmup + 1] == sorted(found[: warmup + 1])
    assert found[warmup:] == sorted(found[warmup:], reverse=True)
    assert found[middle] == pytest.approx(0.05, abs=3e-3)
    assert found[num] == pytest.approx(0, abs=1e-6)


def test_a_run_of_one_step_has_an_optimizer():
    assert rates(warmed_adamw(0.1, 1, 200), 1) == [0]
