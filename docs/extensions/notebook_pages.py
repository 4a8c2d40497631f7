"""Notebooks as pages: the directive ``code-cell`` shows a cell with its outputs.

Every notebook in ``docs/notebooks`` is executed when a build begins. A cell that fails or causes a
warning ends the build. The page links to the executed notebook in Jupyter's format.

``sphinx-build -D notebook_folder=FOLDER`` uses the executed notebooks in a folder, if they are of
the same sources.
"""

import base64
import json
import os
import shutil
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import run_notebook
from docutils import nodes
from pictures import image_node
from sphinx.errors import ExtensionError
from sphinx.util.docutils import SphinxDirective

_FOLDER = 'notebooks'


def run(source, target):
    """Execute a notebook in a process of its own; ExtensionError if it prints an error."""
    done = subprocess.run(
        [sys.executable, run_notebook.__file__, source, target],
        stdin=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, check=False,
        env={**os.environ, 'OPENBLAS_NUM_THREADS': '1'})
    if done.returncode or done.stderr:
        raise ExtensionError(f'{source}: {done.stderr or done.returncode}')


def _execute_all(app):
    """Execute the notebooks that are not in the folder yet."""
    folder = Path(app.config.notebook_folder or Path(app.doctreedir) / _FOLDER)
    folder.mkdir(parents=True, exist_ok=True)
    sources = sorted((Path(app.srcdir) / _FOLDER).glob('*.md'))
    targets = [folder / f'{source.stem}.ipynb' for source in sources]
    new = [pair for pair in zip(sources, targets, strict=True) if not _is_of(*pair)]
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        list(pool.map(lambda pair: run(*pair), new))
    app.notebooks = {f'{_FOLDER}/{target.stem}': target for target in targets}


def _is_of(source, target):
    if not target.is_file():
        return False
    cells = json.loads(target.read_text(encoding='utf-8'))['cells']
    texts = [text for _, text, _ in run_notebook.read(source)]
    return [''.join(cell['source']) for cell in cells] == texts


class CodeCell(SphinxDirective):
    """A code cell with its outputs."""

    has_content = True
    optional_arguments = 1

    def run(self):
        """Return the nodes."""
        text = '\n'.join(self.content)
        block = nodes.literal_block(text, text, language='python')
        document = self.state.document
        number = document.n_code_cells = getattr(document, 'n_code_cells', 0) + 1
        path = self.env.app.notebooks[self.env.docname]
        (cell,) = [cell for cell in json.loads(path.read_text(encoding='utf-8'))['cells']
                   if cell.get('execution_count') == number]
        return [block, *(self._output(output, path.with_suffix(f'.{number}.{place}.png'))
                         for place, output in enumerate(cell['outputs'], 1))]

    def _output(self, output, file):
        if output['output_type'] == 'display_data':
            file.write_bytes(base64.b64decode(output['data']['image/png']))
            return image_node(self, file, output['metadata']['image/png']['alt'])
        text = ''.join(output.get('text') or output['data']['text/plain'])
        return nodes.literal_block(text, text, language='none', classes=['cell-output'])


def _add_link(app, document):
    """Add a link to the executed notebook below the title of its page."""
    path = app.notebooks.get(app.env.docname)
    if path:
        link = (f'<p class="notebook-link"><a href="{path.name}" download>Download as a Jupyter '
                'notebook</a></p>')
        (title, *_) = document.findall(nodes.title)
        title.parent.insert(title.parent.index(title) + 1, nodes.raw('', link, format='html'))


def _copy(app, error):
    if error is None and app.builder.format == 'html':
        for path in app.notebooks.values():
            shutil.copy(path, Path(app.outdir) / _FOLDER)


def setup(app):
    """Register the directive, and execute notebooks when a build begins."""
    app.add_config_value('notebook_folder', '', 'env')
    app.add_directive('code-cell', CodeCell)
    app.connect('builder-inited', _execute_all)
    app.connect('doctree-read', _add_link)
    app.connect('build-finished', _copy)
    return {'parallel_read_safe': True, 'parallel_write_safe': True}
