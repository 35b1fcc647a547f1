"""The texts hold the numbers of the results files, and nothing typed by hand.

What verdicts say is tested on inputs of their own, in data/verdicts: what verdicts read of results
files, frozen, so that measuring anew changes no test of wording.
"""

import copy
import json
from pathlib import Path

import pytest

from experiments import cluster_page
from experiments.certificate_page import load_campaigns, page
from experiments.conclusions import conclusions
from experiments.readme import replace_section
from experiments.record import Finding, judge
from experiments.registry import EXPERIMENTS
from experiments.report import ReportConfig, texts
from experiments.results import load_results
from experiments.tables import listing, markdown, seconds, span
from gnnjax.errors import InputError


def test_readme_and_docs_equal_the_results_files():
    for path, text in texts(ReportConfig()).items():
        assert path.read_text(encoding="utf-8") == text, f"run python -m experiments.report: {path}"


def test_results_of_another_format_are_refused(tmp_path):
    path = tmp_path / "figure5.json"
    path.write_text(json.dumps({"format": 0}))
    with pytest.raises(InputError, match="holds results of format 0, this version reads 1"):
        load_results(path)
    path.write_text("{")
    with pytest.raises(InputError, match="holds no results; remove it"):
        load_results(path)
    with pytest.raises(InputError, match=r"no results .*; run python -m experiments.run_all"):
        load_results(tmp_path / "missing.json")


def test_the_page_on_the_certificate_tells_of_what_is_refuted(tmp_path):
    found = load_campaigns(Path("results"))
    arms = found["certify_campaign"]["arms"]
    arms["all"]["refuted"] = 0
    assert f"0 of {arms['all']['edges']:,} edges are refuted" in page(found)
    arms["all"]["refuted"] = 2
    assert f"**2 of {arms['all']['edges']:,} edges are refuted.**" in page(found)
    with pytest.raises(InputError, match=r"certify_campaign.json'; run python -m experiments"):
        load_campaigns(tmp_path)


def test_what_many_machines_take_follows_from_the_plans_a_second_of_one(tmp_path):
    results = load_results(Path("results/throughput.json"))
    for row in results["rows"]:
        row |= {"per_s": [200.0], "cores": [2.0]}
    text = cluster_page.page("<!-- ten-million -->\n<!-- /ten-million -->", results, tmp_path)
    assert "**200 plans a second**" in text
    assert "Ten million take 781 s on 64 such machines, and 28 hours of CPU time" in text


def test_a_text_without_the_comments_is_refused(tmp_path):
    with pytest.raises(InputError, match="lacks the comments <!-- table-x -->"):
        replace_section("text", "table-x", "rows", tmp_path)
    marked = "a\n<!-- t -->\nold\n<!-- /t -->\nb\n"
    assert replace_section(marked, "t", "new\n", tmp_path) == marked.replace("old", "new")


def test_tables_and_prices_read_well():
    assert markdown(["a", "b"], [["1", "2"]]) == "| a | b |\n| --- | --- |\n| 1 | 2 |\n"
    assert [seconds(x) for x in (None, 1e-8, 2.5e-7, 3e-6, 0.04, 1.0)] == [
        "never",
        "always",
        "250 ns",
        "3 us",
        "40 ms",
        "1 s",
    ]
    assert span([0.31, 0.12, 0.2], ".0f", 100) == "12 to 31"
    assert span([0.1201, 0.12], ".1f", 100) == "12.0"
    assert [listing(words.split()) for words in ("a", "a b", "a b c")] == [
        "a",
        "a and b",
        "a, b and c",
    ]


def test_a_verdict_says_which_parts_hold():
    one, two = Finding(True, "one"), Finding(False, "two")
    assert judge(one) == "Holds: one."
    assert judge(one, one, beside=["More."]) == "Holds: one; one. More."
    assert judge(two) == "Does not hold: two."
    assert judge(two, one) == "Holds in part: one. What does not hold: two."


def frozen(name):
    """What an experiment's verdict reads."""
    return json.loads((Path(__file__).parent / "data" / "verdicts" / f"{name}.json").read_text())


def of_planner(results, name):
    return (row for row in results["rows"] if row["planner"] == name)


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_results_are_of_the_claim_that_is_made(name):
    results = load_results(Path("results") / f"{name}.json")
    assert (results["experiment"], results["claim"]) == (name, EXPERIMENTS[name].claim)


def many_checks(results):
    for row in of_planner(results, "guided_dear"):
        row["summary"]["all"]["configuration_checks"] |= {"mean": 5e4, "high": 6e4}


def quick_planning(results):
    for name in ("gnn", "gnn_lazy"):
        for row in of_planner(results, name):
            row["saved"]["planning_time_s"] = 0.25


def dear_guide(results):
    for found in results["crossovers"]:
        if found["guide"] == "guided" and found["rival"] == "lazysp":
            found["from_s"] = None


def easy_for_rrt_connect(results):
    for row in of_planner(results, "ompl:rrt_connect"):
        if row["stratum"] == "line blocked":
            row["summary"]["all"]["configuration_checks"]["mean"] = 1.0


def no_dead_ends(results):
    for row in of_planner(results, "gnn_paper"):
        row["dead_ends"]["low"] = 0.0


def motions_beyond_limits(results):
    results["rows"][0]["planners"]["guided"]["largest_use"] = 1.05


def worse_than_its_own(results):
    for row in of_planner(results, "guided_shipped"):
        row["to_own"] = {"edge_checks": {"mean": 1.2, "low": 1.1, "high": 1.3}}


def dear_networks(results):
    results["check_operations"] = dict.fromkeys(results["check_operations"], 1000)


def a_checkless_length(results):
    fields = {row["set"]: row for row in results["rows"] if row["guide"] == "field"}
    for row in results["rows"]:
        if row["guide"] == "length":
            field = fields[row["set"]]["shortened"]["hard"]["configuration_checks"]
            row["shortened"]["hard"]["configuration_checks"]["mean"] = field["mean"] / 2


def a_fit_that_pays(results):
    for row in results["rows"]:
        if row["kind"] == "plans" and row["calibration"] == "fitted, 24 cells":
            row["to_hand"]["configuration_checks"] = {"mean": 0.85, "low": 0.8, "high": 0.9}


def a_training_that_pays(results):
    results["rows"][-1]["difference"]["edge_checks"] |= {"mean": -2.0, "low": -3.0, "high": -1.0}


def a_part_that_pays(results):
    for row in results["rows"]:
        if row["variant"] == "default without gat":
            row["difference"]["edge_checks"] |= {"mean": 2.0, "low": 1.0, "high": 3.0}


def slow_in_a_pool(results):
    for row in of_planner(results, "guided"):
        row["per_s"] = [1.0 for _ in row["per_s"]]


def some_unsolved(results):
    for row in of_planner(results, "guided"):
        row |= {"success_of_all": 137 / 140, "success": 137 / 140}


def motions_that_swing(results):
    for row in of_planner(results, "guided"):
        row["suitable_held"] = row["held"] // 2


def poses_that_are_not_reached(results):
    for row in results["rows"]:
        if row["solver"] == "gnnjax":
            row["share"]["mean"] = 0.99


@pytest.mark.parametrize(
    ("name", "change", "before", "after"),
    [
        (
            "motion_bench_maker",
            some_unsolved,
            "What does not hold: 139 of these 140 are solved",
            "What does not hold: 137 of these 140 are solved",
        ),
        (
            "inverse_kinematics",
            poses_that_are_not_reached,
            "Holds: kuka_iiwa14: 100.0 % in",
            "Does not hold: kuka_iiwa14: 99.0 % in",
        ),
        ("motions", motions_beyond_limits, "motions use 100.", "motions use 105.00 % of a limit"),
        ("real_arm", motions_that_swing, "Holds: kuka", "does not hold: kuka_iiwa14, 0"),
        ("throughput", slow_in_a_pool, "Holds: ", "does not hold: all accepted problems: guided"),
        ("figure5", many_checks, "Holds in part: ", "50000 configuration checks"),
        ("figure7", quick_planning, "gnn 1.7 times BIT*", "gnn 25.0 % less than BIT*"),
        ("crossover", dear_guide, "Holds: ", "Does not hold: guided is faster in the mean against"),
        ("hard", easy_for_rrt_connect, "4.7 (line blocked)", "0.0 (line blocked)"),
        ("failures", no_dead_ends, "Holds in part: dead ends", "does not hold: dead ends"),
        ("arms", worse_than_its_own, "Holds: kinova", "not hold: kinova_gen3: 1.20 (1.10 to 1.30)"),
        ("converged", a_training_that_pays, "Holds: paper's", "not hold: paper's network"),
        ("guides", a_checkless_length, "length alone takes 1.", "alone takes 0.50 times"),
        ("calibrate_field", a_fit_that_pays, "Holds: fitted", "not hold: fitted, 24 cells"),
        ("predictor", dear_networks, "Holds: in pieces of 0.5 rad", "Does not hold: not every"),
        (
            "ablation",
            a_part_that_pays,
            "save 4.2 (3.2 to 5.2) and gat, gcn",
            "gat save 2.0 (1.0 to 3.0)",
        ),
    ],
)
def test_a_verdict_follows_its_results(name, change, before, after):
    experiment = EXPERIMENTS[name]
    results = frozen(name)
    changed = copy.deepcopy(results)
    change(changed)
    verdicts = experiment.verdict(results), experiment.verdict(changed)
    assert before in verdicts[0]
    assert before not in verdicts[1]
    assert after in verdicts[1]
    assert after not in verdicts[0]


def test_a_conclusion_follows_the_results():
    results = {name: frozen(name) for name in EXPERIMENTS}
    statement = "- **Dead ends belong to the greedy walk, not to the network.**"
    found = conclusions(results)
    assert f"{statement} Holds in part: the lazy search has 0.0 % dead ends. What does not" in found
    for row in of_planner(results["failures"], "gnn_lazy"):
        row["dead_ends"]["mean"] = 0.02
    found = conclusions(results)
    assert f"{statement} Does not hold: the lazy search has 2.0 % dead ends; its paths" in found
