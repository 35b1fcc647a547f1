"""The experiment about motions in time."""

import pytest

from experiments import motions
from experiments.motions import OWN, RIVAL, MotionsConfig
from experiments.record import run
from experiments.registry import EXPERIMENTS
from gnnjax.scene.scene import make_scene
from gnnjax.trajectory.limits import limits_of
from gnnjax.trajectory.states import largest_use
from gnnjax.trajectory.trajectory import time_path


@pytest.mark.usefixtures("small_figures")
def test_the_quick_form_writes_results_and_goes_on(tiny_path, tmp_path, monkeypatch):
    asked = []

    def half(curve, limits):
        asked.append(limits)
        return len(asked) * 0.5

    monkeypatch.setattr(motions, "duration_by_toppra", half)  # which tests of timing ask
    experiment = EXPERIMENTS["motions"]
    config = MotionsConfig(
        quick=True,
        robot=str(tiny_path),
        data=tmp_path,
        runs=tmp_path,
        results=tmp_path / "out",
        velocity=2.0,
        acceleration=6.0,
        **experiment.quick,
    )
    results = run(experiment, config)
    (row,) = results["rows"]
    assert asked
    assert run(experiment, config)["rows"] == [row]
    assert {*row["planners"]} == {OWN, RIVAL}
    for own in row["planners"].values():
        assert own["motions"] == own["certified"] == own["paths"] > 0
        assert 0.9 < own["largest_use"] < 1.001
    assert len(row["toppra"]["ratios"]) == len(asked)
    assert row["durations"]["all"][OWN] > 0
    assert "| tiny | guided | 3 of 3 | 3 |" in experiment.table(results)
    assert "What does not hold: " in experiment.verdict(results)
    assert (tmp_path / "out" / "motions.png").stat().st_size > 10_000


def test_use_is_that_of_the_narrowest_limit(tiny):
    given = {"velocity": 2.0, "acceleration": 6.0}
    limits, path = limits_of(tiny, **given), [tiny.home, tiny.home + 0.1]
    motion = time_path(tiny, make_scene([], []), path, proven=True, **given)
    use = largest_use(tiny, limits, motion)
    assert 0.9 < use < 1.001
    half = limits._replace(velocity=limits.velocity / 2, acceleration=limits.acceleration / 2)
    assert largest_use(tiny, half, motion) >= 1.9 * use
