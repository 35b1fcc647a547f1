"""Plans to a pose of the hand: pointing down, turned about the vertical as it likes.

python examples/pose_goal.py
"""

import gnnjax

planner = gnnjax.load_planner("kuka_iiwa14")
scene = gnnjax.make_scene(centers=[[0.55, 0.0, 0.75]], half_extents=[[0.12, 0.3, 0.22]])
start = [-0.9, 0.9, 0, -1, 0, 0.6, 0]  # rad
# Of the arm's site "tool"; quaternions are w x y z, and this one turns its z axis down.
pose = gnnjax.PoseGoal([0.4, 0.5, 0.3], [0.0, 1.0, 0.0, 0.0], free=["rz"])

found = gnnjax.inverse_kinematics(planner.robot, pose, scene, near=start)
error = 1e3 * found.position_error[found.valid].max()
print(f"{found.valid.sum()} configurations reach it within {error:.4f} mm")

plan = planner.plan(scene, start, goal_pose=pose)
print(f"cost {plan.cost:.2f} rad to {plan.path[-1].round(2)}, certified: {plan.certified}")

# What cannot be reached is told with what stands in the way.
try:
    planner.plan(scene, start, goal_pose=pose._replace(position=[0.55, 0.0, 0.75]))
except gnnjax.InputError as error:
    print(error)
