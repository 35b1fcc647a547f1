"""Plans many problems at once, each in a scene of its own.

python examples/batch.py
"""

import numpy as np

import gnnjax

planner = gnnjax.load_planner("kuka_iiwa14")
start, goal = [-0.9, 0.9, 0, -1, 0, 0.6, 0], [0.9, 0.9, 0, -1, 0, 0.6, 0]
# The same query around a box that stands elsewhere each time.
rng = np.random.default_rng(0)
centers = rng.uniform([0.55, -0.1, 0.65], [0.65, 0.1, 0.8], (8, 3))
scenes = [gnnjax.make_scene([center], [[0.12, 0.3, 0.22]]) for center in centers]
problems = gnnjax.Problem(
    np.tile(np.float32(start), (8, 1)),
    np.tile(np.float32(goal), (8, 1)),
    gnnjax.stack_scenes(scenes),
)

for center, plan in zip(centers, planner.plan_batch(problems), strict=True):
    found = f"cost {plan.cost:.2f} rad" if plan.success else plan.reason
    print(f"box at {center.round(2)}: {found}")
# What is found for one does not depend on the others.
alone = planner.plan(scenes[0], start, goal)
np.testing.assert_array_equal(alone.path, planner.plan_batch(problems)[0].path)
