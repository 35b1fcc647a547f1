"""Plans a query, and draws it where matplotlib is installed.

python examples/plan.py
"""

import importlib.util

import gnnjax

planner = gnnjax.load_planner("kuka_iiwa14")
scene = gnnjax.make_scene(centers=[[0.55, 0.0, 0.75]], half_extents=[[0.12, 0.3, 0.22]])  # m
start, goal = [-0.9, 0.9, 0, -1, 0, 0.6, 0], [0.9, 0.9, 0, -1, 0, 0.6, 0]  # rad
plan = planner.plan(scene, start, goal)
print(plan.path.round(2))
print(f"cost {plan.cost:.2f} rad, {plan.configuration_checks} checks, certified: {plan.certified}")
print(f"keeps {1e3 * planner.clearance(scene, plan):.0f} mm from the box, proven")

if importlib.util.find_spec("matplotlib"):
    from gnnjax.plot import draw_plan

    draw_plan(planner.robot, scene, plan.path, "plan.png")
