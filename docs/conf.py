"""Sphinx configuration. Nothing is fetched while building, and nothing while reading: formulas are MathML."""

from docutils.nodes import SkipNode
from docutils.utils.math.latex2mathml import tex2mathml

from legdistort import __version__

project = "legdistort"
author = "The legdistort developers"
copyright = f"2026, {author}"
version = release = __version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.autosummary", "numpydoc"]
templates_path = ["_templates"]
exclude_patterns = ["_build", "paper/table.md"]
default_role = "py:obj"
suppress_warnings = ["config.cache"]

myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3

autodoc_default_options = {"members": True, "member-order": "bysource"}
autodoc_typehints = "none"
numpydoc_show_class_members = False

html_theme = "pydata_sphinx_theme"
html_title = f"legdistort {version}"
html_math_renderer = "mathml"
html_show_sourcelink = False
html_sidebars = {"**": ["globaltoc.html"]}
html_theme_options = {
    "navigation_with_keys": False,
    "secondary_sidebar_items": ["page-toc"],
    "navbar_persistent": ["search-button"],
    "navbar_center": [],
    "navbar_end": ["theme-switcher"],
    "footer_end": [],
}


def _inline(self, node):
    self.body.append(tex2mathml(node.astext()))
    raise SkipNode


def _block(self, node):
    self.body.append(f'<div style="margin: 1.2em 0">{tex2mathml(node.astext(), as_block=True)}</div>')
    raise SkipNode


def setup(app):
    """Register the renderer of formulas: MathML written while building, shown by every present browser."""
    app.add_html_math_renderer("mathml", (_inline, None), (_block, None))
