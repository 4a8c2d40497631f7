"""Sphinx configuration; scripts/docs builds with it."""

import gc
import logging
import os
import sys
from pathlib import Path

# Pages refer to each other until the end of the build, so there is little to collect, and the
# search for it takes a fifth of the time.
gc.disable()
ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / 'docs' / 'extensions'))
# Notebooks run with the kernel of this folder, whatever the user has installed and configured.
os.environ['JUPYTER_PATH'] = str(ROOT / 'docs' / 'jupyter')
os.environ['IPYTHONDIR'] = os.environ['JUPYTER_RUNTIME_DIR'] = str(ROOT / 'build' / 'jupyter')
# Only warnings: the ROS libraries print all messages of other libraries.
logging.getLogger('traitlets').setLevel(logging.WARNING)
# Sphinx prepares 60 000 messages that `-q` hides, which takes a twentieth of the time.
logging.getLogger('sphinx').setLevel(logging.WARNING)

from rhs_isac_ros import __version__  # noqa: E402

project = 'rhs_isac_ros'
author = 'rhs_isac_ros authors'
copyright = author
version = release = __version__
extensions = ['sphinx.ext.autodoc', 'sphinx.ext.napoleon', 'myst_nb',
              'matplotlib.sphinxext.plot_directive', 'generated', 'mathml']

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
exclude_patterns = ['examples', 'jupyter', 'pictures']
# A build executes every notebook once. A cell that fails or prints a warning ends the build.
nb_execution_mode = 'force'
nb_execution_raise_on_error = True
nb_execution_timeout = 240
nb_output_stderr = 'error'
plot_formats = [('png', 144)]
plot_html_show_formats = plot_html_show_source_link = False
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
