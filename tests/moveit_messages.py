"""A planning scene and a request of MoveIt, and changes of them, of tests in several files."""

import yaml

from gnnjax import problem_from_moveit, scene_from_moveit
from gnnjax.scene.scene import Scene

TURN = [0.0, 0.0, 0.6, 0.8]  # x y z w

# As the benchmarks are published: types by name, poses as lists, headers left out.
SCENE = """
robot_model_name: panda
name: ""
fixed_frame_transforms:
  - transform: {translation: [0, 0, 0], rotation: [0, 0, 0, 1]}
    child_frame_id: world
allowed_collision_matrix: {entry_names: [hand], entry_values: [[false]]}
robot_state:
  joint_state: {name: [a], position: [0]}
  multi_dof_joint_state:
    joint_names: [virtual_joint]
    transforms: [{translation: [0, 0, 0], rotation: [0, 0, 0, 1]}]
    wrench: []
    twist: []
world:
  collision_objects:
    - id: can
      primitives: [{type: cylinder, dimensions: [0.14, 0.03]}]
      primitive_poses: [{position: [0.5, 0.1, 0.3], orientation: [0, 0, 0.6, 0.8]}]
    - id: table
      primitives: [{type: box, dimensions: [0.8, 0.4, 0.02]}, {type: sphere, dimensions: [0.2]}]
      primitive_poses:
        - {position: [0, 1, 0], orientation: [0.6, 0, 0, 0.8]}
        - {position: [1e-05, -1, 2], orientation: [0, 0, 0, 1]}
"""
REQUEST = """
group_name: arm
workspace_parameters: {min_corner: [-1, -1, -1], max_corner: [1, 1, 1]}
start_state:
  multi_dof_joint_state:
    joint_names: [virtual_joint]
    transforms: [{translation: [0, 0, 0], rotation: [0, 0, 0, 1]}]
  joint_state: {name: [c, finger, a, b], position: [0.3, 0.04, 0.1, 0.2]}
goal_constraints:
  - joint_constraints:
      - {joint_name: b, position: -0.2}
      - {joint_name: c, position: -0.3, tolerance_above: 0.01, tolerance_below: 0.01, weight: 1}
      - {joint_name: a, position: -0.1}
"""


def written(folder, message, name="scene.yaml"):
    path = folder / name
    text = message if isinstance(message, str) else yaml.safe_dump(message)
    path.write_text(text, encoding="utf-8")
    return path


def read(folder, message) -> Scene:
    return scene_from_moveit(written(folder, message))


def put(*path_and_value):
    """A change of a message: a value at a path into it; the function `dict.pop` removes."""
    *path, value = path_and_value

    def change(message):
        for step in path[:-1]:
            message = message[step]
        if value is dict.pop:
            message.pop(path[-1])
        else:
            message[path[-1]] = value

    return change


POSE = {"position": [0, 0, 0], "orientation": [0, 0, 0, 1]}


def problem_of(folder, robot, request, scene=SCENE, **options):
    scene, request = written(folder, scene), written(folder, request, "request.yaml")
    return problem_from_moveit(scene, request, robot, **options)
