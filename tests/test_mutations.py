"""Damaged inputs are read or refused in one line; `python -m tests.mutations` reads a thousand."""

import pytest

from tests.mutations import KINDS, try_kind


@pytest.mark.parametrize("kind", KINDS)
def test_a_damaged_input_is_read_or_refused_in_one_line(kind):
    outcomes = try_kind(kind, 25, seed=0)
    assert len(outcomes) == 25
    assert {k: v for k, v in outcomes.items() if v not in ("read", "refused")} == {}
