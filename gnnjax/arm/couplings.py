"""Joints of a model that do not move by themselves: what follows, what is tied, what is pulled."""

from typing import NamedTuple

import mujoco
import numpy as np

_EQ_JOINT = int(mujoco.mjtEq.mjEQ_JOINT)
_EQ_TENDON = int(mujoco.mjtEq.mjEQ_TENDON)
_LOOPS = (int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD))
_WRAP_JOINT = int(mujoco.mjtWrap.mjWRAP_JOINT)
_TRN_TENDON = int(mujoco.mjtTrn.mjTRN_TENDON)


class Couplings(NamedTuple):
    """The couplings of a model, by ids of joints."""

    drivers: dict[int, tuple[int, np.ndarray]]  # of each follower (-1: it is fixed); polynomial
    ties: list[set[int]]  # by equalities of tendons, and by those of bodies that close a loop
    pulled: list[set[int]]  # by one motor, through a tendon

    @property
    def joints(self) -> set[int]:
        """All that are coupled."""
        followed = {j for follower, (j, _) in self.drivers.items() for j in (follower, j)}
        return set().union(followed, *self.ties, *self.pulled) - {-1}


def find_couplings(model: mujoco.MjModel) -> Couplings:
    """What couples the joints of a model."""
    drivers: dict[int, tuple[int, np.ndarray]] = {}
    ties = []
    for e in np.flatnonzero(model.eq_active0).tolist():
        first, second = int(model.eq_obj1id[e]), int(model.eq_obj2id[e])
        kind = int(model.eq_type[e])
        if kind == _EQ_JOINT:
            drivers[first] = second, model.eq_data[e, :5].copy()
        elif kind == _EQ_TENDON:
            ties.append(set().union(*(joints_of(model, t) for t in {first, second} - {-1})))
        elif kind in _LOOPS:
            ties.append(_loop(model, e))
    pulled = [
        joints_of(model, int(model.actuator_trnid[a, 0]))
        for a in range(model.nu)
        if int(model.actuator_trntype[a]) == _TRN_TENDON
    ]
    return Couplings(drivers, ties, pulled)


def joints_of(model: mujoco.MjModel, tendon: int) -> set[int]:
    """The joints whose values a tendon adds up; none where it runs through space."""
    first = int(model.tendon_adr[tendon])
    wraps = range(first, first + int(model.tendon_num[tendon]))
    return {int(model.wrap_objid[w]) for w in wraps if int(model.wrap_type[w]) == _WRAP_JOINT}


def _loop(model: mujoco.MjModel, e: int) -> set[int]:
    """The joints between two bodies that an equality ties together; none where one of them is
    fixed to the world, or carried by hand (mocap), which ties the arm and not its gripper."""
    ends = [int(model.eq_obj1id[e]), int(model.eq_obj2id[e])]
    if int(model.eq_objtype[e]) == int(mujoco.mjtObj.mjOBJ_SITE):
        ends = [int(model.site_bodyid[s]) for s in ends]
    chains = []
    for body in ends:
        chain = set()
        carrier = int(model.body_weldid[body])
        if not carrier or model.body_mocapid[carrier] >= 0:
            return set()
        while body:
            first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
            chain |= set(range(first, first + count))
            body = int(model.body_parentid[body])
        chains.append(chain)
    return chains[0] ^ chains[1]
