"""The arms in assets/ as their manufacturers publish them (sources in the MJCF headers), written
down a second time, so that a slip in an MJCF shows."""

import dataclasses
from pathlib import Path

import mujoco
import numpy as np

ROOT = Path(__file__).parents[1]
HALF_TURN = np.pi
QUARTER = np.pi / 2


@dataclasses.dataclass(frozen=True)
class Link:
    name: str
    pos: tuple[float, float, float]
    turn: tuple[float, ...]  # w x y z, not normalized, or roll pitch yaw about fixed axes
    mass: float
    com: tuple[float, float, float]
    inertia: tuple[float, ...]  # xx yy zz, or xx yy zz xy xz yz
    limit: float | tuple[float, float] = 0.0  # rad, either way or each; 0 has no joint
    velocity: float = 0.0  # rad/s
    torque: float = 0.0  # N m
    opens: tuple[float, float] | None = None  # m; how far a finger slides along its y axis
    parent: str = ""  # if it is not the link before
    hull: str = ""  # if it is not called as the link


# fmt: off
KUKA = (
    Link("link_0", (0, 0, 0), (1, 0, 0, 0), 5, (-0.1, 0, 0.07), (0.05, 0.06, 0.03)),
    Link("link_1", (0, 0, 0.1575), (1, 0, 0, 0), 5.76, (0, -0.03, 0.12),
         (0.0333, 0.033, 0.0123), 2.96706, 1.4835, 320),
    Link("link_2", (0, 0, 0.2025), (0, 0, 1, 1), 6.35, (0.0003, 0.059, 0.042),
         (0.0305, 0.0304, 0.011), 2.09440, 1.4835, 320),
    Link("link_3", (0, 0.2045, 0), (0, 0, 1, 1), 3.5, (0, 0.03, 0.13),
         (0.025, 0.0238, 0.0076), 2.96706, 1.7453, 176),
    Link("link_4", (0, 0, 0.2155), (1, 1, 0, 0), 3.5, (0, 0.067, 0.034),
         (0.017, 0.0164, 0.006), 2.09440, 1.3090, 176),
    Link("link_5", (0, 0.1845, 0), (0, 0, 1, 1), 3.5, (0.0001, 0.021, 0.076),
         (0.01, 0.0087, 0.00449), 2.96706, 2.2689, 110),
    Link("link_6", (0, 0, 0.2155), (1, 1, 0, 0), 1.8, (0, 0.0006, 0.0004),
         (0.0049, 0.0047, 0.0036), 2.09440, 2.3562, 40),
    Link("link_7", (0, 0.081, 0), (0, 0, 1, 1), 1.2, (0, 0, 0.02),
         (0.001, 0.001, 0.001), 3.05433, 2.3562, 40),
)
# The manufacturer rounds the right angles of this arm to 3.1416 and 1.5708.
KINOVA = (
    Link("base_link", (0, 0, 0), (0, 0, 0), 1.697, (-0.000648, -0.000166, 0.084487),
         (0.004622, 0.004495, 0.002079)),
    Link("shoulder_link", (0, 0, 0.15643), (-HALF_TURN, 0, 0), 1.377,
         (-0.000023, -0.010364, -0.07336), (0.00457, 0.004831, 0.001409), np.pi, 1.3963, 39),
    Link("bicep_link", (0, 0.005375, -0.12838), (QUARTER, 0, 0), 1.262,
         (0.000035, -0.208207, -0.01889), (0.046752, 0.00085, 0.047188), 2.24, 1.3963, 39),
    Link("forearm_link", (0, -0.41, 0), (HALF_TURN, 0, 0), 0.930,
         (0.000018, 0.076168, -0.01397), (0.008292, 0.000628, 0.008464), 2.57, 1.3963, 39),
    Link("spherical_wrist_1_link", (0, 0.20843, -0.006375), (QUARTER, 0, 0), 0.6781,
         (-0.000001, 0.008486, -0.062937), (0.001645, 0.001666, 0.000389), np.pi, 1.2218, 9),
    Link("spherical_wrist_2_link", (0, -0.00017505, -0.10593), (-QUARTER, 0, 0), 0.678,
         (-0.000001, 0.046429, -0.008704), (0.001685, 0.0004, 0.001696), 2.09, 1.2218, 9),
    Link("bracelet_link", (0, 0.10593, -0.00017505), (QUARTER, 0, 0), 0.364,
         (-0.000093, 0.000132, -0.022905), (0.000214, 0.000223, 0.00024), np.pi, 1.2218, 9),
)
# The last three are the hand and its fingers, as far apart as they slide. Link 5 is two bodies, as
# the hull of the whole fills the hollow between forearm and wrist, where the hand may go.
PANDA = (
    Link("link_0", (0, 0, 0), (0, 0, 0), 0.629769, (-0.041018, -0.00014, 0.049974),
         (0.00315, 0.00388, 0.004285, 8.2904e-7, 0.00015, 8.2299e-6)),
    Link("link_1", (0, 0, 0.333), (0, 0, 0), 4.970684, (0.003875, 0.002081, -0.04762),
         (0.70337, 0.70661, 0.009117, -0.000139, 0.006772, 0.019169), 2.8973, 2.175, 87),
    Link("link_2", (0, 0, 0), (-QUARTER, 0, 0), 0.646926, (-0.003141, -0.02872, 0.003495),
         (0.007962, 0.02811, 0.025995, -0.003925, 0.010254, 0.000704), 1.7628, 2.175, 87),
    Link("link_3", (0, -0.316, 0), (QUARTER, 0, 0), 3.228604, (0.027518, 0.039252, -0.066502),
         (0.037242, 0.036155, 0.01083, -0.004761, -0.011396, -0.012805), 2.8973, 2.175, 87),
    Link("link_4", (0.0825, 0, 0), (QUARTER, 0, 0), 3.587895, (-0.05317, 0.104419, 0.027454),
         (0.025853, 0.019552, 0.028323, 0.007796, -0.001332, 0.008641),
         (-3.0718, -0.0698), 2.175, 87),
    Link("link_5", (-0.0825, 0.384, 0), (-QUARTER, 0, 0), 1.225946,
         (-0.011953, 0.041065, -0.038437),
         (0.035549, 0.029474, 0.008627, -0.002117, -0.004037, 0.000229), 2.8973, 2.61, 12),
    Link("link_5_wrist", (0, 0, 0), (0, 0, 0), 0, (0, 0, 0), (0, 0, 0)),
    Link("link_6", (0, 0, 0), (QUARTER, 0, 0), 1.666555, (0.060149, -0.014117, -0.010517),
         (0.001964, 0.004354, 0.005433, 0.000109, -0.001158, 0.000341),
         (-0.0175, 3.7525), 2.61, 12),
    Link("link_7", (0.088, 0, 0), (QUARTER, 0, 0), 0.735522, (0.010517, -0.004252, 0.061597),
         (0.012516, 0.010027, 0.004815, -0.000428, -0.001196, -0.000741), 2.8973, 2.61, 12),
    Link("hand", (0, 0, 0.107), (0, 0, -np.pi / 4), 0.73, (-0.01, 0, 0.03),
         (0.001, 0.0025, 0.0017)),
    Link("left_finger", (0, 0, 0.0584), (0, 0, 0), 0.015, (0, 0, 0), (2.375e-6, 2.375e-6, 7.5e-7),
         opens=(0, 0.065), hull="finger"),
    Link("right_finger", (0, 0, 0.0584), (0, 0, np.pi), 0.015, (0, 0, 0),
         (2.375e-6, 2.375e-6, 7.5e-7), opens=(0, 0.065), parent="hand", hull="finger"),
)
# fmt: on
ARMS = {"kuka_iiwa14": KUKA, "kinova_gen3": KINOVA, "franka_panda": PANDA}
# Tool frames: link, position and turn in it.
TOOLS = {
    "kuka_iiwa14": ("link_7", (0, 0, 0.045), (1, 0, 0, 0)),
    "kinova_gen3": ("bracelet_link", (0, 0, -0.061525), (HALF_TURN, 0, HALF_TURN)),
    "franka_panda": ("hand", (0, 0, 0.1034), (1, 0, 0, 0)),
}
OPENINGS = (0.0, 0.04, 0.065)  # m, of each finger


def rotation(turn):
    """Matrix of a quaternion (4 numbers) or of roll, pitch and yaw about fixed axes (3)."""
    if len(turn) == 4:
        w, x, y, z = np.asarray(turn) / np.linalg.norm(turn)
        return np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
    (cr, cp, cy), (sr, sp, sy) = np.cos(turn), np.sin(turn)
    roll = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    pitch = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    yaw = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return yaw @ pitch @ roll


def excluded_pairs(model):
    return {
        tuple(sorted((signature >> 16, signature & 0xFFFF)))
        for signature in model.exclude_signature.tolist()
    }


def kept_pairs(model, links):
    """Names of the links that MuJoCo checks against each other."""
    excluded = excluded_pairs(model)
    return [
        (a.name, b.name)
        for i, a in enumerate(links)
        for b in links[i + 1 :]
        if (model.body(a.name).id, model.body(b.name).id) not in excluded
    ]


def hull_distance(model, data, pair):
    """Of the hulls at the configuration in `data`; negative where they overlap."""
    first, second = (model.geom(name).id for name in pair)
    return mujoco.mj_geomDistance(model, data, first, second, 1.0, None)


def place(model, data, q):
    data.qpos[:] = q
    mujoco.mj_kinematics(model, data)
