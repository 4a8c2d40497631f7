"""Execute a notebook in MyST Markdown and write it in Jupyter's format, with its outputs.

    python3 docs/extensions/run_notebook.py docs/notebooks/first_fix.md first_fix.ipynb

Jupyter itself is not needed. Outputs are those of Jupyter: printed text, the value of a cell's
last expression unless a semicolon follows, and the figures that are open at its end. A warning in
a cell is an error, and errors are reported with the line of the source.
"""

import argparse
import ast
import base64
import contextlib
import io
import json
import re
import sys
import warnings
from pathlib import Path

_FRONT_MATTER = re.compile(r'---\n.*?\n---\n', re.DOTALL)
_CODE = re.compile(r'^```\{code-cell\}.*?\n(.*?)^```$', re.DOTALL | re.MULTILINE)
# Resolution of the figures [dots/inch]; pages show them at 96.
DPI = 144


def read(path):
    """Return the cells of a notebook: kind (``markdown`` or ``code``), text, first line."""
    text = Path(path).read_text(encoding='utf-8')
    front = _FRONT_MATTER.match(text)
    cells, end = [], front.end() if front else 0

    def add(kind, start, stop):
        content = text[start:stop]
        if content.strip():
            blank = len(content) - len(content.lstrip('\n'))
            cells.append((kind, content.strip('\n'), 1 + text.count('\n', 0, start + blank)))
    for found in _CODE.finditer(text, end):
        add('markdown', end, found.start())
        add('code', *found.span(1))
        end = found.end()
    add('markdown', end, len(text))
    return cells


def execute(path):
    """Execute a notebook in this process and return it as a dictionary in Jupyter's format."""
    import matplotlib

    matplotlib.use('Agg')
    # Imported first: warnings of the libraries that it loads do not concern the notebook.
    import matplotlib.pyplot  # noqa: F401

    namespace, cells = {'__name__': '__main__'}, []
    for number, (kind, text, line) in enumerate(read(path)):
        cell = {'cell_type': kind, 'id': f'cell-{number}', 'metadata': {},
                'source': text.splitlines(keepends=True)}
        if kind == 'code':
            count = 1 + sum(cell['cell_type'] == 'code' for cell in cells)
            with warnings.catch_warnings():
                warnings.simplefilter('error')
                outputs = _run(path, text, line, count, namespace)
            cell |= {'execution_count': count, 'outputs': outputs}
        cells.append(cell)
    kernel = {'display_name': 'Python 3', 'language': 'python', 'name': 'python3'}
    return {'cells': cells, 'metadata': {'kernelspec': kernel}, 'nbformat': 4, 'nbformat_minor': 5}


def _run(path, text, line, count, namespace):
    """Execute a cell and return its outputs."""
    tree = ast.parse(text, str(path))
    # A traceback then shows the lines of the source.
    ast.increment_lineno(tree, line - 1)
    last = tree.body.pop() if tree.body and isinstance(tree.body[-1], ast.Expr) else None
    value, printed, outputs = None, io.StringIO(), []
    with contextlib.redirect_stdout(printed):
        exec(compile(tree, str(path), 'exec'), namespace)
        if last:
            value = eval(compile(ast.Expression(last.value), str(path), 'eval'), namespace)
    if printed.getvalue():
        outputs.append({'output_type': 'stream', 'name': 'stdout',
                        'text': printed.getvalue().splitlines(keepends=True)})
    if value is not None and not text.endswith(';'):
        outputs.append({'output_type': 'execute_result', 'execution_count': count, 'metadata': {},
                        'data': {'text/plain': repr(value).splitlines(keepends=True)}})
    return outputs + _figures()


def _figures():
    """Return the open figures as outputs, and close them."""
    from matplotlib import pyplot

    outputs = []
    for number in pyplot.get_fignums():
        figure, file = pyplot.figure(number), io.BytesIO()
        # Without the version of Matplotlib, equal figures have equal files.
        figure.savefig(file, format='png', dpi=DPI, metadata={'Software': None})
        pyplot.close(figure)
        outputs.append({
            'output_type': 'display_data',
            'metadata': {'image/png': {'alt': figure.get_label()}},
            'data': {'image/png': base64.b64encode(file.getvalue()).decode()}})
    return outputs


def main(arguments=None):
    """Run the command line and return its exit code."""
    parser = argparse.ArgumentParser(
        prog='python3 docs/extensions/run_notebook.py', description='Execute a notebook.')
    parser.add_argument('source', type=Path, help='notebook in MyST Markdown')
    parser.add_argument('output', type=Path, help='file to write, in the format of Jupyter')
    options = parser.parse_args(arguments)
    text = json.dumps(execute(options.source), indent=1, ensure_ascii=False) + '\n'
    options.output.write_text(text, encoding='utf-8')
    return 0


if __name__ == '__main__':
    sys.exit(main())
