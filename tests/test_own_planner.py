"""Results of planners that callers made, and of weights: which ones are gone on with."""

import copy
import dataclasses
import json

import pytest

from gnnjax.arm.robot import load_robot
from gnnjax.errors import InputError
from gnnjax.evaluate import EvaluateConfig, evaluate
from gnnjax.generate import GenerateConfig, generate
from gnnjax.measure.table import print_summary

pytestmark = pytest.mark.usefixtures("evaluate_with_one_planner")


@pytest.fixture(scope="module")
def problems(tiny_path, tmp_path_factory):
    out = tmp_path_factory.mktemp("problems") / "one.npz"
    return generate(
        GenerateConfig(split="test", robot=str(tiny_path), num_problems=1, shard_size=6, out=out)
    )


def config(tiny_path, problems, out, **changes):
    settings = {"planner": "lazysp", "num_nodes": 40, "max_roadmaps": 1} | changes
    return EvaluateConfig(problems=problems, json=out, robot=str(tiny_path), **settings)


def test_rows_of_planners_that_callers_make_pass_for_no_others(
    tiny_path, problems, tmp_path, planner_once, capsys
):
    case = config(tiny_path, problems, tmp_path / "own.json")
    planner = copy.copy(planner_once(load_robot(tiny_path), case))
    with pytest.raises(InputError, match=r"planner has margin 0.0, and results would tell 0.01;"):
        evaluate(dataclasses.replace(case, margin=0.01), planner)
    with pytest.raises(InputError, match=r"is of \w+, and results would tell kuka_iiwa14; give"):
        evaluate(dataclasses.replace(case, robot="kuka_iiwa14"), planner)
    planner.given = {"scorer": min}
    print_summary(evaluate(case, planner))
    assert "lazysp, 40 nodes, own scorer" in capsys.readouterr().out
    with pytest.raises(InputError, match=r"own.json' is there, .* the same scorer of your own"):
        evaluate(case, planner)
    left = dataclasses.replace(case, json=tmp_path / "cut.json")
    (tmp_path / "cut.json.parts").mkdir()  # as of a run with --keep-parts that was cut off
    with pytest.raises(InputError, match=r"cut.json.parts' is there, and whether its rows are of"):
        evaluate(left, planner)
    with pytest.raises(InputError, match=r"holds results with own \['scorer'\], not None"):
        evaluate(case)


def test_rows_of_other_weights_or_of_an_edited_arm_are_not_gone_on_with(
    tiny_path, problems, tmp_path, planner_once
):
    case = config(tiny_path, problems, tmp_path / "some.json", planner="guided")
    planner = copy.copy(planner_once(load_robot(tiny_path), case))
    evaluate(case, planner)
    again = evaluate(case)  # the same ones
    planner.use_weights(planner.strategy.weights * 0.5)
    fault = r"holds results with weights_sha256 '[\w.]+', not '[\w.]+'; choose another --json"
    with pytest.raises(InputError, match=fault):
        evaluate(case, planner)
    arm = tmp_path / "tiny.xml"
    arm.write_text(tiny_path.read_text().replace('size="0.07"', 'size="0.06"'))
    edited = json.loads(json.dumps(again).replace(str(tiny_path), str(arm)))
    case.json.write_text(json.dumps(edited))
    with pytest.raises(InputError, match="holds results with robot_sha256 "):
        evaluate(dataclasses.replace(case, robot=str(arm)))
    del again["settings"]["weights_sha256"]  # as of files from before there was one
    case.json.write_text(json.dumps(again))
    assert evaluate(case, planner)["problems"] == again["problems"]
