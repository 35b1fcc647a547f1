"""Kinds of obstacles, and the rule that whoever deals with obstacles deals with all of them.

A kind that one consumer forgot would be free space to it, and what stands there would be hit. So
each consumer keeps a table with an entry for every kind, made by `for_every_kind`, which raises,
when the module is imported, where an entry is missing. The certificate has a table of its own code,
since its worth is that it shares nothing with the kernels.
"""

from typing import Any

# In Python, in problem files (`box_centers`) and, in the plural, in scene files.
KINDS = ("box",)

# What has a table, and of which kinds; filled as the modules are imported.
TABLES: dict[str, tuple[str, ...]] = {}


def for_every_kind(consumer: str, **entries: Any) -> dict[str, Any]:
    """A consumer's table, keyed by kind.

    Args:
        consumer: who deals with obstacles here.
        entries: what it does with a kind, by the kind's name.

    Raises:
        TypeError: a kind without an entry, or an entry that is no kind.
    """
    if gap := set(KINDS) - entries.keys():
        raise TypeError(f"the {consumer} has no entry for obstacles of the kinds {sorted(gap)}")
    if unknown := entries.keys() - set(KINDS):
        raise TypeError(f"the {consumer} has entries for {sorted(unknown)}, which are no obstacles")
    TABLES[consumer] = tuple(entries)
    return entries
