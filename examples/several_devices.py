"""Shares a batch out over several devices, and over several processes; the plans are the same.

python examples/several_devices.py
"""

import os

# Two devices of a CPU, as a machine with two GPUs has them by itself.
os.environ["JAX_NUM_CPU_DEVICES"] = "2"
os.environ["JAX_PLATFORMS"] = "cpu"

from pathlib import Path
from tempfile import mkdtemp

import jax
import numpy as np

import gnnjax

file = Path(mkdtemp()) / "mine.xml"
file.write_text(
    """<mujoco model="mine"><worldbody>
  <body><joint name="shoulder" axis="0 0 1" range="-170 170"/>
    <geom type="capsule" fromto="0 0 0 0.5 0 0" size="0.04"/>
    <body pos="0.5 0 0"><joint name="elbow" axis="0 0 1" range="-150 150"/>
      <geom type="capsule" fromto="0 0 0 0.4 0 0" size="0.03"/></body></body>
</worldbody></mujoco>"""
)
planner = gnnjax.load_planner(file)
scenes = [gnnjax.make_scene([[0.7, y, 0]], [[0.1, 0.1, 0.1]]) for y in np.linspace(-0.3, 0.3, 32)]
start, goal = np.tile(np.float32([-1, 0]), (32, 1)), np.tile(np.float32([1, 0]), (32, 1))
problems = gnnjax.Problem(start, goal, gnnjax.stack_scenes(scenes))

plans = planner.plan_batch(problems)
print(f"{sum(plan.success for plan in plans)} of 32 solved on {jax.local_device_count()} devices")
with gnnjax.PlannerProcesses(planner, 2) as processes:
    again = processes.plan_batch(problems)
print(f"{sum(plan.success for plan in again)} of 32 solved in 2 processes")
for one, other in zip(plans, again, strict=True):
    np.testing.assert_array_equal(one.path, other.path)
