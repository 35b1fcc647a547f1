"""Room for compiled code: the memory maps that Linux allows a process.

A planner's code takes some 5,000 to 8,000 of them, and a process has 65,530 where nobody set
another number. LLVM does not survive it when there are no more: the process ends with a
segmentation fault.
"""

import gc
from pathlib import Path
from typing import Any

from gnnjax.errors import InputError

_MAPS, _MOST = Path("/proc/self/maps"), Path("/proc/sys/vm/max_map_count")
_EVERY = 4  # functions that are loaded between two looks
_SPARE = 4000  # a function takes up to 500


class Room:
    """Room for the code of the next function."""

    def __init__(self):
        self._asked = 0

    def __getstate__(self) -> dict[str, Any]:
        """Nothing that code depends on, for the digest of what asks."""
        return {}

    def make(self) -> None:
        """Frees the code of planners that nobody holds any more, where maps run short.

        These are in cycles, which Python may leave for long. It looks every fourth time.

        Raises:
            InputError: all of it is held, and there is hardly room for more.
        """
        self._asked += 1
        if self._asked % _EVERY:
            return
        try:
            most = int(_MOST.read_text())
            if _num_maps() <= most // 2:
                return
            gc.collect()
            used = _num_maps()
        except (OSError, ValueError):  # another system, or one that does not tell
            return
        if used > most - _SPARE:
            raise InputError(
                f"compiled code takes {used} of the {most} memory maps that this system allows a "
                "process; let go of planners that are no longer needed, or allow more "
                "(sysctl vm.max_map_count)"
            )


def _num_maps() -> int:
    with _MAPS.open("rb") as file:
        return sum(1 for _ in file)
