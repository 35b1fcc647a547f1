"""Commands that are killed lose nothing; `python -m tests.kill_points` tries all points."""

import re
import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.whole
def test_a_run_that_was_killed_anywhere_and_resumed_is_as_if_it_had_not_been():
    # In a process of its own, which forks and must not have used JAX.
    words = [sys.executable, "-m", "tests.kill_points", "--points", "3"]
    done = subprocess.run(words, capture_output=True, text=True, cwd=Path(__file__).parents[1])
    assert done.returncode == 0, done.stdout + done.stderr
    tried = re.findall(r"^(\w+): .* 3 points tried, 3 killed, 3 equal", done.stdout, re.MULTILINE)
    assert tried == ["generate", "generate_file", "evaluate", "train", "train_motion"]
