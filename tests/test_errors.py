"""Files that are never half written, and errors in one line."""

import errno
import os

import jax
import pytest

from gnnjax.errors import InputError, check_seed, run_command
from gnnjax.files import atomic_write, check_target


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


@pytest.mark.parametrize("seed", [-1, 2**31, 2**70])
def test_a_seed_that_jax_cannot_take_is_refused(seed):
    with pytest.raises(InputError, match=rf"seed is {seed}; choose 0 to 2147483647"):
        check_seed(seed)


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


@pytest.mark.parametrize(
    ("error", "status", "line"),
    [
        (InputError("num_nodes is 1; give 2 or more"), 2, "error: num_nodes is 1; give 2 or more"),
        (KeyboardInterrupt(), 130, "interrupted; start the same command again to go on"),
        (
            PermissionError(13, "Permission denied", "/x"),
            2,
            "error: Permission denied: /x; check its permissions",
        ),
        (MemoryError("no room"), 2, "error: not enough memory; ask for fewer nodes (no room)"),
        (
            jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: 9 TB"),
            2,
            "error: not enough memory; ask for fewer nodes (RESOURCE_EXHAUSTED: 9 TB)",
        ),
    ],
)
def test_a_command_says_in_one_line_what_went_wrong(error, status, line, capsys):
    def main():
        raise error

    with pytest.raises(SystemExit) as exit_info:
        run_command(main)
    assert exit_info.value.code == status
    assert capsys.readouterr().err == line + "\n"


def test_a_command_returns_its_status():
    for returned, status in ((None, 0), (0, 0), (1, 1)):
        with pytest.raises(SystemExit) as exit_info:
            run_command(lambda returned=returned: returned)
        assert exit_info.value.code == status
