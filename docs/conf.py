"""How the documentation is built: pages that run at build time, so that what they show is what the code does."""

from __future__ import annotations

import haltere

project = "haltere"
author = "the haltere developers"
copyright = "the haltere developers, Apache-2.0"
release = haltere.__version__
version = release

extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx.ext.mathjax", "sphinx.ext.napoleon"]
exclude_patterns = ["_build", "jupyter_execute"]
default_role = "py:obj"

myst_enable_extensions = ["amsmath", "colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3

# Every page runs afresh: a page that no longer runs fails the build.
nb_execution_mode = "force"
nb_execution_show_tb = True
nb_execution_timeout = 300
nb_render_markdown_format = "myst"
nb_merge_streams = True

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
napoleon_google_docstring = False
napoleon_use_rtype = False

html_theme = "furo"
html_title = f"haltere {release}"
html_static_path = ["_static"]
html_show_copyright = False
