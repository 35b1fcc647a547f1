"""Where links are and how fast, for the certificate, and for what is worked out once an arm; in
double precision, apart from the kernels.

Arrays have their components first and what they are computed for last, see `obstacles.py`.
"""

import functools
from typing import NamedTuple

import numpy as np

from gnnjax.collision.bounds import Spheres
from gnnjax.collision.obstacles import cross


class _Turns(NamedTuple):
    """What each of K joints does to the frame that it is in, where that lies in the one before
    included; a body without a joint has one that does nothing.

    The axes and the origin, `[4 3 K]`, are `still + by_sine * sin(v) + by_cosine * (1 - cos(v))`
    for a hinge at v (Rodrigues), and `still + by_sine * v` for a slide.
    """

    before: tuple[int, ...]  # the joint whose frame it is in, -1 for the world
    last: tuple[int, ...]  # of each link
    index: np.ndarray  # [K] of the joint in the configuration
    reference: np.ndarray  # [K] where bodies lie as the MJCF places them
    slides: np.ndarray  # those of the K that do not turn
    still: np.ndarray  # [3 4 K]; the components in the frame before come first
    by_sine: np.ndarray
    by_cosine: np.ndarray
    axes: np.ndarray  # [3 K 1] in the frame behind the joint; of one that does nothing 0
    anchors: np.ndarray  # [3 K 1] m


@functools.cache
def _turns_of(body: Spheres) -> _Turns:
    before, index, slides, terms, last, lines = [], [], [], [], [], []
    for link in body.robot.bodies:
        at = last[link.parent] if link.parent >= 0 else -1
        position, rotation = link.position, link.rotation
        for joint in link.joints or (None,):
            still = np.column_stack([rotation, position])
            by_sine, by_cosine = np.zeros((2, 3, 4))
            if joint is not None and joint.hinge:
                turn = rotation @ body.crosses[joint.index]
                for by, once in ((by_sine, turn), (by_cosine, turn @ body.crosses[joint.index])):
                    by[:, :3], by[:, 3] = once, -once @ joint.anchor
            elif joint is not None:
                by_sine[:, 3] = rotation @ joint.axis
                slides.append(len(before))
            terms.append((still, by_sine, by_cosine))
            lines.append(np.zeros((2, 3)) if joint is None else (joint.axis, joint.anchor))
            before.append(at)
            index.append(0 if joint is None else joint.index)
            at = len(before) - 1
            position, rotation = np.zeros(3), np.eye(3)
        last.append(at)
    still, by_sine, by_cosine = (np.stack(x, axis=-1) for x in zip(*terms, strict=True))
    links = tuple(last[number] if number >= 0 else -1 for number in body.links.tolist())
    reference = body.robot.mj_model.qpos0[index]
    own = np.array(index), reference, np.array(slides, int)
    axes, anchors = np.moveaxis(np.array(lines), 0, 2)[..., None]
    return _Turns(tuple(before), links, *own, still, by_sine, by_cosine, axes, anchors)


def joint_frames(body: Spheres, q: np.ndarray) -> np.ndarray:
    """The axes and the origin of the frame behind each joint at q `[D, B]`, `[4, 3, K + 1, B]`;
    the world's come last."""
    turns = _turns_of(body)
    value = q[turns.index] - turns.reference[:, None]
    sine, cosine = np.sin(value), 1 - np.cos(value)
    sine[turns.slides] = value[turns.slides]
    own = turns.by_sine[..., None] * sine
    own += turns.by_cosine[..., None] * cosine
    own += turns.still[..., None]  # [3 4 K B]
    # A column more, for the world, which -1 finds: nothing is before it.
    frames = np.empty((4, 3, len(turns.before) + 1, q.shape[1]))
    frames[..., -1, :] = _WORLD
    products = np.empty((3, *frames[:, :, 0].shape))
    for number, before in enumerate(turns.before):
        frame, parent = frames[:, :, number], frames[:, :, before]
        np.multiply(parent[:3, None], own[:, :, None, number], out=products)
        np.add.reduce(products, axis=0, out=frame)
        frame[3] += parent[3]
    return frames


def of_links(body: Spheres, frames: np.ndarray) -> np.ndarray:
    """What belongs to joints `[..., K + 1, B]` by link, `[..., L, B]`."""
    return frames.take(_turns_of(body).last, axis=-2)


def link_twists(body: Spheres, frames: np.ndarray, way: np.ndarray) -> np.ndarray:
    """How links turn (rad) and move (m; whatever of them is at the world's origin) where joints
    move at rates `way` `[D, B]`, `[2, 3, L, B]`: their point p has the velocity turn x p + move.

    Args:
        body: the arm.
        frames: its `joint_frames`.
        way: rad or m, in whatever unit of time.
    """
    turns = _turns_of(body)
    behind = frames[:, :, :-1]
    twists = np.zeros((2, *frames.shape[1:]))
    turning = twists[0, :, :-1] = _along(behind, turns.axes) * way[turns.index]
    twists[1, :, :-1] = cross(place(behind, turns.anchors), turning)
    twists[1, :, turns.slides] = turning[:, turns.slides].swapaxes(0, 1)
    twists[0, :, turns.slides] = 0
    for number, before in enumerate(turns.before):
        twists[:, :, number] += twists[:, :, before]
    return of_links(body, twists)


def _along(axes: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Points `[3, ...]`, given by components `[3, ...]` along axes `[3, 3, ...]`."""
    return axes[0] * point[0] + axes[1] * point[1] + axes[2] * point[2]


def place(frames: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Points in the world, of points in frames `[4, 3, ...]`."""
    return frames[3] + _along(frames, point)


def pick(array: np.ndarray, row: np.ndarray, column: np.ndarray) -> np.ndarray:
    """Of an array `[..., L, B]` the places (row, column), `[..., N]`."""
    *rest, rows, columns = array.shape
    return array.reshape(*rest, rows * columns).take(row * columns + column, axis=-1)


_WORLD = np.concatenate([np.eye(3), np.zeros((1, 3))])[..., None]
