"""Plans with a guide of your own: here, how close a few points of the arm come to the obstacles.

python examples/own_guide.py
"""

import jax
import jax.numpy as jnp

import gnnjax
from gnnjax.guide.view import arm_view

robot = gnnjax.load_robot("kuka_iiwa14")
view = arm_view(
    robot, 12
)  # distances of a dozen points of the arm to the boxes, less its thickness


def prices(weights: jax.Array, scene: gnnjax.Scene) -> gnnjax.Prices:
    """Nats by which configurations and motions are unlikely to be free."""

    def nodes(q: jax.Array) -> jax.Array:
        nearest = view(scene, q).clearance.min(axis=-1)
        return jax.nn.softplus(-weights * (nearest - 0.02))

    def motions(starts: jax.Array, ends: jax.Array, most: int) -> jax.Array:
        along = jnp.linspace(0.0, 1.0, most)[:, None, None] * (ends - starts) + starts
        return nodes(along.reshape(-1, robot.num_dof)).reshape(most, -1).max(axis=0)

    return gnnjax.Prices(nodes, motions)


# Nothing is computed beforehand once a scene: what `read` returns is the scene itself.
guide = gnnjax.Guide(jnp.float32(100.0), read=lambda weights, scene: scene, prices=prices)
# Of checks that take a millisecond, so that the guide is asked first.
planner = gnnjax.load_planner("kuka_iiwa14", guide=guide, check_cost=1000.0)
scene = gnnjax.make_scene(centers=[[0.55, 0.0, 0.75]], half_extents=[[0.12, 0.3, 0.22]])
plan = planner.plan(scene, [-0.9, 0.9, 0, -1, 0, 0.6, 0], [0.9, 0.9, 0, -1, 0, 0.6, 0])
print(f"cost {plan.cost:.2f} rad, {plan.edge_checks} edge checks, certified: {plan.certified}")
