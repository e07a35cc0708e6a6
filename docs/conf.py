"""Configuration of the documentation: ``sphinx-build -W docs docs/_build/html``, no network needed."""

import importlib.metadata
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "_ext"))

project = "bricktrack"
author = "the bricktrack authors"
version = release = importlib.metadata.version("bricktrack")

extensions = [
    "command_reference",
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "sphinx_copybutton",
]
exclude_patterns = ["_build"]
templates_path = ["_templates"]
source_suffix = {".md": "markdown", ".rst": "restructuredtext"}

myst_enable_extensions = ["colon_fence", "deflist"]
myst_heading_anchors = 3

# `name` in a docstring links where it can, and stays code where it cannot.
default_role = "py:obj"
# A name of one letter, as R or t, may be an attribute of several classes: then it stays code.
suppress_warnings = ["ref.python"]
autosummary_generate = True
autodoc_member_order = "bysource"
autodoc_typehints = "none"  # types, shapes and units stand in the docstrings
autodoc_default_options = {"members": True}
napoleon_google_docstring = False
# A list also takes two names on one line, and describes each field once.
napoleon_custom_sections = [("Attributes", "params_style")]
napoleon_use_rtype = False

# A click copies what is to be typed: without the prompts, and without what the commands print.
copybutton_prompt_text = "$ "
copybutton_line_continuation_character = "\\"

html_search_scorer = str(Path(__file__).parent / "_search" / "scorer.js")
html_theme = "furo"
html_title = "bricktrack"
html_copy_source = False
html_show_sphinx = False
html_show_copyright = False
html_theme_options = {
    "light_css_variables": {"color-brand-primary": "#1f5f8b", "color-brand-content": "#1f5f8b"},
    "dark_css_variables": {"color-brand-primary": "#8bbcdc", "color-brand-content": "#8bbcdc"},
}
