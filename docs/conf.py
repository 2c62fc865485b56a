"""Sphinx configuration. Nothing is fetched while reading: formulas are MathML. While building, only where the pages of
other packages lie, for links to them; without a network there are no such links.
"""

import os
import sys
from pathlib import Path

from docutils.nodes import SkipNode
from docutils.utils.math.latex2mathml import tex2mathml

from legdistort import __version__

project = "legdistort"
author = "The legdistort developers"
copyright = f"2026, {author}"
version = release = __version__

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.intersphinx",
    "numpydoc",
]
templates_path = ["_templates"]
exclude_patterns = ["_build", "paper/table.md"]
default_role = "py:obj"
suppress_warnings = ["config.cache"]

# Without a network the second, which is empty: links to other packages are words then, and nothing warns.
intersphinx_mapping = {
    name: (address, (None, "_static/empty.inv"))
    for name, address in {
        "asdf": "https://www.asdf-format.org/projects/asdf/en/stable/",
        "astropy": "https://docs.astropy.org/en/stable/",
        "gwcs": "https://gwcs.readthedocs.io/en/stable/",
        "numpy": "https://numpy.org/doc/stable/",
        "photutils": "https://photutils.readthedocs.io/en/stable/",
        "python": "https://docs.python.org/3/",
        "reproject": "https://reproject.readthedocs.io/en/stable/",
        "scipy": "https://docs.scipy.org/doc/scipy/",
    }.items()
}
intersphinx_timeout = 5  # seconds

# Pages in notebooks/ are run where nothing else is; what they call in a shell is that of this Python.
nb_execution_mode = "auto"
nb_execution_in_temp = True
nb_execution_raise_on_error = True
nb_execution_timeout = 600  # seconds a cell, on a busy machine
nb_merge_streams = True
os.environ.pop("MPLBACKEND", None)  # a kernel then has that which shows figures
os.environ["PYTHONWARNINGS"] = "ignore:IProgress not found"  # of tqdm without widgets; there are none in pages
os.environ["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"

myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3

autodoc_default_options = {"members": True, "member-order": "bysource"}
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
python_use_unqualified_type_names = True
maximum_signature_line_length = 90
numpydoc_show_class_members = False

html_theme = "pydata_sphinx_theme"
html_title = f"legdistort {version}"
html_math_renderer = "mathml"
html_show_sourcelink = False
html_static_path = ["_static"]
html_css_files = ["page.css"]
html_search_scorer = str(Path(__file__).parent / "_static" / "scorer.js")
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
