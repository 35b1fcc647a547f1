"""Trains a motion network for an arm, and plans the same problems with it and with the distance
field, which needs no training. It takes about two minutes of CPU time, most of it to compile.

python examples/train_and_compare.py
"""

from pathlib import Path
from tempfile import mkdtemp

from gnnjax.evaluate import EvaluateConfig, evaluate, print_summary
from gnnjax.generate import GenerateConfig, generate
from gnnjax.train_motion import TrainMotionConfig, train_motion

ARM = """<mujoco model="mine">
  <worldbody>
    <body name="turn">
      <joint name="turn" axis="0 0 1" range="-170 170"/>
      <geom type="capsule" fromto="0 0 0.1 0 0 0.3" size="0.06"/>
      <body name="upper" pos="0 0 0.4">
        <joint name="shoulder" axis="0 1 0" range="-100 100"/>
        <geom type="capsule" fromto="0 0 0.1 0 0 0.4" size="0.05"/>
        <body name="fore" pos="0 0 0.4">
          <joint name="elbow" axis="0 1 0" range="-150 150"/>
          <geom type="capsule" fromto="0 0 0.12 0 0 0.5" size="0.04"/>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>"""
folder = Path(mkdtemp())
robot = str(folder / "mine.xml")
Path(robot).write_text(ARM, encoding="utf-8")

sizes = {"steps": 10, "scenes": 8, "motions": 128}  # too few for a good one
train_motion(TrainMotionConfig(robots=(robot,), out=folder / "run", save_every=10, **sizes))
problems = generate(GenerateConfig("test", robot=robot, num_problems=10, out=folder / "test.npz"))
for name, weights in (("field", None), ("network", folder / "run" / "weights.safetensors")):
    out = folder / f"{name}.json"
    # Of checks that take a millisecond, so that the guide is asked first.
    config = EvaluateConfig(
        problems=problems, json=out, robot=robot, weights=weights, check_cost=1000.0
    )
    print(f"{name}:")
    print_summary(evaluate(config))
