"""A query that viewers show, and their sessions."""

import numpy as np

from gnnjax.scene.scene import scene_from_shapes
from gnnjax.scene.shapes import box, capsule, cylinder, half_space, sphere
from gnnjax.viewer.answers import Answer, Query
from gnnjax.viewer.session import Session

START, GOAL = np.float32([-1.0, 0.2, 0.1]), np.float32([1.0, 0.2, -0.1])


TURNED = [0.8, 0.6, 0.0, 0.0]


SHAPES = [
    box([0.6, 0.4, 0], [0.1, 0.2, 0.3], TURNED),
    sphere([0, 0.8, 0], 0.1),
    capsule([0, -0.8, 0], 0.05, 0.1, TURNED),
    cylinder([-0.8, 0, 0], 0.1, 0.15, TURNED),
    half_space([0, 0.1, -1.5], [0, 0.6, 0.8]),
]


SCENE = scene_from_shapes(SHAPES)


TIMEOUT = 60.0


def session_of(robot, scene=SCENE, solve=None, reach=None, **how):
    def nothing(query):
        return Answer(query, None, "nothing", np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3)))

    query = Query(scene, START, GOAL)
    return Session(robot, query, solve or nothing, reach or nothing, pause_s=0.0, **how)
