"""What a viewer shows in space: the arm, its ghosts at start and goal, obstacles, paths, prices."""

from collections.abc import Callable, Sequence

import numpy as np
import viser

from gnnjax.arm.robot import Robot
from gnnjax.scene.shapes import Shape
from gnnjax.viewer.answers import Answer
from gnnjax.viewer.frames import Frames
from gnnjax.viewer.meshes import Piece, arm_pieces, ghost_pieces, obstacle_mesh
from gnnjax.viewer.prices import PricedRoadmap
from gnnjax.viewer.session import Session, sizes_of

COLORS = {"start": (60, 120, 220), "goal": (215, 70, 60)}
_GHOST, _SEEN = 0.3, 0.75  # opacities, of ghosts and obstacles
_OBSTACLE, _CHOSEN, _CLOUD = (204, 158, 107), (250, 200, 60), (120, 120, 125)
_PATH, _MOTION, _OLD = (30, 30, 35), (150, 60, 200), (185, 185, 190)
_BLOCKED, _DOUBTFUL, _FREE = np.array([(210, 40, 40), (240, 200, 60), (40, 160, 80)])
_AXIS = 0.12  # m, of frames


class DrawnArm:
    """An arm, or a ghost of it, at one configuration."""

    def __init__(
        self,
        server: viser.ViserServer,
        name: str,
        frames: Frames,
        pieces: Sequence[Piece],
    ):
        self._frames, self._server = frames, server
        self.root = server.scene.add_frame(name, show_axes=False)
        self.bodies: dict[int, viser.FrameHandle] = {}
        for number, piece in enumerate(pieces):
            where = f"{name}/body_{piece.body}"
            if piece.body not in self.bodies:
                self.bodies[piece.body] = server.scene.add_frame(
                    where, show_axes=False, axes_length=_AXIS, axes_radius=0.03 * _AXIS
                )
            server.scene.add_mesh_simple(
                f"{where}/piece_{number}",
                piece.mesh.vertices,
                piece.mesh.faces,
                color=tuple(round(255 * x) for x in piece.rgba[:3]),
                opacity=None if piece.rgba[3] == 1 else piece.rgba[3],
            )

    def place(self, q: np.ndarray) -> None:
        """Shows the arm at a configuration."""
        positions, quats = self._frames.bodies(q)
        with self._server.atomic():
            for body, handle in self.bodies.items():
                handle.position, handle.wxyz = positions[body], quats[body]

    def show_axes(self, shown: bool) -> None:
        """Shows the frames of the bodies."""
        for handle in self.bodies.values():
            handle.show_axes = shown


class Stage:
    """The things in space, which follow a session."""

    def __init__(
        self,
        server: viser.ViserServer,
        robot: Robot,
        frames: Frames,
        picked: Callable[[int], None],
    ):
        """Args:
        server: of the browsers.
        robot: the arm.
        frames: of it.
        picked: is told the number of an obstacle that is clicked on.
        """
        self._scene, self._frames, self._picked = server.scene, frames, picked
        self.arm = DrawnArm(server, "/arm", frames, arm_pieces(robot))
        self.ghosts = {
            name: DrawnArm(
                server,
                f"/{name}",
                frames,
                ghost_pieces(robot, (*(x / 255 for x in color), _GHOST)),
            )
            for name, color in COLORS.items()
        }
        self.obstacles: dict[int, tuple[Shape, viser.MeshHandle]] = {}
        self.paths = server.scene.add_frame("/paths", show_axes=False)
        self.path: list[viser.LineSegmentsHandle] = []
        self._answer: Answer | None = None
        self._current = False
        self.prices: list[viser.LineSegmentsHandle | viser.PointCloudHandle] = []
        self.cloud: viser.PointCloudHandle | None = None

    def show_obstacles(self, session: Session, chosen: int | None) -> None:
        """Draws the obstacles of a session, as far as they have changed."""
        shapes = session.shapes
        for number in self.obstacles.keys() - shapes.keys():
            self.obstacles.pop(number)[1].remove()
        for number, shape in shapes.items():
            known = self.obstacles.get(number)
            if known is None or known[0] is not shape:
                self.obstacles[number] = shape, self._drawn(number, shape, known)
            handle, color = self.obstacles[number][1], _CHOSEN if number == chosen else _OBSTACLE
            if tuple(handle.color) != color:  # which would be sent again
                handle.color = color

    def _drawn(
        self, number: int, shape: Shape, known: tuple[Shape, viser.MeshHandle] | None
    ) -> viser.MeshHandle:
        sums = sizes_of(shape)
        if known is not None:
            old, handle = sizes_of(known[0]), known[1]
            if all((a == b).all() for a, b in zip(old[1::2], sums[1::2], strict=True)):
                handle.position, handle.wxyz = sums.centers, sums.quats
                return handle
            handle.remove()
        mesh = obstacle_mesh(shape.kind, sums.half_extents, sums.radii)
        handle = self._scene.add_mesh_simple(
            f"/obstacles/{number}",
            mesh.vertices,
            mesh.faces,
            color=_OBSTACLE,
            opacity=_SEEN,
            side="double" if shape.kind == "half_space" else "front",
            position=sums.centers,
            wxyz=sums.quats,
        )
        handle.on_click(lambda event: self._picked(number))
        return handle

    def show_cloud(self, session: Session) -> None:
        """Draws the cloud of a scene, which is not edited."""
        cloud = session.query.scene.cloud
        if cloud is None or not int(cloud.num):
            return
        self.cloud = self._scene.add_point_cloud(
            "/obstacles/cloud",
            np.asarray(cloud.points)[: int(cloud.num)],
            _CLOUD,
            point_size=2 * float(cloud.radius),
            point_shape="circle",
            precision="float32",
        )

    def show_path(self, answer: Answer | None, current: bool) -> None:
        """Draws where the hand goes along the path, and along the motion; grey once the query has
        changed."""
        if answer is self._answer and current == self._current:
            return
        self._current = current
        if answer is not self._answer:
            for line in self.path:
                line.remove()
            self.path, self._answer = [], answer
            if answer is not None and len(answer.times) > 1:
                path = self._frames.tips(_along(answer.path))
                motion = self._frames.tips(answer.positions)
                self.path = [self._line("path", path, 0.004), self._line("motion", motion, 0.008)]
        for line, color in zip(self.path, (_PATH, _MOTION), strict=False):
            line.colors = np.array(color if current else _OLD, np.uint8)

    def _line(self, name: str, points: np.ndarray, thickness: float) -> viser.LineSegmentsHandle:
        segments = np.stack([points[:-1], points[1:]], axis=1)
        return self._scene.add_line_segments(f"/paths/{name}", segments, _OLD, thickness=thickness)

    def show_prices(self, priced: PricedRoadmap | None, least: float = 0.0) -> None:
        """Draws a roadmap's edges, from red (surely blocked) to green (surely free).

        Args:
            priced: the roadmap; None takes it away.
            least: probability of being free; edges with less are left out.
        """
        for handle in self.prices:
            handle.remove()
        self.prices = []
        if priced is None:
            return
        likely = np.exp(-priced.prices) >= least
        lines = priced.lines[likely]
        segments = np.stack([lines[:, :-1], lines[:, 1:]], axis=2)
        colors = np.broadcast_to(price_colors(priced.prices[likely])[:, None, None], segments.shape)
        segments, colors = segments.reshape(-1, 2, 3), colors.reshape(-1, 2, 3)
        self.prices = [
            self._scene.add_line_segments("/roadmap/edges", segments, colors, thickness=0.002),
            self._scene.add_point_cloud(
                "/roadmap/nodes", priced.nodes, _PATH, point_size=0.012, point_shape="circle"
            ),
        ]


def price_colors(prices: np.ndarray) -> np.ndarray:
    """Colours `[E 3]` of prices `[E]`, nats: red where free is unlikely, green where it is not."""
    free = np.exp(-np.asarray(prices, float))[:, None]
    low, high = 2 * free, 2 * free - 1
    below = _BLOCKED + low * (_DOUBTFUL - _BLOCKED)
    above = _DOUBTFUL + high * (_FREE - _DOUBTFUL)
    return np.where(free < 0.5, below, above).round().astype(np.uint8)


def _along(path: np.ndarray) -> np.ndarray:
    """A path's configurations, and others between them at most 0.05 rad apart."""
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    counts = np.maximum(np.ceil(steps / 0.05), 1).astype(int)
    pieces = [
        first + np.arange(count)[:, None] / count * (second - first)
        for first, second, count in zip(path[:-1], path[1:], counts, strict=True)
    ]
    return np.concatenate([*pieces, path[-1:]])
