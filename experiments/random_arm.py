"""Arms drawn at random, with everything in their MJCF that could be misread.

A base that is turned and lifted, one or two joints a body, hinges and slides, skew axes, anchors
off the origin, references, spheres and capsules, explicit contact pairs and exclusions.
"""

from pathlib import Path

import mujoco
import numpy as np

BASE = "base"  # the body that obstacles are placed on


def random_arm(rng: np.random.Generator, num_links: int = 4) -> str:
    """The MJCF of an arm, which may be in self-collision everywhere: the caller finds out.

    Args:
        rng: randomness.
        num_links: bodies that joints move, one hanging from the other.
    """
    joints = [1 + (rng.random() < 0.25) for _ in range(num_links)]
    links = [_link(rng, i, joints[i]) for i in range(num_links)]
    chain = "".join(links) + "</body>" * num_links
    pairs = [f'<exclude body1="link_{i}" body2="link_{i + 1}"/>' for i in range(num_links - 1)]
    if rng.random() < 0.5:
        first, second = rng.choice(num_links, 2, replace=False)
        pairs.append(f'<pair geom1="geom_{first}" geom2="geom_{second}"/>')
    return f"""<mujoco>
<compiler angle="radian" autolimits="true"/>
<default><geom contype="1" conaffinity="1" mass="1"/></default>
<worldbody><body name="{BASE}" pos="{_numbers(rng.uniform(-1, 1, 3))}" quat="{_quat(rng)}">
<geom type="sphere" size="0.05"/>{chain}</body></worldbody>
<contact>{"".join(pairs)}</contact></mujoco>
"""


def _link(rng: np.random.Generator, number: int, num_joints: int) -> str:
    lengths = rng.uniform(0.1, 0.25)
    position = rng.normal(size=3) * 0.05 + [0, 0, 0.12 + lengths]
    joints = "".join(_joint(rng) for _ in range(num_joints))
    size = rng.uniform(0.025, 0.05)
    if rng.random() < 0.5:
        geom = f'type="sphere" pos="{_numbers(rng.normal(size=3) * 0.03)}" size="{size:.4f}"'
    else:
        ends = np.concatenate([rng.normal(size=3) * 0.03, rng.normal(size=3) * 0.03 + [0, 0, 0.1]])
        geom = f'type="capsule" fromto="{_numbers(ends)}" size="{size:.4f}"'
    return (
        f'<body name="link_{number}" pos="{_numbers(position)}" quat="{_quat(rng, 0.4)}">{joints}'
        f'<geom name="geom_{number}" {geom}/>'
    )


def _joint(rng: np.random.Generator) -> str:
    axis, anchor = _numbers(rng.normal(size=3)), _numbers(rng.normal(size=3) * 0.04)
    if rng.random() < 0.2:
        lower, upper = rng.uniform(-0.3, -0.1), rng.uniform(0.1, 0.3)
        kind = "slide"
    else:
        lower, upper = rng.uniform(-3, -1), rng.uniform(1, 3)
        kind = "hinge"
    reference = rng.uniform(lower, upper) if rng.random() < 0.3 else 0.0
    return (
        f'<joint type="{kind}" axis="{axis}" pos="{anchor}" range="{lower:.4f} {upper:.4f}" '
        f'ref="{reference:.4f}"/>'
    )


def _numbers(values: np.ndarray) -> str:
    return " ".join(f"{x:.5f}" for x in values)


def _quat(rng: np.random.Generator, spread: float = 1.0) -> str:
    """A rotation: any, or one within about `spread` of none."""
    return _numbers(np.array([1 - spread, 0, 0, 0]) + spread * rng.normal(size=4) / 2)


def distorted_arm(rng: np.random.Generator, path: Path) -> str:
    """The MJCF of an arm whose links are put together slightly otherwise than in a file."""
    spec = mujoco.MjSpec.from_file(str(path))
    spec.meshdir = str((path.parent / spec.meshdir).resolve())
    for body in spec.bodies[1:]:
        body.pos = body.pos * rng.uniform(0.9, 1.1, 3)
        turn = np.append(1.0, rng.normal(size=3) * 0.05)
        turned = np.zeros(4)
        mujoco.mju_mulQuat(turned, np.asarray(body.quat, float), turn / np.linalg.norm(turn))
        body.quat = turned
    for joint in spec.joints:
        joint.axis = joint.axis + rng.normal(size=3) * 0.05
    spec.compile()
    return spec.to_xml()
