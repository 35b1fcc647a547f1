"""The campaign against the certificate finds nothing, and would find a certificate that errs."""

import numpy as np
import pytest

from experiments.certify_campaign import CampaignConfig, make_arms, measure_block, run
from gnnjax.collision import bounds, certify


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    folder = tmp_path_factory.mktemp("campaign")
    return CampaignConfig(
        num_edges=32, random_arms=1, step=0.01, runs=folder, json=folder / "summary.json"
    )


def test_certified_edges_of_all_arms_survive_a_scan_and_graze(config):
    found = run(config)
    assert list(found) == ["kuka_iiwa14", "kinova_gen3", "franka_panda", "random_0_0", "all"]
    assert found["all"]["edges"] == 32
    assert found["all"]["refuted"] == 0
    assert found["all"]["within_2mm"] >= 3
    assert found["all"]["median_gap_of_those_um"] < 1000
    assert run(config) == found  # from what is there


def test_a_certificate_that_bounds_motion_too_low_is_refuted(config, monkeypatch):
    arm = make_arms(config)["kinova_gen3"]
    reach = bounds.Spheres._reach
    monkeypatch.setattr(bounds.Spheres, "_reach", lambda *given: 0.2 * reach(*given))
    monkeypatch.setattr(certify, "_FIRST_CUT", 10.0)
    bounds.spheres_of.cache_clear()
    rows = measure_block(arm, (1,), 60, 0.01)
    bounds.spheres_of.cache_clear()
    assert sum("refuted" in row for row in rows) >= 3
    assert all(np.isfinite(row["gap"]) for row in rows)
