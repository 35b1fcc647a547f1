"""The notebooks run from top to bottom."""

import os
import re
import subprocess
import sys
from pathlib import Path

import jax
import nbformat
import pytest

from gnnjax.arm.robot import assets_dir

NOTEBOOKS = sorted((Path(__file__).parents[1] / "notebooks").glob("*.ipynb"))


def sparing(folder):
    """A cell that swaps the Kuka's hulls, whose kernels compile for a minute, for some spheres.

    `.ci/run` plans the README's query, which is nearly the notebook's, with the hulls.
    """
    text = (assets_dir() / "kuka_iiwa14.xml").read_text()
    text = re.sub(r"<mesh [^>]*/>", "", text)
    text, count = re.subn(r' mesh="link_\d"', ' type="sphere" size="0.08"', text)
    assert count == 8
    (folder / "kuka_iiwa14.xml").write_text(text)
    return nbformat.v4.new_code_cell(
        "import pathlib, gnnjax.arm.robot\n"
        f"gnnjax.arm.robot.assets_dir = lambda: pathlib.Path({str(folder)!r})"
    )


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs_from_top_to_bottom(path, tmp_path):
    notebook = nbformat.read(path, as_version=4)
    installs = [cell for cell in notebook.cells if "%pip install" in cell.source]
    assert len(installs) == 1
    # The tests run in an environment in which it is installed.
    notebook.cells[notebook.cells.index(installs[0])] = sparing(tmp_path)
    copy = tmp_path / path.name
    nbformat.write(notebook, copy)
    command = [sys.executable, "-m", "nbconvert", "--to", "notebook", "--execute", "--stdout"]
    cache = {"JAX_COMPILATION_CACHE_DIR": jax.config.jax_compilation_cache_dir or ""}
    done = subprocess.run(
        [*command, str(copy)], capture_output=True, text=True, env=os.environ | cache, check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]
    executed = nbformat.reads(done.stdout, as_version=4)
    code = [cell for cell in executed.cells if cell.cell_type == "code"]
    assert all(cell.execution_count for cell in code)
    outputs = [output for cell in code for output in cell.outputs]
    shown = "".join(o.get("text", "") + o.get("data", {}).get("text/plain", "") for o in outputs)
    assert "certified: True" in shown
    assert "lazysp, 200 nodes" in shown
