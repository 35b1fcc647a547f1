"""Times a path, and carries the motion out by an arm that is not quite as its model.

python examples/motion.py
"""

import gnnjax

planner = gnnjax.load_planner("kuka_iiwa14", margin=0.01)  # m, for what the controller misses
scene = gnnjax.make_scene(centers=[[0.55, 0.0, 0.75]], half_extents=[[0.12, 0.3, 0.22]])
start, goal = [-0.9, 0.9, 0, -1, 0, 0.6, 0], [0.9, 0.9, 0, -1, 0, 0.6, 0]
motion = planner.plan(scene, start, goal, trajectory=True).trajectory
assert motion is not None
setpoints = gnnjax.sample_trajectory(planner.robot, motion, 0.01)
print(f"{setpoints.times[-1]:.2f} s, torques up to {abs(setpoints.torques).max():.0f} N m")
gnnjax.save_trajectory(planner.robot, motion, "motion.csv")

errors = gnnjax.ModelErrors(mass=0.1, friction=0.5, delay=0.004)
found = gnnjax.execute_trajectory(planner.robot, scene, motion, errors=errors)
print(f"success: {found.success}, touched: {found.touched or 'nothing'}")
print(f"strayed {1e3 * found.stray:.1f} mm from the curve, proven to be clear: {found.proven}")
