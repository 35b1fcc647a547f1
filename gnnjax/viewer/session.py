"""What is edited in a viewer: obstacles, start and goal; and what was planned for them last.

It knows of no browser. Whoever shows it is told when something has changed, by any thread.
"""

import threading
from collections.abc import Callable
from typing import Any

import numpy as np

from gnnjax.arm.robot import Robot
from gnnjax.errors import InputError
from gnnjax.scene.scene import Allowed, Scene, obstacle_name, scene_from_shapes
from gnnjax.scene.shapes import (
    FIELDS,
    KINDS,
    Shape,
    Sums,
    box,
    capsule,
    cylinder,
    described,
    for_every_kind,
    half_space,
    known_kinds,
    sphere,
    sums_of,
    z_axis,
)
from gnnjax.viewer.answers import Answer, Query, Reach, Solve, without_path
from gnnjax.viewer.worker import Worker

ENDS = ("start", "goal")
_AHEAD = [0.5, 0.0, 0.5]  # m
# What is added of a kind, for a start.
NEW = for_every_kind(
    "new obstacle",
    box=box(_AHEAD, [0.1, 0.1, 0.1]),
    sphere=sphere(_AHEAD, 0.1),
    capsule=capsule(_AHEAD, 0.06, 0.1),
    cylinder=cylinder(_AHEAD, 0.08, 0.1),
    half_space=half_space([0.0, 0.0, -0.02], [0.0, 0.0, 1.0]),
)
_PAUSE_S = 0.15  # after the last edit, before it is planned


class Session:
    """A query that is edited, and planned anew after each edit, in a thread of its own.

    Of edits while something is planned the latest counts: what was planned for an earlier query is
    dropped. Until there is an answer, `answer` is the one before, and `is_current` false.
    """

    def __init__(
        self,
        robot: Robot,
        query: Query,
        solve: Solve,
        reach: Reach,
        changed: Callable[[], None] = lambda: None,
        pause_s: float = _PAUSE_S,
    ):
        """Args:
        robot: the arm.
        query: to begin with.
        solve: plans.
        reach: finds configurations for poses of the hand.
        changed: is called after each change, by the thread that made it.
        pause_s: of edits, after which it is planned.

        Raises:
            InputError: a scene with an obstacle of no kind.
        """
        self.robot, self.changed = robot, changed
        self._solve, self._reach, self._pause_s = solve, reach, pause_s
        self._lock = threading.RLock()
        self._cloud = query.scene.cloud
        self._number = 0  # of the next obstacle
        self._shapes: dict[int, Shape] = {}
        self._allowed: dict[int, np.ndarray] = {}
        self._arm = query.scene.allowed and query.scene.allowed.arm
        self._read(query.scene)
        self._ends = {"start": np.asarray(query.start), "goal": np.asarray(query.goal)}
        self.rows: list[int] = []  # numbers of obstacles in the order of the scene
        self._scene = self._built(self._shapes)
        self.query = Query(self._scene, *self._ends.values())
        self.answer: Answer | None = None
        self.message = ""  # what was wrong with the last edit
        self.worker = Worker(lambda error: self.tell(f"{error!r}; the terminal has more"))

    @property
    def is_current(self) -> bool:
        """Whether the answer is that to the query."""
        return self.answer is not None and self.answer.query is self.query

    @property
    def shapes(self) -> dict[int, Shape]:
        """The obstacles by their numbers, which stay theirs."""
        return dict(self._shapes)

    def names(self) -> dict[int, str]:
        """How the planner calls the obstacles, by their numbers."""
        with self._lock:
            return {number: obstacle_name(self._scene, i) for i, number in enumerate(self.rows)}

    def plan(self) -> None:
        """Has the query planned as it is."""
        self._edited()

    def end(self, name: str) -> np.ndarray:
        """Start or goal, `[D]`."""
        return self._ends[name]

    def set_end(self, name: str, q: np.ndarray) -> None:
        """Changes start or goal."""
        with self._lock:
            self._ends[name] = np.array(q, np.float32)
        self._edited()

    def drag_end(self, name: str, position: np.ndarray, quat: np.ndarray) -> None:
        """Brings the hand of start or goal to a pose, by the valid configuration nearest to what it
        was; where there is none, it stays, and `message` says why."""
        self.worker.ask(f"reach {name}", lambda: self._drag(name, position, quat))

    def _drag(self, name: str, position: np.ndarray, quat: np.ndarray) -> None:
        near = self._ends[name]
        try:
            q = self._reach(self.query.scene, near, position, quat)
        except InputError as error:
            self.tell(str(error))
            return
        if self._ends[name] is near:  # or it was set meanwhile
            self.set_end(name, q)

    def add(self, shape: Shape) -> int:
        """Adds an obstacle; its number.

        Raises:
            InputError: see `scene_from_shapes`; nothing is changed then.
        """
        with self._lock:
            number = self._number
            self._change({**self._shapes, number: shape})
            self._number += 1
        self._edited()
        return number

    def remove(self, number: int) -> None:
        """Takes an obstacle away, if it is still there."""
        with self._lock:
            self._change({n: shape for n, shape in self._shapes.items() if n != number})
        self._edited()

    def resize(self, number: int, **sizes: Any) -> None:
        """Changes values of an obstacle by the names of `FIELDS`, if it is still there.

        Raises:
            InputError: see `scene_from_shapes`; nothing is changed then.
        """
        with self._lock:
            if number not in self._shapes:
                return
            shape = self._shapes[number]
            changed = shape._replace(values={**shape.values, **sizes})
            self._change({**self._shapes, number: changed})
        self._edited()

    def move(self, number: int, position: np.ndarray, quat: np.ndarray) -> None:
        """Brings the frame of an obstacle (`placed`) to a pose, if it is still there.

        Raises:
            InputError: see `scene_from_shapes`; nothing is changed then.
        """
        if number not in self._shapes:
            return
        if self._shapes[number].kind == "half_space":
            normal = z_axis(np.asarray(quat) / np.linalg.norm(quat))
            self.resize(number, point=np.asarray(position), normal=normal)
        elif "quat" in FIELDS[self._shapes[number].kind]:
            self.resize(number, center=np.asarray(position), quat=np.asarray(quat))
        else:
            self.resize(number, center=np.asarray(position))

    def _read(self, scene: Scene) -> None:
        """Takes the obstacles of a scene over."""
        kinds = known_kinds(scene.half_extents, scene.radii, scene.mask)
        for i in np.flatnonzero(scene.mask).tolist():
            row = Sums(*(np.asarray(x[i], float) for x in scene[:4]))
            kind = KINDS[kinds[i]]
            values = described(kind, row)
            numbers = {n: x[0] if FIELDS[kind][n] == 1 else x for n, x in values.items()}
            self._shapes[self._number] = Shape(kind, numbers)
            if scene.allowed is not None:
                self._allowed[self._number] = np.asarray(scene.allowed.pairs[i])
            self._number += 1

    def _change(self, shapes: dict[int, Shape]) -> None:
        self._scene = self._built(shapes)
        self._shapes = shapes

    def _built(self, shapes: dict[int, Shape]) -> Scene:
        scene = scene_from_shapes(list(shapes.values()))._replace(cloud=self._cloud)
        self.rows = sorted(shapes, key=lambda number: KINDS.index(shapes[number].kind))
        if self._arm is None:
            return scene
        pairs = np.zeros((len(scene.mask), len(self.robot.bodies)), bool)
        for i, number in enumerate(self.rows):
            pairs[i] = self._allowed.get(number, False)
        return scene._replace(allowed=Allowed(pairs, self._arm))

    def _edited(self) -> None:
        with self._lock:
            self.query, self.message = Query(self._scene, *self._ends.values()), ""
        self.worker.ask("plan", self._plan, self._pause_s)
        self.changed()

    def _plan(self) -> None:
        query = self.query
        try:
            self._take_answer(self._solve(query))
        except Exception as error:
            self._take_answer(without_path(query, None, f"planning failed: {error!r}"))
            raise

    def _take_answer(self, answer: Answer) -> None:
        with self._lock:
            if answer.query is not self.query:
                return  # what is newer waits already
            self.answer = answer
        self.changed()

    def tell(self, message: str) -> None:
        """Shows a message until the next edit."""
        self.message = message
        self.changed()


def placed(shape: Shape) -> tuple[np.ndarray, np.ndarray]:
    """Position `[3]` (m) and quaternion `[4]` of an obstacle's frame: of a half-space that of the
    point which describes it, with z out of it."""
    sums = sums_of(shape.kind, _arrays(shape))
    position = shape.values["point"] if shape.kind == "half_space" else sums.centers
    return np.asarray(position, float), np.asarray(sums.quats, float)


def sizes_of(shape: Shape) -> Sums:
    """An obstacle as a sum of box, disc and ball."""
    return sums_of(shape.kind, _arrays(shape))


def _arrays(shape: Shape) -> dict[str, np.ndarray]:
    values = {name: np.atleast_1d(np.asarray(x, float)) for name, x in shape.values.items()}
    if "quat" in values:
        values["quat"] = values["quat"] / np.linalg.norm(values["quat"])
    return values
