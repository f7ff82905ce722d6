"""Sphinx configuration: MyST pages, furo theme, reference pages generated from the source at build time."""

from __future__ import annotations

import os
import sys
from importlib.metadata import version as installed
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parent), str(HERE / "_ext")]
os.environ.setdefault("JAX_PLATFORMS", "cpu")  # autodoc imports the packages; it computes nothing

project = "mjx-tt"
author = "the authors of mjx-tt"
release = version = installed("mjx-tt")

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "sphinx.ext.napoleon",
    "generated_pages",
]
exclude_patterns = ["_build", "_ext"]
nitpicky = True
# A build needs no network, so other libraries' names stay unlinked; of ours, names below the packages' public faces.
nitpick_ignore_regex = [("py:.*", r"(?!(ballmodel|bgs|mjx_tt|robot_io)\.\w+$).*")]

myst_enable_extensions = ["deflist", "colon_fence", "dollarmath"]
highlight_language = "text"
smartquotes_action = "qe"  # two hyphens begin an option
myst_heading_anchors = 4
myst_links_external_new_tab = False

napoleon_use_ivar = True
napoleon_attr_annotations = False  # Sphinx cannot read jaxtyping's shapes
autodoc_typehints = "signature"
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
autosummary_generate = True
python_use_unqualified_type_names = True

html_theme = "furo"
html_title = "mjx-tt"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_show_sphinx = False
html_copy_source = False
html_show_copyright = False
