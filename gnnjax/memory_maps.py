"""Room for compiled code: the memory maps that Linux allows a process.

A planner's code takes some 5,000 to 8,000 of them, and a process has 65,530 where nobody set
another number. LLVM does not survive it when there are no more: the process ends with a
segmentation fault.
"""

import gc
from pathlib import Path

from gnnjax.errors import InputError

_MAPS, _MOST = Path("/proc/self/maps"), Path("/proc/sys/vm/max_map_count")
_SPARE = 4000  # a function takes up to 500, and several are loaded between two looks


def make_room_for_code() -> None:
    """Frees the code of planners that nobody holds any more, where maps run short.

    These are in cycles, which Python may leave for long.

    Raises:
        InputError: all of it is held, and there is hardly room for more.
    """
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
