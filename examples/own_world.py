"""Your own world, in the four ways that it can be given: the same table, can and floor each time.

python examples/own_world.py
"""

from pathlib import Path
from tempfile import mkdtemp

import jax
import numpy as np

import gnnjax

JSON = """{
  "boxes": [{"center": [0.5, 0.0, 0.1], "half_extents": [0.3, 0.6, 0.02]}],
  "cylinders": [{"center": [0.4, 0.1, 0.19], "radius": 0.03, "half_length": 0.07}],
  "half_spaces": [{"point": [0.0, 0.0, -0.5], "normal": [0.0, 0.0, 1.0]}]
}"""

MJCF = """<mujoco>
  <worldbody>
    <geom type="plane" size="2 2 0.1" pos="0 0 -0.5"/>
    <geom type="box" size="0.3 0.6 0.02" pos="0.5 0 0.1"/>
    <body pos="0.4 0.1 0.19"><freejoint/><geom type="cylinder" size="0.03 0.07"/></body>
  </worldbody>
</mujoco>"""

# Edges and heights are whole here, and quaternions are x y z w.
MOVEIT = """
world:
  collision_objects:
    - id: table
      primitives: [{type: box, dimensions: [0.6, 1.2, 0.04]}]
      primitive_poses: [{position: [0.5, 0.0, 0.1], orientation: [0, 0, 0, 1]}]
    - id: can
      primitives: [{type: cylinder, dimensions: [0.14, 0.03]}]
      primitive_poses: [{position: [0.4, 0.1, 0.19], orientation: [0, 0, 0, 1]}]
    - id: floor
      planes: [{coef: [0, 0, 1, 0.5]}]
      plane_poses: [{position: [0, 0, 0], orientation: [0, 0, 0, 1]}]
"""

folder = Path(mkdtemp())
for name, text in {"world.json": JSON, "world.xml": MJCF, "world.yaml": MOVEIT}.items():
    (folder / name).write_text(text, encoding="utf-8")

scenes = {
    "Python": gnnjax.scene_from_shapes(
        [
            gnnjax.box([0.5, 0.0, 0.1], [0.3, 0.6, 0.02]),
            gnnjax.cylinder([0.4, 0.1, 0.19], radius=0.03, half_length=0.07),
            gnnjax.half_space([0.0, 0.0, -0.5], [0.0, 0.0, 1.0]),
        ]
    ),
    "JSON": gnnjax.scene_from_json(folder / "world.json"),
    "MuJoCo": gnnjax.scene_from_mjcf(folder / "world.xml"),
    "MoveIt": gnnjax.scene_from_moveit(folder / "world.yaml"),
}
for name, scene in scenes.items():
    print(f"{name}: {int(scene.mask.sum())} obstacles")
    for mine, theirs in zip(*map(jax.tree.leaves, (scene, scenes["Python"])), strict=True):
        np.testing.assert_allclose(mine, theirs, atol=1e-6)
