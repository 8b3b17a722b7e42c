"""Configuration of the documentation site, built by `make docs`."""

import sys
from pathlib import Path

import cadalign

sys.path.insert(0, str(Path(__file__).parent))

project = "cadalign"
author = "the cadalign developers"
version = release = cadalign.__version__
html_title = f"cadalign {version}"

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
    "sphinx_design",
    "directives",
]
exclude_patterns = ["_build"]
suppress_warnings = ["myst.xref_missing", "config.cache"]

myst_enable_extensions = ["colon_fence", "deflist"]
myst_heading_anchors = 3

autodoc_default_options = {"members": True, "member-order": "bysource"}
autodoc_typehints = "signature"
autodoc_class_signature = "mixed"
napoleon_google_docstring = False
napoleon_use_rtype = False
default_role = "code"

html_show_copyright = False
html_theme = "furo"
html_static_path = ["_static"]
html_css_files = ["cadalign.css"]
html_theme_options = {"source_edit_link": "", "top_of_page_buttons": []}
html_show_sphinx = False
copybutton_prompt_text = r">>> |\.\.\. |\$ "
copybutton_prompt_is_regexp = True
linkcheck_ignore = [r"https?://.*"]
