"""Processes that share work find out who is done and who is lost: here, threads with files."""

import json
import os
import subprocess
import sys
import threading
import time
from types import SimpleNamespace

import pytest

from gnnjax import roll_call
from gnnjax.cluster import ClusterOptions, ConnectedOptions
from gnnjax.errors import InputError
from gnnjax.files import locked
from gnnjax.roll_call import LostProcess, Place, RollCall


@pytest.fixture(autouse=True)
def fast(monkeypatch):
    monkeypatch.setattr(roll_call, "_BEAT_S", 0.02)


@pytest.fixture
def clock(monkeypatch):
    """Time passes with the beats of the slowest that is there: no busy machine loses one."""
    there, seconds, enter = [], [0.0], RollCall.__enter__

    def noted(others):
        there.append(enter(others))
        return there[-1]

    def monotonic():
        beats = [others._beats for others in there if not others._ended.is_set()]
        if not beats:
            return time.monotonic()
        seconds[0] = max(seconds[0], roll_call._BEAT_S * min(beats))
        return seconds[0]

    clock = SimpleNamespace(time=time.time, monotonic=monotonic, sleep=time.sleep)
    monkeypatch.setattr(RollCall, "__enter__", noted)
    monkeypatch.setattr(roll_call, "time", clock)
    return clock


def together(target, processes, patience=60.0):
    """What each of some functions of a roll call has returned or raised, a thread each."""
    found = {}

    def run(index, function):
        try:
            with RollCall(target, Place(index, len(processes)), patience) as others:
                found[index] = function(others)
        except Exception as error:
            found[index] = error

    threads = [threading.Thread(target=run, args=pair) for pair in enumerate(processes)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return found


def test_the_first_goes_on_when_all_are_done_and_the_others_when_it_is_over(tmp_path):
    order = []

    def late(others):
        time.sleep(0.2)
        order.append("late")
        return others.gather()

    def first(others):
        alone = others.gather()
        time.sleep(0.2)
        order.append("first")
        return alone

    def early(others):
        alone = others.gather()
        order.append("early")
        return alone

    # As left by processes that were killed, of a run of as many and of another one.
    for count in (3, 7):
        left = json.dumps(["done", "process 1 on host", "", 5, 0.0])
        (tmp_path / f".set.process-00001-of-0000{count}").write_text(left)
    found = together(tmp_path / "set", [first, late, early])
    assert found == {0: True, 1: False, 2: False}
    assert order == ["late", "first", "early"]
    assert list(tmp_path.iterdir()) == []


def test_a_single_process_removes_what_those_that_were_killed_have_left(tmp_path):
    dead, alive = (tmp_path / f".set.process-0000{index}-of-00002" for index in range(2))
    others = [tmp_path / f".{name}.process-00000-of-00002" for name in ("set2", "my.set")]
    for file in (dead, alive, tmp_path / f"{dead.name}.new", tmp_path / f".{dead.name}.lock"):
        file.write_text("left")
    for file in others:
        file.write_text("of another target")
    with locked(alive):
        with pytest.raises(KeyError), RollCall(tmp_path / "set", Place()):
            raise KeyError  # it has not come to its end either
        assert dead.exists()
        with RollCall(tmp_path / "set", Place()):
            pass
        left = {alive, tmp_path / f".{alive.name}.lock", *others}
        assert set(tmp_path.iterdir()) == left
    with RollCall(tmp_path / "set", Place()):
        pass
    assert set(tmp_path.iterdir()) == set(others)


def test_a_reason_to_end_comes_to_all(tmp_path):
    def full(others):
        time.sleep(0.1)  # the first one has seen that it was there
        raise InputError("no room; make some")

    found = together(tmp_path / "set", [RollCall.gather, full, RollCall.gather])
    assert isinstance(found[1], InputError)
    for index in (0, 2):
        assert isinstance(found[index], LostProcess)
        assert str(found[index]).startswith("process 1 of 3 (process ")
        assert str(found[index]).endswith("has ended: no room; make some")
    # Started again, they do not take the old reason for a new one.
    found = together(tmp_path / "set", [RollCall.gather] * 3)
    assert found == {0: True, 1: False, 2: False}
    assert list(tmp_path.iterdir()) == []


def test_who_is_silent_or_never_came_is_named(tmp_path, clock):
    def killed(others):
        time.sleep(0.1)
        others._ended.set()  # no sign from now on, and no word
        others._thread.join()
        others._place = Place()  # nor does it take its file away

    def first(others):
        time.sleep(0.2)
        return others.gather()

    found = together(tmp_path / "set", [first, killed, RollCall.gather], patience=0.3)
    message = r"process 1 of 3 \(process .*\) has not been heard of for 0.3 s; start all of them"
    for index in (0, 2):
        with pytest.raises(LostProcess, match=message):
            raise found[index]
    with pytest.raises(LostProcess, match=r"process 1 of 2 is not there after 0.2 s; start all"):
        with RollCall(tmp_path / "other", Place(0, 2), 0.2) as others:
            others.gather()


def test_clocks_and_names_of_machines_tell_nothing(tmp_path, monkeypatch, clock):
    # Here one of each for all: a clock that stands, and a name that many machines have.
    clock.time = lambda: 0.0
    monkeypatch.setattr(roll_call, "_this_process", lambda: "process 1 on localhost")

    def working(others):
        began, deadline = clock.monotonic(), time.monotonic() + 60
        for ahead in (0, 1e9, 5):  # as a file server has it
            os.utime(others._file(1), (ahead, ahead))
            time.sleep(0.05)
        while clock.monotonic() < began + 0.6:
            assert time.monotonic() < deadline
            time.sleep(0.02)
        return others.gather()

    found = together(tmp_path / "set", [RollCall.gather, working, RollCall.gather], patience=0.5)
    assert found == {0: True, 1: False, 2: False}


def test_two_processes_of_one_number_are_refused(tmp_path):
    with RollCall(tmp_path / "set", Place(1, 2)):
        with pytest.raises(InputError, match="is being written by process"):
            with RollCall(tmp_path / "set", Place(1, 2)):
                pass


def test_one_that_cannot_go_on_alone_ends_whatever_it_is_doing(tmp_path):
    code = f"""
import time
from pathlib import Path
from gnnjax.roll_call import Place, RollCall
with RollCall(Path({str(tmp_path / "run")!r}), Place(0, 2), 0.5, all_at_once=True):
    time.sleep(600)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr == (
        "error: process 1 of 2 is not there after 0.5 s; start all of them again to go on\n"
    )


def test_options_and_launchers_say_which_process_this_is(monkeypatch):
    for names in (
        ("SLURM_PROCID", "SLURM_NTASKS"),
        ("OMPI_COMM_WORLD_RANK", "OMPI_COMM_WORLD_SIZE"),
    ):
        for name in names:
            monkeypatch.delenv(name, raising=False)
    assert ClusterOptions().place() == (0, 1)
    with pytest.raises(InputError, match="neither Slurm nor mpirun has started this process"):
        ClusterOptions(distributed=True).place()
    with monkeypatch.context() as slurm:
        slurm.setenv("SLURM_PROCID", "3")
        slurm.setenv("SLURM_NTASKS", "5")
        assert ClusterOptions().place() == (0, 1)
        assert ClusterOptions(distributed=True).place() == (3, 5)
        both = ClusterOptions(distributed=True, process_id=1, process_count=2)
        assert both.place() == (1, 2)
    assert [number for number in range(9) if Place(1, 4).has(number)] == [1, 5]
    for index, count in ((2, 2), (-1, 2), (1, None), (None, 2)):
        with pytest.raises(InputError, match=f"process {index} of {count}; give --process-count"):
            ClusterOptions(distributed=True, process_id=index, process_count=count).place()
    with pytest.raises(InputError, match="process_id is 0 and process_count None; add --dist"):
        ClusterOptions(process_id=0).place()
    with pytest.raises(InputError, match=r"patience is 0.0; it must be positive"):
        ClusterOptions(distributed=True, patience=0.0).place()


def test_coordinators_that_are_none_are_refused(tmp_path):
    for options, message in (
        ({"coordinator": "host:1"}, "coordinator is 'host:1'; add --distributed"),
        (
            {"coordinator": "host", "distributed": True, "process_id": 1, "process_count": 2},
            "coordinator is 'host'; give host:port of process 0",
        ),
    ):
        # In a process of its own nothing of it would be left; here the end of this one is kept.
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("gnnjax.cluster.atexit.register", lambda function: None)
            with pytest.raises(InputError, match=message):
                with ConnectedOptions(**options).connected(tmp_path / "run"):
                    pass
