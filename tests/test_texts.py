"""What runs the code of the texts finds all of it, and links lead somewhere."""

import re
from pathlib import Path

import pytest

from gnnjax.errors import InputError
from tests.texts import PAGES, ROOT, blocks_of, commands_of, is_slow, run_command

PAGE = """
```python
x = 1
```
text
<!-- not run: takes hours -->
```sh
MUJOCO_GL=egl python -m gnnjax.plan --out a.npz \\
  --seed 1  # a comment
make demo
.venv/bin/python -m gnnjax.fit arm.xml
```
"""


def test_blocks_are_found_with_their_lines_and_the_reasons_not_to_run_them():
    first, second = blocks_of(PAGE)
    assert (first.line, first.kind, first.code, first.not_run) == (3, "python", "x = 1\n", "")
    assert (second.line, second.kind, second.not_run) == (8, "sh", "takes hours")


def test_commands_are_the_lines_that_call_a_module():
    found = commands_of(blocks_of(PAGE)[1].code)
    assert found == [
        ["gnnjax.plan", "--out", "a.npz", "--seed", "1"],
        ["gnnjax.fit", "arm.xml"],
    ]
    assert not is_slow(found[0])
    assert is_slow(["gnnjax.train_motion", "--robots", "arm.xml"])


def test_options_of_slow_commands_are_read_and_no_more(tmp_path, monkeypatch):
    # What jaxtyping's hook has made of a module would be kept where other processes look for it.
    monkeypatch.setattr("sys.dont_write_bytecode", True)
    run_command(["gnnjax.train_motion", "--out", str(tmp_path / "run")])
    assert not (tmp_path / "run").exists()
    run_command(["gnnjax.generate", "--split", "train", "--out", str(tmp_path / "run")])
    assert not (tmp_path / "run").exists()
    with pytest.raises(InputError, match="there is no --no-such-option 1"):
        run_command(["gnnjax.train_motion", "--no-such-option", "1"])


def anchors_of(text):
    """The anchors of a page's headings, as GitHub and MyST make them."""
    text = re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL)
    titles = re.findall(r"^#+ (.*)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


@pytest.mark.parametrize(
    "page", [*PAGES, ROOT / "CHANGELOG.md", ROOT / "gnnjax/weights/README.md"], ids=lambda p: p.name
)
def test_links_lead_to_files_and_headings_that_are_there(page):
    text = page.read_text(encoding="utf-8")
    for target in re.findall(r"\]\((?!\w+:)([^)\s]+)\)", text):
        path, _, anchor = target.partition("#")
        file = (page.parent / path).resolve() if path else page
        assert file.exists(), f"{page.name} names {target}"
        if anchor:
            assert anchor in anchors_of(file.read_text(encoding="utf-8")), f"{page.name}: {target}"


def test_the_check_of_anchors_sees_headings_alone():
    assert anchors_of("# One & two\n```sh\n# no heading\n```\n") == {"one--two"}


def test_every_example_is_run_by_ci():
    script = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    for example in sorted(Path(ROOT / "examples").glob("*.py")):
        assert example.name in script, f".ci/run does not run {example.name}"
