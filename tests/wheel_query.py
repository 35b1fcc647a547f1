"""Plans a query with the installed package alone; run by CI away from the checkout."""

import numpy as np

import gnnjax

planner = gnnjax.load_planner("kuka_iiwa14")
scene = gnnjax.make_scene(centers=[[0.5, 0.0, 0.7]], half_extents=[[0.1, 0.3, 0.2]])
plan = planner.plan(scene, start=[-0.9, 0.9, 0, -1, 0, 0.6, 0], goal=[0.9, 0.9, 0, -1, 0, 0.6, 0])
assert plan.success, plan.reason
assert plan.certified
assert np.isfinite(plan.path).all()
print(f"planned {len(plan.path)} configurations, cost {plan.cost:.2f}, from {gnnjax.__file__}")
