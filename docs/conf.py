"""Sphinx configuration; scripts/docs builds with it."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / 'extensions'))

from rhs_isac_ros import __version__  # noqa: E402

project = 'rhs_isac_ros'
author = 'rhs_isac_ros authors'
copyright = author
version = release = __version__
extensions = ['sphinx.ext.autodoc', 'sphinx.ext.napoleon', 'myst_parser', 'generated', 'mathml',
              'notebook_pages', 'pictures']

# The pages must display offline, so no fonts and no MathJax are loaded from other sites.
html_theme = 'furo'
html_title = f'rhs_isac_ros {version}'
html_static_path = ['_static']
html_css_files = ['custom.css']
pygments_dark_style = 'github-dark'
# Every page contains the table of contents: with all functions, a build takes a fifth longer.
toc_object_entries = False
html_math_renderer = 'mathml'
html_show_sourcelink = False
html_copy_source = False

default_role = 'py:obj'
exclude_patterns = ['examples']
autodoc_typehints_format = 'short'
# The sources have none, and the search takes time.
autodoc_use_type_comments = False
autodoc_member_order = 'bysource'
autodoc_default_options = {'members': True, 'show-inheritance': True}
napoleon_google_docstring = False
napoleon_use_rtype = False
napoleon_use_ivar = True
# References into this package must resolve. Those to other libraries would need their inventories
# from the network, and private names have no page.
nitpicky = True
nitpick_ignore_regex = [
    ('py:.*', r'(?!rhs_isac_ros\.).*'),
    ('py:.*', r'rhs_isac_ros\.(.*\.)?_.*'),
    # Type variables.
    ('py:.*', r'rhs_isac_ros\.protocol\.(role\.(Key|Value|\w+T)|(messages|settings)\.\w+T)'),
]
