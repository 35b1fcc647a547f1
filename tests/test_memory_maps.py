"""Where memory maps run short, code that nobody holds is freed, or one sentence says so."""

import gc
import weakref

import pytest

from gnnjax import kept, memory_maps
from gnnjax.digest import digest
from gnnjax.errors import InputError
from gnnjax.memory_maps import Room


def make_room_for_code():
    room = Room()
    for _ in range(memory_maps._EVERY):
        room.make()


class Cycle:
    """What only the garbage collector frees."""

    def __init__(self):
        self.itself = self


@pytest.fixture
def maps(tmp_path, monkeypatch):
    """Sets how many maps the process has, and how many it may have."""

    def has(number, most):
        for name, text in (("_MAPS", "one of them\n" * number), ("_MOST", f"{most}\n")):
            path = tmp_path / name
            path.write_text(text)
            monkeypatch.setattr(memory_maps, name, path)

    return has


@pytest.fixture
def dropped():
    """A cycle that nobody holds."""
    gc.collect()
    gc.disable()
    yield weakref.ref(Cycle())
    gc.enable()


def test_cycles_are_freed_from_half_of_the_maps_on(maps, dropped):
    maps(5000, most=10_000)
    make_room_for_code()
    assert dropped() is not None
    maps(5001, most=10_000)
    make_room_for_code()
    assert dropped() is None


def test_no_room_is_said_in_one_sentence(maps):
    maps(6000, most=10_000)
    make_room_for_code()
    maps(6001, most=10_000)
    with pytest.raises(InputError, match=r"takes 6001 of the 10000 memory maps .*max_map_count"):
        make_room_for_code()


def test_other_systems_are_left_alone(monkeypatch, tmp_path):
    monkeypatch.setattr(memory_maps, "_MOST", tmp_path / "nothing")
    make_room_for_code()


def test_it_is_asked_once_a_function(monkeypatch):
    asked = []
    monkeypatch.setattr(Room, "make", lambda self: asked.append(self))
    function = kept.keep(lambda x: x)
    for _ in range(2):
        function(1.0)  # no array, which is not kept
    assert asked == [kept._ROOM]


def test_how_often_it_was_asked_does_not_count():
    before = digest(kept._ROOM)
    kept._ROOM.make()
    assert digest(kept._ROOM) == before
