"""Files that are never half written, and errors in one line."""

import errno
import os

import pytest

from gnnjax.errors import InputError, atomic_write, run_command


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
    assert lines[0].startswith("error: No space left on device")


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
        (PermissionError(13, "Permission denied", "/x"), 2, "error: Permission denied: /x"),
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
