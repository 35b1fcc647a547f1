"""Damaged inputs are read or refused in one line; `python -m tests.mutations` reads a thousand."""

import pytest

from tests.mutations import KINDS, try_kinds


@pytest.fixture(scope="module")
def outcomes():
    return try_kinds(dict.fromkeys(KINDS, 25), seed=0)


@pytest.mark.parametrize("kind", KINDS)
def test_a_damaged_input_is_read_or_refused_in_one_line(outcomes, kind):
    assert len(outcomes[kind]) == 25
    assert {k: v for k, v in outcomes[kind].items() if v not in ("read", "refused")} == {}
