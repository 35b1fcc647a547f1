"""Signals end a command with one sentence, whatever it is doing."""

import signal
import subprocess
import sys
import time

import pytest

from gnnjax.files import is_leftover
from gnnjax.interruption import is_command


def start(*words):
    command = [sys.executable, *words]
    # Processes inherit what is ignored: a script in the background has its own ignore SIGINT.
    had = signal.signal(signal.SIGINT, signal.SIG_DFL)
    try:
        return subprocess.Popen(
            command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True
        )
    finally:
        signal.signal(signal.SIGINT, had)


@pytest.mark.parametrize(
    ("number", "status", "word"),
    [(signal.SIGINT, 130, "interrupted"), (signal.SIGTERM, 143, "terminated")],
)
def test_a_signal_during_imports_ends_a_command_with_a_sentence(number, status, word):
    # Python reports each import when it is done, which tells how far the command is.
    with start("-X", "importtime", "-m", "gnnjax.generate", "--num-problems", "1") as process:
        for line in process.stderr:
            if line.endswith("gnnjax.interruption\n"):
                break
        process.send_signal(number)
        lines = [x for x in process.stderr.read().splitlines() if not x.startswith("import time:")]
        assert lines == [f"{word}; start the same command again to go on"]
        assert process.wait() == status


def test_a_signal_while_a_training_compiles_says_how_to_go_on(tiny_path, tmp_path, monkeypatch):
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path / "empty"))
    out = tmp_path / "run"
    words = ["--robots", str(tiny_path), "--out", str(out), "--scenes", "2", "--motions", "64"]
    with start("-m", "gnnjax.train_motion", *words) as process:
        while not out.exists() and process.poll() is None:
            time.sleep(0.05)
        time.sleep(0.3)  # all is set up, and the first step compiles
        process.send_signal(signal.SIGTERM)
        again = "start the same command again with --resume to go on"
        assert process.stderr.read() == f"terminated; {again}\n"
        assert process.wait() == 143
    # A compiler that does not come back is not waited for: then the lock stays for the next one.
    assert all(is_leftover(path.name) for path in out.iterdir())


def test_a_library_import_leaves_the_users_handlers():
    code = (
        "import signal, threading; before = [signal.getsignal(n) for n in (2, 15)]; import gnnjax; "
        "assert before == [signal.getsignal(n) for n in (2, 15)]; "
        "assert signal.set_wakeup_fd(-1) == -1; assert threading.active_count() == 1"
    )
    assert subprocess.run([sys.executable, "-c", code, "-m", "gnnjax.plan"]).returncode == 0


@pytest.mark.parametrize(
    ("arguments", "first", "expected"),
    [
        ("python -m gnnjax.plan --scene s", "-m", True),
        ("python -X dev -mgnnjax.train", "-m", True),
        ("python -m experiments.arms", "-m", True),
        ("python -m gnnjax.plan", "plan.py", False),  # the module was found, and imports others
        ("python -m pytest -m gnnjax.plan", "-m", False),
        ("python -m gnnjaxy.plan", "-m", False),
        ("python -c pass -m gnnjax.plan", "-c", False),
        ("python", "", False),
    ],
)
def test_a_command_is_known_by_how_python_was_started(arguments, first, expected):
    assert is_command(arguments.split(), first) == expected
