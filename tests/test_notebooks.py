"""The quickstart runs from top to bottom; `.ci/run` runs the others, with `tests/notebooks.py`."""

import re
from pathlib import Path

import nbformat
import pytest

from gnnjax.arm.shipped import assets_dir
from tests.notebooks import executed

NOTEBOOKS = sorted((Path(__file__).parents[1] / "notebooks").glob("*.ipynb"))


def sparing(folder):
    """Code that swaps the Kuka's hulls, whose kernels compile for a minute, for some spheres.

    `.ci/run` plans the README's query, which is nearly the notebook's, with the hulls.
    """
    text = (assets_dir() / "kuka_iiwa14.xml").read_text()
    text = re.sub(r"<mesh [^>]*/>", "", text)
    text, count = re.subn(r' mesh="link_\d"', ' type="sphere" size="0.08"', text)
    assert count == 8
    (folder / "kuka_iiwa14.xml").write_text(text)
    return (
        "import pathlib, gnnjax.arm.robot\n"
        f"gnnjax.arm.shipped.assets_dir = lambda: pathlib.Path({str(folder)!r})"
    )


@pytest.mark.whole
def test_the_quickstart_runs_from_top_to_bottom(tmp_path):
    (path,) = [path for path in NOTEBOOKS if path.stem == "quickstart"]
    notebook = executed(path, sparing(tmp_path), tmp_path)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert all(cell.execution_count for cell in code)
    outputs = [output for cell in code for output in cell.outputs]
    shown = "".join(o.get("text", "") + o.get("data", {}).get("text/plain", "") for o in outputs)
    assert "certified: True" in shown
    assert "lazysp, 200 nodes" in shown


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_kept_with_its_outputs_and_run_by_ci(path):
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    outputs = [out for cell in notebook.cells for out in cell.get("outputs", [])]
    assert not [out for out in outputs if out["output_type"] == "error"]
    assert any("image/png" in out.get("data", {}) for out in outputs)
    # Pictures are kept in lines, or a change of one is a line of all of it.
    assert max(map(len, path.read_text(encoding="utf-8").splitlines())) < 1000
    assert path.stem == "quickstart" or path.stem in (path.parents[1] / ".ci/run").read_text()
