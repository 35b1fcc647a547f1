"""Scrubs and plays what was planned."""

import threading
import time

import numpy as np
import viser

from gnnjax.viewer.answers import Answer, state_at
from gnnjax.viewer.stage import Stage

_FRAME_S = 1 / 30
_STEP_S = 0.01  # of the slider


class Player:
    """A slider of the time along a motion, and a button that moves it, around and around."""

    def __init__(self, server: viser.ViserServer, stage: Stage):
        self._stage = stage
        self._answer: Answer | None = None
        self._lock, self._playing, self._closed = threading.Lock(), threading.Event(), False
        self.time = server.gui.add_slider("time, s", 0.0, 1.0, _STEP_S, 0.0, disabled=True)
        self.button = server.gui.add_button("play", disabled=True)
        self.time.on_update(lambda event: self._show())
        self.button.on_click(lambda event: self._turn(not self._playing.is_set()))
        self._thread = threading.Thread(target=self._play, daemon=True)
        self._thread.start()

    def show(self, answer: Answer | None) -> None:
        """Shows an answer from its start, or hides the arm where there is none, or no path."""
        if answer is self._answer:
            return
        moves = answer is not None and len(answer.times) > 0
        with self._lock:
            self._answer = answer if moves else None
        self.time.value = 0.0
        if answer is not None and moves:
            self.time.max = _STEP_S * max(1, int(np.ceil(answer.times[-1] / _STEP_S)))
        else:
            self._turn(False)
        self.time.disabled = self.button.disabled = not moves
        self._show()

    def close(self) -> None:
        """Ends the thread."""
        self._closed = True
        self._playing.set()
        self._thread.join()

    def _show(self) -> None:
        with self._lock:
            self._stage.arm.root.visible = self._answer is not None
            if self._answer is not None:
                self._stage.arm.place(state_at(self._answer, self.time.value))

    def _turn(self, on: bool) -> None:
        self.button.label = "pause" if on else "play"
        (self._playing.set if on else self._playing.clear)()

    def _play(self) -> None:
        before = time.monotonic()
        while not self._closed:
            now = time.monotonic()
            if self._playing.is_set():
                at = self.time.value + now - before
                self.time.value = at if at < self.time.max else 0.0
                time.sleep(_FRAME_S)
            else:
                self._playing.wait()
                now = time.monotonic()
            before = now
