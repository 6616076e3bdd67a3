"""Sphinx configuration of the documentation."""

from __future__ import annotations

import os
import sys
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE / "_build_pages"))

import api_pages
import command_pages
import house_figure
import mathml
import tutorial_pages

import probmotion

project = "probmotion"
author = "The probmotion authors"
copyright = author
version = release = probmotion.__version__

extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.intersphinx",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
    "myst_nb",
]
exclude_patterns = ["_build", "_build_pages"]
nitpicky = False

# Read the inventories of other projects on Read the Docs only; local builds are offline.
intersphinx_mapping = (
    {
        "python": ("https://docs.python.org/3", None),
        "numpy": ("https://numpy.org/doc/stable", None),
        "torch": ("https://docs.pytorch.org/docs/stable", None),
        "xarray": ("https://docs.xarray.dev/en/stable", None),
    }
    if os.environ.get("READTHEDOCS")
    else {}
)

napoleon_google_docstring = False
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented_params"
autodoc_member_order = "bysource"
python_use_unqualified_type_names = True

myst_enable_extensions = ["dollarmath", "amsmath", "colon_fence"]
myst_heading_anchors = 3
# Tutorials are executed by `make notebooks`; their outputs are stored in the repository.
nb_execution_mode = "off"
# Shapes in type descriptions, such as (n, dim), are not references.
suppress_warnings = ["mystnb.unknown_mime_type", "ref.python"]

html_theme = "furo"
html_title = "probmotion"
html_static_path = ["_static"]
html_css_files = ["probmotion.css"]
html_math_renderer = "mathml"


def setup(app: object) -> None:
    """Write the generated pages before Sphinx looks for sources."""
    mathml.setup(app)
    tutorial_pages.write(HERE)
    api_pages.write(HERE)
    command_pages.write(HERE)
    house_figure.draw(HERE / "developer" / "house.svg")
