"""The command that carries motions out."""

import json
import re

import numpy as np
import pytest

from gnnjax.arm.robot import load_robot
from gnnjax.errors import InputError
from gnnjax.execute import ExecuteConfig, main
from gnnjax.scene.scene import make_scene
from gnnjax.trajectory.files import save_trajectory
from gnnjax.trajectory.trajectory import time_path

LIMIT = (40.0, 40.0, 20.0)


@pytest.fixture(scope="module")
def files(tiny_path, tmp_path_factory):
    """A motion, and scenes in which it is free and is not."""
    folder, robot = tmp_path_factory.mktemp("motions"), load_robot(tiny_path)
    motion = time_path(
        robot, make_scene([], []), [[-1, 0, 0], [1, 0.2, 0]], velocity=1.5, acceleration=5.0
    )
    save_trajectory(robot, motion, folder / "motion.npz")
    for name, x in (("free", 3.0), ("blocked", 0.7)):
        box = {"center": [x, 0, 0], "half_extents": [0.05] * 3}
        (folder / f"{name}.json").write_text(json.dumps({"boxes": [box]}))
    return folder


def config_of(tiny_path, files, scene, **changes):
    return ExecuteConfig(
        robot=str(tiny_path),
        scene=files / f"{scene}.json",
        trajectory=files / "motion.npz",
        **{"torque": LIMIT, **changes},
    )


def test_a_motion_that_is_free_is_carried_out_and_drawn(tiny_path, files, tmp_path, capsys):
    picture = tmp_path / "motion.png"
    assert main(config_of(tiny_path, files, "free", figure=picture)) == 0
    told = capsys.readouterr().out
    assert "carried out: nothing was touched" in told
    assert "proven to keep 250.0 mm" in told.replace("\n", " ")
    assert picture.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("scene", "changes", "message"),
    [
        ("blocked", {}, "failed: .* touches .* after"),
        ("free", {"delay": 0.08, "most_error": 0.2}, "failed: joint . was .* from where it should"),
        ("free", {"payload": 5.0}, "failed: the arm does not rest at the goal"),
    ],
)
def test_what_goes_wrong_is_told(tiny_path, files, capsys, scene, changes, message):
    assert main(config_of(tiny_path, files, scene, **changes)) == 1
    assert re.search(message, capsys.readouterr().out)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"torque": None}, "tiny has no torque limits"),
        ({"controller": "pid"}, "no controller 'pid'"),
        ({"mass_error": np.inf}, "mass error is inf"),
        ({"figure": "motion.xyz"}, "has no known ending"),
    ],
)
def test_the_command_refuses_what_it_cannot_do(tiny_path, files, tmp_path, changes, message):
    changes = {k: tmp_path / v if k == "figure" else v for k, v in changes.items()}
    with pytest.raises(InputError, match=message):
        main(config_of(tiny_path, files, "free", **changes))


def test_bad_input_is_one_line_and_status_2(files, run_as_command):
    words = ["--scene", files / "free.json", "--trajectory", files / "motion.npz"]
    status, _, said = run_as_command("gnnjax.execute", "--robot", "kuka_iiwa14", *words)
    assert status == 2
    assert said.startswith("error: trajectory file ")
    assert said.count("\n") == 1
