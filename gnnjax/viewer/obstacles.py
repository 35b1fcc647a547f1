"""Obstacles to choose, add, move, resize and remove."""

from collections.abc import Callable
from typing import Any

import numpy as np
import viser

from gnnjax.errors import InputError
from gnnjax.scene.shapes import FIELDS, KINDS, Shape
from gnnjax.viewer.session import NEW, Session, placed

_SIZE = 0.3  # m, of handles
_NONE = "none"


class ObstacleControls:
    """Of the chosen obstacle; made inside of the part of the panel that they belong to."""

    def __init__(
        self,
        server: viser.ViserServer,
        session: Session,
        lock: Any,
        chosen: Callable[[], None],
    ):
        """Args:
        server: of the browsers.
        session: whose obstacles they are.
        lock: held while what is shown changes; by its thread, it may be taken again.
        chosen: is called when another one is chosen.
        """
        self._lock = lock
        self._server, self._session, self._tell_chosen = server, session, chosen
        self.number: int | None = None  # of the chosen one
        self._shown: Shape | None = None
        self._dragged = False
        self.kind = server.gui.add_dropdown("new", KINDS)
        self.add = server.gui.add_button("add")
        self.choice = server.gui.add_dropdown("obstacle", [_NONE])
        self._folder = server.gui.add_folder(None)
        self.fields: dict[str, Any] = {}
        self.remove = server.gui.add_button("remove", disabled=True)
        self.handles: viser.TransformControlsHandle | None = None

        @self.add.on_click
        async def _(event):
            self._try(lambda: self.choose(session.add(NEW[self.kind.value])))

        @self.remove.on_click
        async def _(event):
            if self.number is not None:
                session.remove(self.number)

        @self.choice.on_update
        async def _(event):
            if event.client is not None:
                named = {name: number for number, name in session.names().items()}
                self.choose(named.get(self.choice.value))

    def choose(self, number: int | None) -> None:
        """Shows the values and handles of another obstacle, or of none."""
        with self._lock:
            self._choose(number)
        self._tell_chosen()

    def _choose(self, number: int | None) -> None:
        if self.handles is not None:
            self.handles.remove()
        for field in self.fields.values():
            field.remove()
        self.handles, self.fields, self._shown, self._dragged = None, {}, None, False
        shape = self._session.shapes.get(number) if number is not None else None
        self.number = None if shape is None else number
        self.remove.disabled = shape is None
        if number is not None and shape is not None:
            with self._folder:
                for name, width in FIELDS[shape.kind].items():
                    if name != "quat":
                        self.fields[name] = self._field(number, name, width, shape.values[name])
            self.handles = self._handles(number, shape)
        self.show()

    def show(self) -> None:
        """Follows the session."""
        names = self._session.names()
        if self.number is not None and self.number not in names:
            self.choose(None)
            return
        options = (_NONE, *names.values())
        if tuple(self.choice.options) != options:
            self.choice.options = options
        self.choice.value = _NONE if self.number is None else names[self.number]
        shape = None if self.number is None else self._session.shapes.get(self.number)
        if shape is None or shape is self._shown:
            return
        self._shown = shape
        for name, field in self.fields.items():
            value = shape.values[name]
            field.value = float(value) if np.ndim(value) == 0 else np.asarray(value, float)
        if self.handles is not None and not self._dragged:
            self.handles.position, self.handles.wxyz = placed(shape)

    def _field(self, number: int, name: str, width: int, value: Any) -> Any:
        gui, label = self._server.gui, name.replace("_", " ") + (", m" if name != "normal" else "")
        if width == 1:
            field = gui.add_number(label, float(value), step=0.01)
        else:
            field = gui.add_vector3(label, tuple(np.asarray(value, float).tolist()), step=0.01)

        @field.on_update
        async def _(event):
            if event.client is not None:
                self._try(lambda: self._session.resize(number, **{name: np.array(field.value)}))

        return field

    def _handles(self, number: int, shape: Shape) -> viser.TransformControlsHandle:
        position, quat = placed(shape)
        handles = self._server.scene.add_transform_controls(
            "/handles/obstacle",
            _SIZE,
            depth_test=False,
            disable_rotations=not FIELDS[shape.kind].keys() & {"quat", "normal"},
            position=position,
            wxyz=quat,
        )

        @handles.on_update
        async def _(event):
            self._dragged = event.phase != "end"
            if event.phase == "update":
                pose = np.array(handles.position), np.array(handles.wxyz)
                self._try(lambda: self._session.move(number, *pose))

        return handles

    def _try(self, edit: Callable[[], object]) -> None:
        try:
            edit()
        except InputError as error:
            self._session.tell(str(error))
