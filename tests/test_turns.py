"""Turns of contenders: kept once they are measured, and summed up."""

import numpy as np
import pytest

from experiments import turns
from experiments.contenders import Turn
from experiments.turns import folder_of, kept, summarize, summarize_turn
from gnnjax.arm.robot import load_robot
from tests.stand_in import StandIn


def test_summaries_leave_out_what_was_refused(tiny_path):
    planner = StandIn(load_robot(tiny_path))
    solved, failed = (planner._plan(np.full(3, at, np.float32), np.ones(3)) for at in (0, 0.5))
    uncertified = solved._replace(certified=False, cost=5.0, configuration_checks=30)
    refused = failed._replace(valid=False)
    columns = summarize_turn(Turn(2.0, 0.5, [solved, failed, uncertified, refused]))
    row = summarize([columns, columns | {"wall_s": 1.0}])
    assert row["per_s"] == [1.5, 3.0]
    assert (row["success_of_all"], row["success"]) == pytest.approx((1 / 2, 2 / 3))
    assert row["certified_paths"] == 0.5
    assert row["cost"]["mean"] == pytest.approx((np.sqrt(3) + 5) / 2)
    assert row["configuration_checks"]["mean"] == pytest.approx((9 + 9 + 30) / 3)
    assert row["total_time_s"]["mean"] == pytest.approx(0.5)
    assert row["cores"] == [0.5, 0.5]


def test_what_was_kept_is_not_measured_again(tmp_path):
    assert kept(tmp_path / "folder" / "one.json", lambda: [1]) == [1]
    assert kept(tmp_path / "folder" / "one.json", lambda: [2]) == [1]


def test_what_other_code_or_other_settings_have_measured_lies_elsewhere(tmp_path, monkeypatch):
    found = [folder_of(tmp_path, "one", settings) for settings in (1, 1, 2)]
    monkeypatch.setattr(turns, "code_digest", lambda: "of yesterday")
    found.append(folder_of(tmp_path, "one", 1))
    assert found[0] == found[1]
    assert len(set(found)) == 3


def test_what_was_measured_of_other_files_lies_elsewhere(tmp_path):
    one, two = tmp_path / "one.npz", tmp_path / "two.npz"
    found = set()
    # Where a file ends counts, too.
    for contents in (b"ab", b"cd"), (b"abc", b"d"), (b"ab", b"ce"):
        for path, content in zip((one, two), contents, strict=True):
            path.write_bytes(content)
        found.add(folder_of(tmp_path, "one", 1, one, two))
    assert len(found) == 3


def test_the_code_is_the_package_the_experiments_and_the_arms(tmp_path, monkeypatch):
    """Any file of these counts, with its name; what Python keeps of them does not."""
    folders = [tmp_path / name for name in ("gnnjax", "experiments", "assets")]
    for folder in folders:
        (folder / "__pycache__").mkdir(parents=True)
        (folder / "__init__.py").touch()
    monkeypatch.setattr("gnnjax.__file__", str(folders[0] / "__init__.py"))
    monkeypatch.setattr(turns, "__file__", str(folders[1] / "turns.py"))
    monkeypatch.setattr(turns, "assets_dir", lambda: folders[2])
    digest = turns.code_digest.__wrapped__
    found = [digest()]
    for path in ("gnnjax/a.py", "experiments/carried_out.py", "assets/arm.xml"):
        for content in ("x", "xy"):
            (tmp_path / path).write_text(content)
            found.append(digest())
    (folders[0] / "a.py").rename(folders[0] / "b.py")
    found.append(digest())
    assert len(set(found)) == len(found)
    (folders[1] / "__pycache__" / "turns.pyc").touch()
    assert digest() == found[-1]
