"""Collision checks one at a time, and a ledger that counts what they tested.

For planners that ask from outside of JAX: OMPL's call back for each configuration or edge.
"""

import functools
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from gnnjax.arm.robot import Robot
from gnnjax.arm.torques import rests
from gnnjax.collision.checker import make_checker
from gnnjax.kept import keep
from gnnjax.scene.mujoco_world import build_world, place_obstacles
from gnnjax.scene.scene import Scene, make_scene


class Ledger:
    """What a query has tested; asking again about a known configuration or edge costs nothing.

    After `deadline` nothing is tested any more. What is not known then passes for valid, since that
    ends what OMPL is doing soonest; it is not written down, and `cut_off` tells not to believe it.
    """

    def __init__(self):
        self.configurations: dict[bytes, bool] = {}
        self.edges: dict[tuple[bytes, bytes], bool] = {}
        self.sampling_checks = self.search_checks = self.edge_checks = 0
        self.deadline, self.cut_off = np.inf, False  # of `time.perf_counter`
        self._along_edge = False

    def know(self, q: np.ndarray, test: Callable[[np.ndarray], bool]) -> bool:
        """Validity of a configuration, from `test` where it is not known yet."""
        key = q.tobytes()
        valid = self.configurations.get(key)
        if valid is None:
            if not self._along_edge and self._is_over():  # an edge is tested to its end
                return True
            valid = self.configurations[key] = test(q)
            if self._along_edge:
                self.search_checks += 1
            else:
                self.sampling_checks += 1
        return valid

    def know_edge(self, start: np.ndarray, end: np.ndarray, test: Callable[[], bool]) -> bool:
        """Validity of an edge, from `test` where neither direction is known yet."""
        key = start.tobytes(), end.tobytes()
        valid = self.edges.get(key)
        if valid is None:
            if self._is_over():
                return True
            self.edge_checks += 1
            self._along_edge = True
            valid = self.edges[key] = self.edges[key[::-1]] = test()
            self._along_edge = False
        return valid

    def _is_over(self) -> bool:
        self.cut_off |= time.perf_counter() > self.deadline
        return self.cut_off


@functools.cache
def fused_checks(
    robot: Robot, axis_aligned: bool, max_obstacles: int, resolution: float
) -> Callable:
    """Checks by the fused kernel. The end of an edge is tested first, its interior in the order of
    `check_edges`, all in one call."""
    checker = make_checker(robot, axis_aligned=axis_aligned, resolution=resolution)

    def one(scene: Scene, q: jax.Array) -> jax.Array:
        return checker.check_configurations(scene, q[None])[0]

    def edge(scene: Scene, ends: jax.Array, end_known: jax.Array) -> jax.Array:
        def interior() -> tuple[jax.Array, jax.Array]:
            checks = checker.check_edges(scene, ends[:1], ends[1:])
            return checks.valid[0], checks.num_checks[0]

        end_valid = jax.lax.cond(end_known, lambda: jnp.bool_(True), lambda: one(scene, ends[1]))
        valid, count = jax.lax.cond(
            end_valid, interior, lambda: (jnp.bool_(False), jnp.zeros((), jnp.int32))
        )
        # One array, since each that comes back costs microseconds.
        return jnp.stack([end_valid, valid, count], dtype=jnp.int32)

    kept_one, kept_edge = keep(one), keep(edge)
    home = np.asarray(robot.home, np.float32)
    unknown = np.bool_(False)

    def make(scene: Scene, ledger: Ledger) -> tuple[Callable, Callable]:
        scene = jax.device_put(scene)
        # All calls of a query are alike, and a configuration takes a tenth of a millisecond.
        check_one = kept_one.code_for(scene, home)
        check_edge = kept_edge.code_for(scene, np.stack([home, home]), unknown)

        def is_valid(q: np.ndarray) -> bool:
            return bool(check_one(scene, q))

        def test_edge(start: np.ndarray, end: np.ndarray) -> bool:
            key = end.tobytes()
            known = ledger.configurations.get(key)
            if known is False:
                return False
            found = np.asarray(check_edge(scene, np.stack([start, end]), np.bool_(known is True)))
            if known is None:
                ledger.configurations[key] = bool(found[0])
                ledger.search_checks += 1
            ledger.search_checks += int(found[2])
            return bool(found[1])

        return is_valid, test_edge

    # Compiled here, outside of any query's time.
    none = np.zeros((0, 3))
    blank = make_scene(none, none, max_obstacles=max_obstacles)
    is_valid, test_edge = make(blank, Ledger())
    is_valid(home)
    test_edge(home, home)
    return make


def mujoco_checks(robot: Robot, max_obstacles: int) -> Callable:
    """Checks by MuJoCo's C engine; OMPL's own motion validator takes the points of an edge."""
    model = build_world(robot, max_obstacles)
    data = mujoco.MjData(model)
    lower, upper = robot.joint_lower, robot.joint_upper

    def make(scene: Scene, ledger: Ledger) -> tuple[Callable, None]:
        place_obstacles(model, data, scene)

        def is_valid(q: np.ndarray) -> bool:
            if not ((q >= lower) & (q <= upper)).all():
                return False
            if robot.rest_limit is not None and not rests(robot, q[None])[0]:
                return False
            data.qpos[:] = q
            # Positions are all that contacts need: no full forward pass.
            mujoco.mj_kinematics(model, data)
            mujoco.mj_collision(model, data)
            return data.ncon == 0 or bool((data.contact.dist > 0).all())

        return is_valid, None

    return make
