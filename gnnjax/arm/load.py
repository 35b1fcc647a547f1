"""What an arm holds, in full: as much as `attach` needs to do it again, and as files have it."""

import hashlib
import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np

_Numbers: TypeAlias = tuple[float, ...]
_ITEM = {"position": 3, "quat": 4, "size": 3}  # of a shape, beside its kind: how many numbers


class Load(NamedTuple):
    """What one body holds. It can be hashed, and the same things held are equal."""

    body: str
    # Kind; position (m) and quaternion w x y z in the body's frame; size (m) as MuJoCo has it.
    items: tuple[tuple[str, _Numbers, _Numbers, _Numbers], ...]
    mass: float | None  # kg; None where it weighs nothing
    allow: tuple[str, ...]  # bodies that it may touch, sorted

    def digest(self, name: str) -> str:
        """What tells arms apart that were called `name` before they held something."""
        key = hashlib.sha256(repr((name, self.body, self.mass, self.allow)).encode())
        for kind, *numbers in self.items:
            key.update(kind.encode() + b"".join(np.array(x, float).tobytes() for x in numbers))
        return key.hexdigest()[:8]

    def name_of(self, name: str) -> str:
        """How the arm is called that holds this, and was called `name` before."""
        return f"{name}_holding_{self.digest(name)}"

    def body_name(self, name: str) -> str:
        """How the body is called that is what an arm holds that was called `name` before."""
        return f"held_{self.digest(name)}"

    def as_json(self) -> dict[str, Any]:
        """In words, lists and numbers, from which `load_from_json` makes the same."""
        items = [dict(zip(("kind", *_ITEM), item, strict=True)) for item in self.items]
        return {**self._asdict(), "items": items}


def names_with(name: str, loads: Sequence[Load]) -> list[str]:
    """How an arm of some name is called without any of the loads, with the first of them, and so
    on."""
    return [*itertools.accumulate(loads, lambda so_far, load: load.name_of(so_far), initial=name)]


def held_names(name: str, loads: Sequence[Load]) -> list[str]:
    """How the bodies are called that are what an arm holds, of some name without them."""
    before = names_with(name, loads)[:-1]
    return [load.body_name(each) for load, each in zip(loads, before, strict=True)]


def load_from_json(data: Any) -> Load:
    """What `Load.as_json` wrote.

    Raises:
        AttributeError, KeyError, OverflowError, TypeError or ValueError: it is something else.
    """
    body, mass, allow = data["body"], data["mass"], data["allow"]
    if not isinstance(body, str) or not all(isinstance(name, str) for name in allow):
        raise ValueError("what is held has no body, or allows what is no name")
    items = []
    for item in data["items"]:
        numbers = [np.asarray(item[field], float) for field in _ITEM]
        if [x.shape for x in numbers] != [(length,) for length in _ITEM.values()]:
            raise ValueError(f"a {item['kind']} that is held lacks numbers")
        items.append((str(item["kind"]), *(tuple(x.tolist()) for x in numbers)))
    return Load(body, tuple(items), None if mass is None else float(mass), tuple(allow))
