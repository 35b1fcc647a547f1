"""The documentation site, by Sphinx: `make docs` builds it into build/docs.

Pages are Markdown (MyST), as they are read in the repository, too; what `from_code` adds is made
from the code at build time.
"""

import sys
from importlib.metadata import version as installed
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

project = "gnnjax"
author = copyright = "The gnnjax authors"
version = release = installed("gnnjax")

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "from_code"]
source_suffix = {".md": "markdown", ".rst": "restructuredtext"}
exclude_patterns = ["_build"]
default_role = "literal"  # backticks in docstrings are Markdown's
nitpicky = True
# What is not of this package is named, not linked: the build needs no network.
nitpick_ignore_regex = [(r"py:.*", r"(?!gnnjax\.).*")]

myst_enable_extensions = ["colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 4

autodoc_member_order = "bysource"
napoleon_numpy_docstring = False
maximum_signature_line_length = 80

html_theme = "furo"
html_title = f"gnnjax {release}"
html_copy_source = html_show_sourcelink = False
html_static_path = ["style"]
html_css_files = ["wide.css"]
