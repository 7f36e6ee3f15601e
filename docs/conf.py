"""How Sphinx makes the site: `make docs`, warnings are errors."""

import sys
from importlib.metadata import version as installed
from pathlib import Path

HERE = Path(__file__).parent
sys.path[:0] = [str(HERE), str(HERE.parent)]

import figures  # noqa: E402
import generate  # noqa: E402

project = "hairstage"
release = version = installed("hairstage")
author = "the hairstage authors"
project_copyright = author
extensions = ["myst_parser"]
myst_enable_extensions = ["dollarmath", "colon_fence"]
myst_heading_anchors = 3
exclude_patterns = [
    "_build",
    *(f"reference/generated/{part}.md" for part in generate.PARTS),
]
"""Built pages, and parts that pages include."""
html_theme = "furo"
html_title = f"hairstage {release}"
html_show_sourcelink = False
nitpicky = True
linkcheck_ignore = [r"http://localhost:\d+"]

generate.write_pages(HERE / "reference" / "generated")
figures.write_figures(HERE / "reference" / "generated")
