"""Operations of compiled collision programs, counted in their HLO.

Sums, products, comparisons, selections, roots, sines and so on count as one each.
"""

import math
import re
from collections import Counter

# HLO operations on floats that are counted, of those that occur in the kernels.
_COUNTED = set(
    "abs add and clamp compare cosine divide maximum minimum multiply negate or select sign sine "
    "sqrt subtract".split()
)


def operations(program: str, batch: int, boxes: int) -> Counter:
    """Operations by kind that a compiled collision program does for a configuration.

    Args:
        program: the optimized HLO as text.
        batch: its configurations.
        boxes: its boxes; the loop over them slices out so many a turn as its HLO says.
    """
    # A computation is a line `%name (parameters) -> type {`, instructions, and a brace.
    bodies = dict(re.findall(r"^(?:ENTRY )?%?([\w.-]+) [^\n]*\{\n(.*?)^\}", program, re.M | re.S))
    entry = re.search(r"^ENTRY %?([\w.-]+)", program, re.M)
    assert entry, "no entry computation in the HLO"

    def slices(name: str) -> list[int]:
        sizes = re.findall(r"dynamic_slice_sizes=\{(\d+)", bodies[name])
        called = re.findall(r"calls=%?([\w.-]+)", bodies[name])
        return [int(size) for size in sizes] + [n for inner in called for n in slices(inner)]

    def count(name: str) -> Counter:
        total = Counter()
        for line in bodies[name].splitlines():
            for inner in re.findall(r"(?:calls|to_apply)=%?([\w.-]+)", line):
                if " fusion(" in line or " call(" in line:
                    total.update(count(inner))
            for inner in re.findall(r"body=%?([\w.-]+)", line):
                turns = math.ceil(boxes / max(slices(inner), default=boxes))
                for kind, number in count(inner).items():
                    total[kind] += turns * number
            found = re.search(r" = (?:f32|pred)\[([\d,]+)\]\S* ([a-z-]+)\(", line)
            if found and found[2] in _COUNTED:
                elements = math.prod(int(n) for n in found[1].split(","))
                if elements % batch == 0:  # the others prepare the boxes
                    total[found[2]] += elements // batch
        return total

    return count(entry[1])
