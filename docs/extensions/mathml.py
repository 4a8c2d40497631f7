"""Render formulas as MathML, which browsers display without scripts, network or LaTeX."""

import docutils
from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml

# Docutils 0.21 inverted the meaning of the second argument of tex2mathml.
_BLOCK_IS_TRUE = docutils.__version_info__ >= (0, 21)


def _inline(translator, node):
    translator.body.append(tex2mathml(node.astext(), not _BLOCK_IS_TRUE))
    raise nodes.SkipNode


def _block(translator, node):
    formula = tex2mathml(node.astext(), _BLOCK_IS_TRUE)
    translator.body.append(f'<div class="math">{formula}</div>\n')
    raise nodes.SkipNode


def setup(app):
    """Register the renderer."""
    app.add_html_math_renderer('mathml', (_inline, None), (_block, None))
    return {'parallel_read_safe': True, 'parallel_write_safe': True}
