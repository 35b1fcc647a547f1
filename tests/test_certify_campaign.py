"""The campaign against the certificate finds nothing, and would find a certificate that errs."""

import dataclasses

import numpy as np
import pytest

from experiments import campaign_edges, certify_campaign, grazing, turns
from experiments.campaign_edges import draw_shapes
from experiments.certify_campaign import CampaignConfig, make_arms, measure_block, run
from experiments.engine import Engine
from experiments.judge import Judge
from gnnjax.scene.scene import scene_from_shapes


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    folder = tmp_path_factory.mktemp("campaign")
    return CampaignConfig(
        num_edges=72,
        random_arms=1,
        distorted=0,
        step=0.01,
        seed=0,
        runs=folder,
        json=folder / "summary.json",
    )


@pytest.fixture(scope="module", autouse=True)
def arms(config):
    """A few, made once."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(certify_campaign, "SHIPPED", ("kinova_gen3",))
        patch.setattr(certify_campaign, "_HOLDERS", {"kinova_gen3": "bracelet_link"})
        patch.setattr(campaign_edges, "_SCENES", 6)
        patch.setattr(campaign_edges, "_STARTS", 4)
        patch.setattr(grazing, "_BISECTIONS", 11)
        made = make_arms(config, config.runs)
        patch.setattr(certify_campaign, "make_arms", lambda config, folder: made)
        yield made


def test_certified_edges_of_all_arms_survive_a_scan_and_graze(config):
    found = run(config)
    assert list(found) == ["kinova_gen3", "kinova_gen3_holding", "random_0_0", "all"]
    assert found["all"]["edges"] == 72
    assert found["all"]["refuted"] == 0
    assert found["all"]["within_2mm"] >= 8
    assert found["all"]["median_gap_of_those_um"] < 1500
    assert run(config) == found  # from what is there


@pytest.fixture
def measured(monkeypatch):
    """The blocks that are measured, at no cost."""
    found = []

    def measure_once(arm, seed, num, step):
        found.append((seed, num))
        counts = dict.fromkeys(("edges", "grazing", "scanned", "noise", "seconds"), num)
        return counts | {"gaps": [], "least": 1.0, "refuted": []}

    monkeypatch.setattr(certify_campaign, "measure_block", measure_once)
    monkeypatch.setattr(certify_campaign, "_BLOCK", 10)
    return found


def test_a_campaign_goes_on_with_more_edges(config, measured, tmp_path):
    config = dataclasses.replace(config, runs=tmp_path, num_edges=30)
    assert run(config)["all"]["edges"] == 30
    first = measured.copy()
    assert len(first) == 3
    assert run(config)["all"]["edges"] == 30
    assert measured == first
    assert run(dataclasses.replace(config, num_edges=90))["all"]["edges"] == 90
    assert len(measured) == len(set(measured)) == 9


def test_edges_that_an_older_certificate_went_through_do_not_count(
    config, measured, tmp_path, monkeypatch
):
    config = dataclasses.replace(config, runs=tmp_path, num_edges=30)
    for code in ("old", "new"):
        monkeypatch.setattr(turns, "code_digest", lambda code=code: code)
        run(config)
    assert len(measured) == 6
    run(dataclasses.replace(config, step=0.02))
    run(dataclasses.replace(config, seed=2))
    assert len(measured) == 12


def test_an_arm_has_the_same_edges_whatever_others_there_are(
    config, measured, arms, tmp_path, monkeypatch
):
    config = dataclasses.replace(config, runs=tmp_path, num_edges=30)
    run(config)
    more = {"another": arms["kinova_gen3"], **arms}
    monkeypatch.setattr(certify_campaign, "make_arms", lambda config, folder: more)
    run(dataclasses.replace(config, num_edges=40))
    assert len(measured) == 4


@pytest.mark.usefixtures("bounds_too_low")
def test_a_certificate_that_bounds_motion_too_low_is_refuted(arms):
    arm = arms["kinova_gen3"]
    found = measure_block(arm, (1,), 60, 0.01)
    assert len(found["refuted"]) >= 2


def test_the_judge_finds_what_a_scan_of_every_place_finds(arms):
    arm = arms["kinova_gen3"]
    robot, judge, rng = arm.robot, Judge(arm), np.random.default_rng(0)
    met, looked, places = 0, 0, 0
    for _ in range(25):
        shapes = draw_shapes(rng, 0.9)
        judge.place(shapes)
        engine = Engine(robot, scene_from_shapes(shapes))
        start = rng.uniform(robot.joint_lower, robot.joint_upper)
        end = np.clip(start + rng.normal(size=6) * 0.2, robot.joint_lower, robot.joint_upper)
        found = judge.scan(start, end, 0.002)
        count = int(np.linalg.norm(end - start) / 0.001) + 2
        blocked = not engine.valid(np.linspace(start, end, count)).all()
        if abs(found.gap) > 1e-3:
            assert blocked == (found.gap < 0)
        met += blocked
        looked, places = looked + found.num_configurations, places + count
    assert 3 < met < 20
    assert looked < places
