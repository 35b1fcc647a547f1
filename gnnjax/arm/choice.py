"""What was chosen of an arm's file, in full: as much as loading it again needs, and as files have
it."""

import hashlib
import math
from typing import Any, NamedTuple


class ArmChoice(NamedTuple):
    """Joints and contacts of an arm that are not as its file alone has them. It can be hashed, and
    choices of the same arm are equal."""

    joints: tuple[str, ...]  # that are planned for
    hold: tuple[tuple[str, float], ...]  # the other hinges and slides, by name: rad or m
    allow: tuple[tuple[str, str], ...]  # pairs of bodies that may touch, sorted

    def name_of(self, name: str) -> str:
        """How the arm is called whose file is called `name`."""
        digest = hashlib.sha256(repr((name, *self)).encode()).hexdigest()[:8]
        return f"{name}_chosen_{digest}"

    def arguments(self) -> dict[str, Any]:
        """Of `load_robot`, which makes the same arm again."""
        return {**self._asdict(), "hold": dict(self.hold)}

    def as_json(self) -> dict[str, Any]:
        """In words, lists and numbers, from which `choice_from_json` makes the same."""
        return self.arguments()

    def __str__(self) -> str:
        """For people to read."""
        held = ", ".join(f"{name} at {value:.4g}" for name, value in self.hold)
        may = ", ".join(f"{a} and {b}" for a, b in self.allow)
        said = [f"planned for: {', '.join(self.joints)}"]
        said += [f"held: {held}"] * bool(held) + [f"may touch: {may}"] * bool(may)
        return "; ".join(said)


def choice_from_json(data: Any) -> ArmChoice:
    """What `ArmChoice.as_json` wrote.

    Raises:
        AttributeError, KeyError, OverflowError, TypeError or ValueError: it is something else.
    """
    joints, allow = tuple(data["joints"]), tuple((a, b) for a, b in data["allow"])
    hold = tuple(sorted((name, float(value)) for name, value in data["hold"].items()))
    names = [*joints, *(name for two in allow for name in two)]
    if not joints or not all(isinstance(name, str) for name in names):
        raise ValueError("joints and bodies that were chosen are no names")
    if not all(math.isfinite(value) for _, value in hold):
        raise ValueError("a joint is held at no number")
    return ArmChoice(joints, hold, allow)
