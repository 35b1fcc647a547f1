"""Carries a tray: what the hand holds is a part of the arm, and stays clear like its links.

python examples/held_object.py
"""

import gnnjax

panda = gnnjax.load_robot("franka_panda")
# In the frame of the body that holds it; z points out of the hand.
tray = gnnjax.box([0.0, 0.0, 0.11], [0.15, 0.1, 0.01])
glass = gnnjax.cylinder([0.0, 0.0, 0.17], radius=0.03, half_length=0.05)
waiter = panda.attach("hand", [tray, glass], mass=0.6)
print(waiter.notes[-1])

scene = gnnjax.scene_from_shapes(
    [
        gnnjax.box([0.55, 0.0, 0.3], [0.05, 0.05, 0.3]),
        gnnjax.half_space([0.0, 0.0, -0.01], [0.0, 0.0, 1.0]),
    ]
)
start = [-0.6, 0.3, 0.0, -1.8, 0.0, 2.1, 0.8]  # rad
goal = [0.6, 0.3, 0.0, -1.8, 0.0, 2.1, 0.8]
for robot in (panda, waiter):
    planner = gnnjax.make_planner(robot, gnnjax.PlannerOptions())
    plan = planner.plan(scene, start, goal)
    print(f"{robot.name}: cost {plan.cost:.2f} rad, certified: {plan.certified}")
