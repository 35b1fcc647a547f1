"""The arm and its obstacles as one MuJoCo model, for MJX, the C engine and pictures."""

import mujoco
import numpy as np

from gnnjax.robot import Robot
from gnnjax.scene import Scene

# Where boxes that do not exist are put: far enough to be clear, near enough for float32.
FAR_AWAY = 1e3


def build_world(robot: Robot, max_boxes: int) -> mujoco.MjModel:
    """Compiles the arm with `max_boxes` movable boxes, called `box_0`, `box_1`, ...

    Each box is a mocap body of its own. A geom that sits in the worldbody and is moved after
    compilation would keep the bounding volume of its old place, and the C engine would miss it.
    """
    spec = mujoco.MjSpec.from_file(str(robot.path))
    ignored = _static_bodies(spec)
    for i in range(max_boxes):
        body = spec.worldbody.add_body(name=f"box_{i}", mocap=True, pos=[FAR_AWAY, 0, i])
        # All bits: an obstacle meets whatever collision group a robot's author chose.
        body.add_geom(
            name=f"box_{i}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=[0.1, 0.1, 0.1],
            contype=0x7FFFFFFF,
            conaffinity=0x7FFFFFFF,
            rgba=[0.75, 0.55, 0.35, 1.0],
        )
        # MuJoCo pairs a mocap body with static bodies, and MJX also with other mocap bodies; none
        # of that says anything about a configuration.
        for name in ignored:
            spec.add_exclude(bodyname1=name, bodyname2=body.name)
        ignored.append(body.name)
    return spec.compile()


def _static_bodies(spec: mujoco.MjSpec) -> list[str]:
    """Names of the world and the bodies welded to it; bodies without a name get one."""
    names, bodies = [], [spec.worldbody]
    while bodies:
        body = bodies.pop()
        if not body.name:
            body.name = f"static_{len(names)}"
        names.append(body.name)
        bodies += [child for child in body.bodies if not child.joints]
    return names


def place_boxes(model: mujoco.MjModel, data: mujoco.MjData, scene: Scene) -> None:
    """Moves the boxes of a world to a scene's places and sizes, in place."""
    mask = np.asarray(scene.mask)
    for i in range(len(mask)):
        body = model.body(f"box_{i}").id
        geom = model.geom(f"box_{i}").id
        mocap = model.body_mocapid[body]
        exists = bool(mask[i])
        data.mocap_pos[mocap] = np.asarray(scene.centers[i]) if exists else [FAR_AWAY, 0, i]
        data.mocap_quat[mocap] = np.asarray(scene.quats[i]) if exists else [1, 0, 0, 0]
        if exists:
            size = np.asarray(scene.half_extents[i], dtype=float)
            model.geom_size[geom] = size
            model.geom_rbound[geom] = np.linalg.norm(size)
            model.geom_aabb[geom, 3:] = size
            node = model.body_bvhadr[body]
            model.bvh_aabb[node, 3:] = size
