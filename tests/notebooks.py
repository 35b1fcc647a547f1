"""Runs notebooks as they are, but for their installation.

STEPS=3 PROBLEMS=4 python -m tests.notebooks notebooks/paper.ipynb ...
"""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import nbformat

from tests.compiling import ENVIRONMENT


def executed(path: Path, first: str, folder: Path):
    """A notebook with the outputs of its cells, run in a folder.

    Args:
        path: of the notebook.
        first: code in place of the cell that installs the package.
        folder: where it is run.
    """
    notebook = nbformat.read(path, as_version=4)
    (install,) = [cell for cell in notebook.cells if "%pip install" in cell.source]
    install.source = first
    copy = folder / path.name
    nbformat.write(notebook, copy)
    command = [sys.executable, "-m", "nbconvert", "--to", "notebook", "--execute", "--stdout"]
    done = subprocess.run(
        [*command, str(copy)],
        capture_output=True,
        text=True,
        env=os.environ | ENVIRONMENT,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return nbformat.reads(done.stdout, as_version=4)


def main(paths: list[Path]) -> None:
    """Runs notebooks, and tells how long each took."""
    for path in paths:
        began = time.perf_counter()
        with tempfile.TemporaryDirectory() as folder:
            executed(path, "", Path(folder))
        print(f"{path.name}: {time.perf_counter() - began:.0f} s")


if __name__ == "__main__":
    main([Path(path) for path in sys.argv[1:]])
