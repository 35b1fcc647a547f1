"""Where the bodies of an arm are, and the frame of its hand, by MuJoCo's kinematics."""

import threading

import mujoco
import numpy as np

from gnnjax.arm.robot import Robot
from gnnjax.pose.goal import tool_frame


class Frames:
    """Of one arm; any thread may ask."""

    def __init__(self, robot: Robot, frame: str | None = None):
        """Args:
        robot: the arm.
        frame: site or body that poses are of, see `tool_frame`.

        Raises:
            InputError: no such frame.
        """
        self._model, self._data = robot.mj_model, mujoco.MjData(robot.mj_model)
        self._lock = threading.Lock()
        tool = tool_frame(robot, frame)
        self._body, self._offset = tool.chain[-1] + 1, tool.position
        self._turn = np.zeros(4)
        mujoco.mju_mat2Quat(self._turn, tool.rotation.ravel())

    def bodies(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Positions `[B 3]` (m) and quaternions `[B 4]` of MuJoCo's bodies, the world first."""
        with self._lock:
            self._place(q)
            return self._data.xpos.copy(), self._data.xquat.copy()

    def tip(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Position `[3]` (m) and quaternion `[4]` of the hand's frame."""
        quat = np.zeros(4)
        with self._lock:
            self._place(q)
            mujoco.mju_mulQuat(quat, self._data.xquat[self._body], self._turn)
            return self._tip(), quat

    def tips(self, configurations: np.ndarray) -> np.ndarray:
        """Positions `[N 3]` of the hand's frame, m, at configurations `[N D]`."""
        found = np.empty((len(configurations), 3))
        with self._lock:
            for row, q in enumerate(configurations):
                self._place(q)
                found[row] = self._tip()
        return found

    def _place(self, q: np.ndarray) -> None:
        self._data.qpos[:] = q
        mujoco.mj_kinematics(self._model, self._data)

    def _tip(self) -> np.ndarray:
        turned = self._data.xmat[self._body].reshape(3, 3) @ self._offset
        return self._data.xpos[self._body] + turned
