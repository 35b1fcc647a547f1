"""A page in the browser: a session, and what shows it."""

import dataclasses

import numpy as np
import viser

from gnnjax.arm.robot import Robot
from gnnjax.arm_options import HoldingOptions, load_arm
from gnnjax.errors import InputError
from gnnjax.planning.planner import Planner
from gnnjax.pose.goal import PoseGoal
from gnnjax.pose.inverse import prepare
from gnnjax.viewer.answers import Query, make_reach, make_solver
from gnnjax.viewer.frames import Frames
from gnnjax.viewer.panel import Panel
from gnnjax.viewer.prices import make_pricer
from gnnjax.viewer.saving import query_text
from gnnjax.viewer.session import Session

_FROM = np.array([1.2, -0.55, 0.12])  # where cameras begin, from the middle, in the arm's extents
_PREPARE_S = 1.0  # after the first query


class Page:
    """A server of the page, and all that works for it; `close` ends it."""

    def __init__(self, planner: Planner, query: Query, pose: PoseGoal, config):
        """Args:
        planner: of the arm.
        query: to begin with.
        pose: whose frame, free axes and tolerance count, where the hand is dragged.
        config: `ViewConfig`: host and port, options of motions, what a saved query names.

        Raises:
            InputError: options that do not fit the arm.
        """
        robot = planner.robot
        frames = Frames(robot, pose.frame)
        solve = make_solver(planner, config, config.seed)
        price, why_not = None, ""
        try:
            price = make_pricer(planner, frames, config.seed)
        except InputError as error:
            why_not = str(error)
        reach = make_reach(robot, pose, planner.options.margin)
        self.server = viser.ViserServer(config.host, config.port, label="gnnjax", verbose=False)
        self.session = Session(robot, query, solve, reach)
        self._look(robot)
        self.panel = Panel(
            self.server,
            self.session,
            frames,
            lambda: self._query_text(config),
            price,
            why_not,
        )
        self.session.plan()
        # So that the first drag of a hand need not wait for it.
        self.session.worker.ask("prepare", lambda: prepare(robot, pose.frame), _PREPARE_S)

    @property
    def port(self) -> int:
        """Where the page is."""
        return self.server.get_port()

    def close(self) -> None:
        """Ends the server and all threads."""
        self.panel.close()
        self.server.stop()

    def _query_text(self, config) -> str:
        if load_arm(config, config.torque).name != self.session.robot.name:
            raise InputError(
                "the arm holds what its --request has attached, and the query would not name it; "
                "save the scene alone, and keep the request"
            )
        names = [*(field.name for field in dataclasses.fields(HoldingOptions)), "seed"]
        others = {name: getattr(config, name) or None for name in names}
        return query_text(self.session, config, **others)

    def _look(self, robot: Robot) -> None:
        stat = robot.mj_model.stat
        camera = self.server.initial_camera
        camera.look_at = stat.center
        camera.position = stat.center + stat.extent * _FROM
