"""Start or goal: a slider a joint, and handles at the hand."""

import numpy as np
import viser

from gnnjax.viewer.frames import Frames
from gnnjax.viewer.session import Session
from gnnjax.viewer.stage import DrawnArm

_STEP = 1e-3  # rad or m, of sliders
_SIZE = 0.25  # m, of handles


class EndControls:
    """Of one end of the query; made inside of the part of the panel that they belong to."""

    def __init__(
        self,
        server: viser.ViserServer,
        session: Session,
        name: str,
        ghost: DrawnArm,
        frames: Frames,
    ):
        self._session, self._name, self._ghost, self._frames = session, name, ghost, frames
        self._shown: np.ndarray | None = None
        self.dragged = False
        robot, q = session.robot, session.end(name)
        self.sliders = []
        for joint, low, high, value in zip(
            robot.joint_names, robot.joint_lower, robot.joint_upper, q, strict=True
        ):
            # Start and goal may be refused for lying outside, and have to be shown.
            low, high = _short(min(low, value)), _short(max(high, value))
            slider = server.gui.add_slider(joint, low, high, _STEP, _short(value))
            self.sliders.append(slider)
        for number in range(len(self.sliders)):
            self._follow(number)
        position, quat = frames.tip(q)
        self.handles = server.scene.add_transform_controls(
            f"/handles/{name}", _SIZE, depth_test=False, position=position, wxyz=quat
        )

        # In the order in which they come, which threads of viser's would not keep.
        @self.handles.on_update
        async def _(event):
            self.dragged = event.phase != "end"
            if event.phase == "update":
                pose = np.array(self.handles.position), np.array(self.handles.wxyz)
                session.drag_end(name, *pose)
            elif not self.dragged:  # once the hand is where it can be: the handles may be elsewhere
                session.worker.ask(f"handles {name}", self._bring_handles)

    def show(self) -> None:
        """Follows the session."""
        q = self._session.end(self._name)
        if q is self._shown:
            return
        self._shown = q
        self._ghost.place(q)
        for slider, value in zip(self.sliders, q, strict=True):
            slider.value = _short(value)
        self._bring_handles()

    def _bring_handles(self) -> None:
        """To the hand, unless they are what brings the hand."""
        if not self.dragged:
            self.handles.position, self.handles.wxyz = self._frames.tip(
                self._session.end(self._name)
            )

    def _follow(self, number: int) -> None:
        @self.sliders[number].on_update
        async def _(event):
            if event.client is None:  # it was set by `show`
                return
            q = self._session.end(self._name).copy()
            q[number] = self.sliders[number].value
            self._session.set_end(self._name, q)


def _short(value: np.floating) -> float:
    """A number of single precision with no more digits than it has."""
    return float(str(np.float32(value)))
