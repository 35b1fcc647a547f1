"""Bytes, values of JSON and texts of XML, damaged at random."""

import json
import random
import re
from typing import Any

_ODD_NUMBERS = "nan inf -inf 0 -1 1e-300 1e39 1e400 99999999999999999999 2147483648 0x10".split()
_ODD_VALUES: list[Any] = [
    None, True, -1, 0, 10**400, 0.5, float("nan"), float("inf"), "", "x", "x" * 100_000,
    "\n\x1b[2J", "\ud800", "../..", "a\0b", [], [[]], [1] * 100_000, {}, {"a": {"b": []}}, 2**63,
]  # fmt: skip


class Deep:
    """Stands for brackets without end, which `json.dumps` would not write."""

    text = "[" * 100_000 + "]" * 100_000


def mutate_bytes(rng: random.Random, data: bytes) -> bytes:
    """Flips, cuts, repeats or replaces some bytes."""
    at, length = rng.randrange(len(data) + 1), rng.choice([1, 2, 8, 100])
    kind = rng.randrange(6)
    if kind == 0:
        return data[:at]
    if kind == 1:
        return data[:at] + data[at + length :]
    if kind == 2:
        return data[:at] + rng.randbytes(length) + data[at:]
    if kind == 3:
        return data[:at] + data[max(0, at - length) : at] * 3 + data[at:]
    if kind == 4:
        return rng.choice([b"", b"\0", b"\xff" * 50, b"[" * 100_000, b"PK\x03\x04" + data[40:]])
    changed = bytearray(data)
    for _ in range(rng.choice([1, 1, 3, 30])):
        if changed:
            changed[rng.randrange(len(changed))] = rng.randrange(256)
    return bytes(changed)


def mutate_json(rng: random.Random, value: Any) -> Any:
    """Replaces, removes, renames or repeats something in a value that JSON holds."""
    if isinstance(value, dict) and value and rng.random() < 0.8:
        name = rng.choice(list(value))
        kind = rng.randrange(6)
        if kind == 0:
            return {k: v for k, v in value.items() if k != name}
        if kind == 1:
            return {(k + "s" if k == name else k): v for k, v in value.items()}
        if kind == 2:
            return {**value, rng.choice(["quats", "x" * 1000, "\n", "cylinders"]): value[name]}
        return {**value, name: mutate_json(rng, value[name])}
    if isinstance(value, list) and value and rng.random() < 0.8:
        at = rng.randrange(len(value))
        kind = rng.randrange(6)
        if kind == 0:
            return value[:at] + value[at + 1 :]
        if kind == 1:
            return value[:at] + [value[at]] * rng.choice([2, 3, 100]) + value[at:]
        return [*value[:at], mutate_json(rng, value[at]), *value[at + 1 :]]
    return Deep() if rng.random() < 0.05 else rng.choice(_ODD_VALUES)


def dump(value: Any) -> bytes:
    """JSON, with surrogates, NaN and brackets without end as they come."""
    text = json.dumps(value, default=lambda deep: "DEEP")
    return text.replace('"DEEP"', Deep.text).encode()


def mutate_text(rng: random.Random, text: str) -> str:
    """Changes numbers, names, attributes or tags of XML."""
    numbers = [m.span() for m in re.finditer(r"(?<=[ \"])-?[\d.]+(?=[ \"])", text)]
    attributes = [m.span() for m in re.finditer(r' [a-z]+="[^"]*"', text)]
    tags = [m.span() for m in re.finditer(r"</?[a-z]+", text)]
    words = [m.span() for m in re.finditer(r'(?<=")[a-z]+(?=")', text)]
    # What is left of a text after other changes may have nothing of a kind.
    kind = rng.randrange(8) if all((numbers, attributes, tags, words)) else 7
    if kind <= 1:
        begin, end = rng.choice(numbers)
        return text[:begin] + rng.choice([*_ODD_NUMBERS, "", "1 2 3 4 5", "a"]) + text[end:]
    if kind == 2:
        begin, end = rng.choice(attributes)
        return text[:begin] + text[end:]
    if kind == 3:
        begin, end = rng.choice(attributes)
        other = text[slice(*rng.choice(attributes))]
        return text[:begin] + other + text[end:]
    if kind == 4:
        begin, end = rng.choice(tags)
        return (
            text[:begin] + rng.choice(["<joint", "<body", "<geom", "</body", "<mesh"]) + text[end:]
        )
    if kind == 5:
        begin, end = rng.choice(words)
        kinds = ["mesh", "plane", "box", "capsule", "free", "ball", "slide", "x" * 5000, "&#0;"]
        return text[:begin] + rng.choice(kinds) + text[end:]
    if kind == 6:
        lines = text.split("\n")
        at = rng.randrange(len(lines))
        return "\n".join(lines[:at] + lines[at + 1 :] * rng.choice([1, 2]))
    data = mutate_bytes(rng, text.encode(errors="surrogateescape"))
    return data.decode(errors="surrogateescape")
