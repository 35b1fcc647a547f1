"""Scenes of files of any kind, for the command that plans."""

import json

import jax
import numpy as np
import pytest

from gnnjax.arguments import parse_arguments
from gnnjax.arm.robot import load_robot
from gnnjax.collision.certify import certify_path
from gnnjax.errors import InputError
from gnnjax.execute import ExecuteConfig
from gnnjax.plan import PlanConfig
from gnnjax.plan import main as plan_once
from gnnjax.scene.any_file import read_scene
from gnnjax.scene.scene import scene_from_shapes
from gnnjax.scene.shapes import box

JSON = {"boxes": [{"center": [0.6, 0.0, 0.0], "half_extents": [0.1, 0.1, 0.1]}]}
WORLD = """
  <worldbody><geom type="box" size="0.1 0.1 0.1" pos="0.6 0 0"/></worldbody>
"""
MOVEIT = """
world:
  collision_objects:
    - id: brick
      primitives: [{type: box, dimensions: [0.2, 0.2, 0.2]}]
      primitive_poses: [{position: [0.6, 0.0, 0.0], orientation: [0, 0, 0, 1]}]
"""
REQUEST = """
start_state: {joint_state: {name: [a, b, c], position: [-1.5, 0, 0]}}
goal_constraints:
  - joint_constraints:
      - {joint_name: a, position: 1.5}
      - {joint_name: b, position: 0.0}
      - {joint_name: c, position: 0.0}
"""
BRICK = scene_from_shapes([box([0.6, 0.0, 0.0], [0.1, 0.1, 0.1])])
SETTINGS = {"planner": "lazysp", "num_nodes": 60, "max_roadmaps": 2}


@pytest.fixture(scope="module")
def files(tmp_path_factory, tiny_path):
    folder = tmp_path_factory.mktemp("scenes")
    texts = {
        "lists.json": json.dumps(JSON),
        "moveit.yaml": MOVEIT,
        "MOVEIT.YML": MOVEIT,
        "world.xml": f"<mujoco>{WORLD}</mujoco>",
        "with_robot.xml": f'<mujoco><include file="{tiny_path}"/>{WORLD}</mujoco>',
        "request.yaml": REQUEST,
        "scene.txt": json.dumps(JSON),
        "none": json.dumps(JSON),
    }
    for name, text in texts.items():
        (folder / name).write_text(text)
    return folder


@pytest.mark.parametrize(
    "name", ["lists.json", "moveit.yaml", "MOVEIT.YML", "world.xml", "with_robot.xml"]
)
def test_all_kinds_are_read(tiny_path, files, name):
    found = read_scene(files / name, load_robot(tiny_path))
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, atol=1e-7), found, BRICK)


@pytest.mark.parametrize("config", [PlanConfig, ExecuteConfig])
def test_help_names_all_endings(config, capsys):
    with pytest.raises(SystemExit):
        parse_arguments(config, args=["--help"], prog="do")
    said = capsys.readouterr().out
    assert all(ending in said for ending in (".json", ".yaml", ".xml", ".bt", ".ot"))


@pytest.mark.parametrize("name", ["scene.txt", "none"])
def test_other_endings_are_refused(tiny_path, files, name):
    with pytest.raises(InputError, match=r"has the ending '.*'; give \.json .*, \.yaml .* \.xml"):
        read_scene(files / name, load_robot(tiny_path))


def config_of(tiny_path, files, tmp_path, **changes):
    paths = {name: files / changes.pop(name) for name in ("scene", "request") if name in changes}
    settings = {**SETTINGS, **paths, **changes}
    return PlanConfig(robot=str(tiny_path), out=tmp_path / "path.npz", **settings)


def test_the_command_plans_for_a_request_of_moveit(tiny_path, files, tmp_path):
    given = {"scene": "moveit.yaml", "request": "request.yaml"}
    assert plan_once(config_of(tiny_path, files, tmp_path, **given)) == 0
    path = np.load(tmp_path / "path.npz")["path"]
    np.testing.assert_allclose(path[[0, -1]], [[-1.5, 0, 0], [1.5, 0, 0]])
    assert certify_path(load_robot(tiny_path), BRICK, path)


ENDS = {"start": (-1.5, 0.0, 0.0), "goal": (1.5, 0.0, 0.0)}


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"scene": "lists.json"}, "a query needs --start and --goal, or a --request"),
        ({"scene": "lists.json", "start": ENDS["start"]}, "a query needs --start and --goal"),
        ({"scene": "moveit.yaml", "request": "request.yaml", **ENDS}, "leave --start and --goal"),
        ({"scene": "world.xml", "request": "request.yaml"}, "needs a planning scene of MoveIt"),
        ({"scene": "scene.txt", **ENDS}, "has the ending '.txt'"),
    ],
)
def test_options_that_do_not_fit_are_refused(tiny_path, files, tmp_path, given, message):
    with pytest.raises(InputError, match=message):
        plan_once(config_of(tiny_path, files, tmp_path, **given))
    assert not list(tmp_path.iterdir())
