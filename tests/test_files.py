"""Files that are never half written, and locks."""

import errno
import os
import subprocess
import sys

import pytest

from gnnjax.errors import InputError, run_command
from gnnjax.files import atomic_write, check_target, locked


def test_a_full_disk_leaves_the_old_file_and_no_rest(tmp_path, monkeypatch, capsys):
    target = tmp_path / "results.json"
    target.write_text("old")

    def no_space(handle):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", no_space)
    with pytest.raises(SystemExit) as exit_info:
        run_command(lambda: atomic_write(target, lambda file: file.write_text("new")))
    assert exit_info.value.code == 2
    assert target.read_text() == "old"
    assert list(tmp_path.iterdir()) == [target]
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert lines[0] == (
        f"error: No space left on device: {target}; make room and start the same command again"
    )


def test_a_file_that_outgrows_its_disk_is_not_begun(tmp_path):
    resource = pytest.importorskip("resource")  # POSIX
    target = tmp_path / "results.json"
    target.write_text("old")
    unlimited = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, unlimited[1]))
    try:
        with pytest.raises(OSError, match=r"File too large.*results.json"):
            atomic_write(target, lambda file: file.write_text("x" * 5000))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, unlimited)
    assert target.read_text() == "old"
    assert list(tmp_path.iterdir()) == [target]


def test_a_target_that_no_file_can_have_is_refused(tmp_path):
    (tmp_path / "file").write_text("kept")
    for target, message in (
        (tmp_path, "is a folder; name a file"),
        (tmp_path / "file" / "new" / "path.npz", r"file' is a file; name a folder"),
        ("", r"'\.' is a folder"),
    ):
        with pytest.raises(InputError, match=message):
            check_target(target)
        with pytest.raises(InputError, match=message):
            atomic_write(target, lambda file: file.write_text("new"))
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_write_that_is_interrupted_leaves_the_old_file(tmp_path):
    target = tmp_path / "path.npz"
    target.write_bytes(b"old")

    def half(file):
        file.write_bytes(b"ne")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        atomic_write(target, half)
    assert target.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [target]


def test_a_file_is_replaced_and_folders_are_made(tmp_path):
    target = tmp_path / "new" / "file.txt"
    for text in ("one", "two"):
        atomic_write(target, lambda file, text=text: file.write_text(text))
        assert target.read_text() == text


KILLED = """
import os, sys
from gnnjax.files import atomic_write, locked

def half(file):
    file.write_text("half")
    os._exit(9)

with locked(sys.argv[1]):
    atomic_write(sys.argv[1], half)
"""


def test_what_a_killed_command_left_is_removed_and_nothing_else(tmp_path):
    target = tmp_path / "results.json"
    target.write_text("old")
    others = [
        ".results.part-abcdefgh.npz",
        ".results.b.part-abcdefgh.json",
        ".results-abcdefgh.json",
    ]
    for name in others:
        (tmp_path / name).write_text("kept")
    killed = subprocess.run([sys.executable, "-c", KILLED, str(target)])
    assert killed.returncode == 9
    left = {path.name for path in tmp_path.iterdir()} - {"results.json", *others}
    assert len(left) == 2  # half a file, and the lock
    with locked(target):
        atomic_write(target, lambda file: file.write_text("new"))
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(["results.json", *others])
    assert target.read_text() == "new"


def test_a_file_that_is_just_being_written_is_no_leftover(tmp_path):
    target = tmp_path / "results.json"

    def write_twice(file):
        atomic_write(target, lambda other: other.write_text("other"))
        file.write_text("this")

    atomic_write(target, write_twice)
    assert target.read_text() == "this"
    assert list(tmp_path.iterdir()) == [target]


def test_a_lock_names_its_holder_and_ends_with_it(tmp_path):
    target = tmp_path / "set" / "manifest.json"
    with locked(target):
        with pytest.raises(
            InputError, match=rf"is being written by process {os.getpid()} on .*since"
        ):
            with locked(target):
                pass
        with locked(tmp_path / "set" / "other.json"):
            pass
    with locked(target):
        pass
    assert list((tmp_path / "set").iterdir()) == []
