"""Which joint or body of an arm it is that MoveIt calls so."""

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import TypeAlias

from gnnjax.arm.robot import Robot
from gnnjax.errors import InputError

Prefix: TypeAlias = tuple[str, str]  # of MoveIt's names and of the arm's; one of them is empty


def matched_joints(
    robot: Robot, others: Sequence[str], names: Mapping[str, str], called: str
) -> dict[str, str]:
    """The request's name of each of the robot's joints, in the order of a configuration."""
    own = robot.joint_names
    if unknown := sorted(names.keys() - set(own)):
        raise InputError(f"names has {unknown}, and the joints of {robot.name} are {list(own)}")
    found = {}
    for joint in own:
        exact = names.get(joint, joint)
        alike = [other for other in others if end_alike(joint, other)]
        if exact in others:
            found[joint] = exact
        elif joint not in names and len(alike) == 1:
            found[joint] = alike[0]
    if len(set(found.values())) < len(own):
        lacking = next((joint for joint in own if joint not in found), own[0])
        raise InputError(
            f"{called} has the goal joints {listed(others)}, none of them surely "
            f"{lacking!r} of {robot.name}, whose joints are {listed(own)}; say which is which: "
            f"names={{{lacking!r}: ...}}"
        )
    return found


def shared_prefix(mapping: Mapping[str, str]) -> Prefix | None:
    """What stands before the names of one side alone, of all of an arm's joints the same; None
    where they are called alike or nothing is shared."""
    found = {prefix_of(own, other) for own, other in mapping.items()}
    (only,) = found if len(found) == 1 else (None,)
    return only if only and any(only) else None


def prefix_of(own: str, other: str) -> Prefix | None:
    """What stands before the one or the other of two names, up to a punctuation mark, that are the
    same but for that and for punctuation; None where they are not."""
    if not _plain(own) or not _plain(other):
        return None
    if _plain(own) == _plain(other):
        return "", ""
    for start, rest in _parted(other):
        if _plain(rest) == _plain(own):
            return _plain(start), ""
    for start, rest in _parted(own):
        if _plain(rest) == _plain(other):
            return "", _plain(start)
    return None


def body_of(robot: Robot, link: str, prefixes: Iterable[Prefix] | None) -> str | None:
    """The body that is called like a link, or like it with one of these prefixes; None where there
    is none or more than one.

    Args:
        robot: the arm.
        link: its name in a message.
        prefixes: None: any.
    """
    own = [body.name for body in robot.bodies if body.name]
    if link in own:
        return link
    found = {name: prefix_of(name, link) for name in own}
    alike = [
        name
        for name, prefix in found.items()
        if prefix is not None and (prefixes is None or prefix in prefixes)
    ]
    return alike[0] if len(alike) == 1 else None


def end_alike(one: str, other: str) -> bool:
    """Whether one name is the end of the other, but for punctuation."""
    one, other = _plain(one), _plain(other)
    return bool(one and other) and (one.endswith(other) or other.endswith(one))


def listed(names: Sequence[str]) -> str:
    """Names, as many as a sentence bears."""
    return ", ".join(names[:8]) + (", ..." if len(names) > 8 else "")


def _plain(name: str) -> str:
    return re.sub(r"[^a-z0-9]", "", name.lower())


def _parted(name: str) -> Iterable[tuple[str, str]]:
    """A name in two, after each of its punctuation marks."""
    return ((name[: x.end()], name[x.end() :]) for x in re.finditer(r"[^A-Za-z0-9]+", name))
