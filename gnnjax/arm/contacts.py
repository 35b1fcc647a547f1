"""Pairs of parts that an arm need not keep apart: they always touch, or never do."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np

from gnnjax.arm.mjcf import HIDING, collision_geoms, self_pairs
from gnnjax.arm.parts import Part
from gnnjax.errors import InputError, perhaps

_HINGE = int(mujoco.mjtJoint.mjJNT_HINGE)
_SAMPLES = 2000  # configurations
_OFTEN, _NAMED = 0.5, 2  # share of them in which parts meet that likely may; how many are named


def without_bodies(
    pairs: np.ndarray,
    parts: Sequence[Part],
    bodies: Sequence[str],
    allow: Sequence[tuple[str, str]],
    path: Path,
) -> tuple[np.ndarray, tuple[tuple[str, str], ...]]:
    """Pairs `[Q 2]` of parts less those of the bodies in `allow`, which are named; and the names of
    the bodies, each two of them sorted, that this has taken pairs from.

    Raises:
        InputError: no body of that name.
    """
    known = ["world", *bodies]
    if unknown := [name for two in allow for name in two if name not in known]:
        meant = perhaps(unknown[0], known)
        raise InputError(
            f"no body {unknown[0]!r} in {str(path)!r} to allow{meant}; there are {known}"
        )
    allowed = {frozenset(two) for two in allow}
    bodies_of = [
        tuple(sorted((known[parts[a].body + 1], known[parts[b].body + 1])))
        for a, b in pairs.tolist()
    ]
    keep = [frozenset(two) not in allowed for two in bodies_of]
    gone = {(a, b) for (a, b), kept in zip(bodies_of, keep, strict=True) if not kept}
    return pairs[np.array(keep, bool)], tuple(sorted(gone))


def bearings(
    model: mujoco.MjModel, geoms: np.ndarray, pairs: np.ndarray, parts: Sequence[Part]
) -> set[tuple[int, int]]:
    """Those of `pairs` where the base and the first link meet, and never by more than 2 mm.

    MuJoCo leaves out neighbours in an arm, but not the neighbours of what is fixed to the world.
    Round parts stay paired: their covers are as they are, and know by themselves.
    """
    found, data = set(), mujoco.MjData(model)
    for a, b in pairs.tolist():
        links = [int(model.body_weldid[model.geom_bodyid[geoms[x]]]) for x in (a, b)]
        link = max(links)
        if min(links) or model.body_weldid[model.body_parentid[link]]:
            continue
        if model.body_jntnum[link] != 1 or max(len(parts[x].vertices) for x in (a, b)) < 3:
            continue
        j = int(model.body_jntadr[link])
        lower, upper = model.jnt_range[j]
        # No point of the link moves by more than 2 mm from one of these places to the next, and so
        # by more than 1 mm from the nearest.
        reach = np.linalg.norm(model.geom_pos[geoms[[a, b]]], axis=1).max()
        reach += model.geom_rbound[geoms[[a, b]]].max() + np.linalg.norm(model.jnt_pos[j])
        reach = reach if int(model.jnt_type[j]) == _HINGE else 1.0
        data.qpos[:] = model.jnt_range.mean(axis=1)
        deepest = np.inf
        for value in np.linspace(lower, upper, 2 + int((upper - lower) * reach / 2e-3)):
            data.qpos[j] = value
            mujoco.mj_kinematics(model, data)
            first, second = (int(geoms[x]) for x in (a, b))
            deepest = min(deepest, mujoco.mj_geomDistance(model, data, first, second, 0.1, None))
            if deepest < -1e-3:
                break
        else:
            found.add((a, b))
    return found


def always_touching(
    model: mujoco.MjModel,
    geoms: np.ndarray,
    pairs: np.ndarray,
    home: np.ndarray | None,
    parts: Sequence[Part],
    called: str,
    remedy: str,
) -> set[tuple[int, int]]:
    """Those of `pairs` that MuJoCo finds in contact in every one of some random configurations, or
    in the home that the model's author chose.

    Args:
        model: the arm alone.
        geoms: `[P]` geom of each part.
        pairs: `[Q 2]` of parts.
        home: `[D]` rad or m, if there is one.
        parts: of the arm.
        called: the arm, in messages.
        remedy: what else to do about others than to allow them, in messages.

    Raises:
        InputError: others are in contact in all of them.
    """
    if not len(pairs):
        return set()
    flags, memory = model.opt.disableflags, mujoco.MjData(model)
    model.opt.disableflags = flags & ~HIDING
    rng, kept = np.random.default_rng(0), {tuple(pair) for pair in pairs.tolist()}
    row = np.full(model.ngeom, -1)
    row[geoms] = np.arange(len(geoms))

    def touching(q: np.ndarray) -> set[tuple[int, int]]:
        memory.qpos[:] = q
        mujoco.mj_kinematics(model, memory)
        mujoco.mj_comPos(model, memory)
        mujoco.mj_collision(model, memory)
        contacts = memory.contact
        deep = row[contacts.geom[: memory.ncon][contacts.dist[: memory.ncon] < 0]]
        return {tuple(two) for two in np.sort(deep, axis=1).tolist()} & kept

    lower, upper = model.jnt_range.T
    samples = rng.uniform(lower, upper, (_SAMPLES, model.nq))
    try:
        found = [touching(q) for q in samples]
        always = set.intersection(*found)
        if home is not None:
            always |= touching(home)
    finally:
        model.opt.disableflags = flags
    left = [pairs_of_one - always for pairs_of_one in found]
    if all(left):
        counts = Counter(pair for one in left for pair in one).most_common()
        (a, b), most = counts[0]
        often = [pair for pair, count in counts if count >= min(most, _OFTEN * _SAMPLES)]
        named = [tuple(model.body(parts[p].body + 1).name for p in pair) for pair in often]
        named = list(dict.fromkeys(named))[:_NAMED]
        raise InputError(
            f"{called} collides with itself in all of {_SAMPLES} random configurations, "
            f"{parts[a].name} with {parts[b].name} in {most}; if they may touch, give "
            f"allow={named}{remedy}"
        )
    return always


def exclude_bodies(
    spec: mujoco.MjSpec, parts: Sequence[Part], pairs: np.ndarray, kept: np.ndarray
) -> bool:
    """Excludes from a spec the bodies of which no pair of parts is kept, so that MuJoCo's engine
    judges as planning does; whether there are any. It cannot tell parts of one body apart.

    Args:
        spec: changed in place; its bodies are those of the model that `parts` are of.
        parts: of the arm.
        pairs: `[Q 2]` of parts that MuJoCo tests.
        kept: `[K 2]` of parts that must stay clear.
    """
    bodies = np.array([part.body + 1 for part in parts])
    gone = {tuple(sorted(two)) for two in bodies[pairs].tolist()}
    gone -= {tuple(sorted(two)) for two in bodies[kept].tolist()}
    by_id = {body.id: body for body in spec.bodies}
    for two in sorted(gone):
        for number in two:
            if number and not by_id[number].name:
                by_id[number].name = f"body_{number}"
        first, second = (by_id[number].name if number else "world" for number in two)
        spec.add_exclude(bodyname1=first, bodyname2=second)
    # What is paired explicitly MuJoCo tests whatever it excludes.
    dropped = {*map(tuple, pairs.tolist())} - {*map(tuple, kept.tolist())}
    names = {frozenset(parts[p].name for p in two) for two in dropped}
    unpaired = [x for x in spec.pairs if frozenset((x.geomname1, x.geomname2)) in names]
    for pair in unpaired:
        spec.delete(pair)
    return bool(gone or unpaired)


def pair_explicitly(spec: mujoco.MjSpec, model: mujoco.MjModel, wanted: np.ndarray) -> bool:
    """Names to MuJoCo those of the wanted pairs that its filters leave out: parts of neighbours,
    and those without bits. Whether there are any.

    Args:
        spec: changed in place; it has to be compiled again.
        model: compiled from it as it is.
        wanted: `[Q 2]` geoms.
    """
    geoms = collision_geoms(model)
    tested = {tuple(two) for two in geoms[self_pairs(model, geoms)].tolist()}
    missing = [two for two in np.sort(wanted, axis=1).tolist() if tuple(two) not in tested]
    by_id = {geom.id: geom for geom in spec.geoms}
    for two in missing:
        for geom in (by_id[g] for g in two):
            geom.name = geom.name or f"geom_{geom.id}"
        first, second = (by_id[g].name for g in two)
        spec.add_pair(geomname1=first, geomname2=second)
    return bool(missing)
