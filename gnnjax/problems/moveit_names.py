"""Which joint or body of an arm it is that MoveIt calls so."""

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import TypeAlias

from gnnjax.arm.robot import Robot
from gnnjax.errors import InputError

Prefix: TypeAlias = tuple[str, str]  # of MoveIt's names and of the arm's; one of them is empty
_NO_PREFIX = ("", "")


def matched_joints(
    robot: Robot, others: Sequence[str], names: Mapping[str, str], called: str
) -> dict[str, str]:
    """The request's name of each of the robot's joints, in the order of a configuration."""
    own, bodies = robot.joint_names, _bodies(robot)
    if unknown := sorted(names.keys() - {*own, *bodies}):
        raise InputError(
            f"names has {unknown}, and the joints of {robot.name} are {list(own)}, its bodies "
            f"{bodies}"
        )
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


def prefixes_of_links(mapping: Mapping[str, str]) -> set[Prefix]:
    """What may stand before the names of links beside those of bodies.

    That is nothing, and what all joints of one side have before the names of the other, or else
    what the names of all joints begin with: where these are `left_joint1` both here and there,
    `left_hand` may be `hand`.

    Args:
        mapping: MoveIt's name of each of the arm's joints.
    """
    alone = {prefix_of(own, other) for own, other in mapping.items()}
    if len(alone) == 1 and any(only := alone.pop() or _NO_PREFIX):
        return {_NO_PREFIX, only}
    return prefixes_of_all(mapping, mapping.values())


def prefixes_of_all(own: Iterable[str], others: Iterable[str]) -> set[Prefix]:
    """What the names of all of an arm's joints begin with, and all of MoveIt's, each alone; and
    nothing."""
    ours, theirs = ([{_plain(x) for x, _ in _parted(name)} for name in y] for y in (own, others))
    found = {_NO_PREFIX}
    found |= {(start, "") for start in set.intersection(*theirs or [set()])}
    return found | {("", start) for start in set.intersection(*ours or [set()])}


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


def body_of(
    robot: Robot, link: str, prefixes: Collection[Prefix] | None, names: Mapping[str, str]
) -> str | None:
    """The body that a link is said to be, or is called like, or like it with one of these prefixes;
    None where there is none or more than one.

    Args:
        robot: the arm.
        link: its name in a message.
        prefixes: None: any.
        names: of links, by the body that they are.
    """
    bodies = _bodies(robot)
    said = [body for body in bodies if names.get(body) == link]
    exact = [body for body in bodies if body == link and body not in names]
    alike = [
        body
        for body in bodies
        if body not in names
        and (prefix := prefix_of(body, link)) is not None
        and (prefixes is None or prefix in prefixes)
    ]
    for found in (said, exact, alike):
        if found:
            return found[0] if len(found) == 1 else None
    return None


def _bodies(robot: Robot) -> list[str]:
    return [body.name for body in robot.bodies if body.name]


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
