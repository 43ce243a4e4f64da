# SPDX-License-Identifier: Apache-2.0
"""How Sphinx builds the site: `make docs` writes it to build/docs."""

from remaster_ros.version import __version__

project = 'remaster_ros'
author = 'remaster_ros maintainers'
version = release = __version__
extensions = ['myst_parser', 'sphinx.ext.autodoc', 'sphinx.ext.napoleon']
exclude_patterns = ['examples']
html_theme = 'furo'
html_title = f'remaster_ros {version}'
html_show_copyright = False
html_show_sphinx = False
html_copy_source = False
html_static_path = ['_static']
html_css_files = ['site.css']
html_theme_options = {'footer_icons': []}
# Links such as safety.md#a-halt work as they do on the code host.
myst_heading_anchors = 3
napoleon_google_docstring = False
napoleon_use_rtype = False
autodoc_member_order = 'bysource'
autodoc_typehints = 'signature'
autodoc_typehints_format = 'short'
# There is no lexer for CSV.
suppress_warnings = ['misc.highlighting_failure']
