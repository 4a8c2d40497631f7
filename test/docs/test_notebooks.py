"""The notebooks run without a warning, and their results agree with their text."""

import base64
import importlib.util
import io
import json
import re
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip('matplotlib', reason='Matplotlib is not installed')

DOCS = Path(__file__).parents[2] / 'docs'
NOTEBOOKS = sorted(path.stem for path in (DOCS / 'notebooks').glob('*.md'))


def run_notebook():
    spec = importlib.util.spec_from_file_location(
        'run_notebook', DOCS / 'extensions' / 'run_notebook.py')
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def outputs(notebooks, name, kind):
    cells = json.loads((notebooks[1] / f'{name}.ipynb').read_text(encoding='utf-8'))['cells']
    return [output for cell in cells for output in cell.get('outputs', ())
            if output['output_type'] == kind]


def printed(notebooks, name):
    return ''.join(line for output in outputs(notebooks, name, 'stream')
                   for line in output['text'])


def numbers(pattern, text):
    """Groups of the only match of a pattern, as numbers."""
    (found,) = re.findall(pattern, text)
    return [float(group) for group in ([found] if isinstance(found, str) else found)]


@pytest.mark.parametrize('name', NOTEBOOKS)
def test_a_notebook_runs_without_an_error_or_a_warning(notebooks, name):
    done = notebooks[0][name]
    assert (done.returncode, done.stdout, done.stderr) == (0, '', '')


@pytest.mark.parametrize('name', NOTEBOOKS)
def test_a_notebook_draws_pictures_with_descriptions(notebooks, name):
    from matplotlib.pyplot import imread

    pictures = outputs(notebooks, name, 'display_data')
    assert len(pictures) >= 2
    for picture in pictures:
        pixels = imread(io.BytesIO(base64.b64decode(picture['data']['image/png'])))
        # Marks on white paper.
        dark = np.mean(pixels[..., :3].min(axis=2) < 0.9)
        assert 0.01 < dark < 0.9
        assert len(picture['metadata']['image/png']['alt']) > 20


@pytest.mark.parametrize('name', NOTEBOOKS)
def test_a_notebook_shows_no_objects(notebooks, name):
    assert not outputs(notebooks, name, 'execute_result')


@pytest.mark.parametrize('name', NOTEBOOKS)
def test_jupytext_recognises_the_notebook(name):
    text = (DOCS / 'notebooks' / f'{name}.md').read_text(encoding='utf-8')
    assert re.match(r'---\njupytext:\n.*?format_name: myst\nkernelspec:\n.*?\n---\n', text,
                    re.DOTALL)


def test_the_first_fix_is_between_its_bounds_and_its_modes_are_ambiguities(notebooks):
    text = printed(notebooks, 'first_fix')
    distances = [float(number) for number in re.findall(r', (\S+) m from the user', text)]
    assert len(distances) >= 3
    for distance in distances:
        # Multiples of the range at which two bands 0.5 GHz apart repeat.
        assert abs(distance / 0.6 - round(distance / 0.6)) < 0.35
    error, margin = numbers(r'mean squared error +(\S+) ± (\S+) m²', text)
    bound, bound_margin = numbers(r'global bound +(\S+) ± (\S+) m²', text)
    local, _ = numbers(r'Cramér-Rao bound +(\S+) ± (\S+) m²', text)
    assert error > 5 * local
    assert abs(error - bound) < 2 * (margin + bound_margin)
    assert abs(numbers(r'loss due to the position error (\S+) %', text)[0]) < 5


def test_the_band_plan_has_the_smallest_error(notebooks):
    rows = {name: (float(error), float(margin), float(bound)) for name, error, margin, bound in
            re.findall(r'^(\w+(?: \w+)?) +mean squared error (\S+) ± (\S+) m².* (\S+) m²$',
                       printed(notebooks, 'own_codebook'), re.MULTILINE)}
    assert rows.keys() == {'random', 'crlb', 'error', 'four bands'}
    assert rows['crlb'][2] < rows['random'][2] / 2
    assert rows['crlb'][0] > 0.6 * rows['random'][0]
    assert rows['four bands'][0] < 0.75 * rows['error'][0] < rows['crlb'][0]


def test_the_calibration_restores_the_fixes_of_all_users(notebooks):
    text = printed(notebooks, 'calibration')
    (failed,) = re.findall(r'^failed elements: (.*)$', text, re.MULTILINE)
    assert f'failed elements found: {failed}\n' in text
    assert 'before: 0 of 500 users with a fix' in text
    assert 'deviates\n' in text
    assert 'after: 500 of 500 users with a fix' in text
    (after,) = re.findall(r'after.*as expected\n +mean squared error (\S+) ±.*m², (\S+) %', text)
    (ideal,) = set(re.findall(r'ideal.*\n +mean squared error (\S+) ±.*m², \S+ %', text))
    assert float(ideal) <= float(after[0]) < 2 * float(ideal)
    assert float(after[1]) > 85


def test_an_error_names_the_line_of_the_source(tmp_path):
    source = tmp_path / 'bad.md'
    source.write_text('# Title\n\n```{code-cell}\nvalue = 1\n\nvalue / 0\n```\n')
    with pytest.raises(ZeroDivisionError) as raised:
        run_notebook().execute(source)
    assert raised.traceback[-1].lineno + 1 == 6


def test_a_warning_is_an_error(tmp_path):
    source = tmp_path / 'bad.md'
    source.write_text('```{code-cell}\nimport warnings\nwarnings.warn("bad")\n```\n')
    with pytest.raises(UserWarning, match='bad'):
        run_notebook().execute(source)


def test_outputs_are_those_of_jupyter(tmp_path):
    source = tmp_path / 'short.md'
    source.write_text('---\nkernelspec:\n---\n\nText\n\n```{code-cell}\nprint(1)\n2\n```\n\n'
                      '```{code-cell}\n3;\n```\n')
    cells = run_notebook().execute(source)['cells']
    assert [cell['cell_type'] for cell in cells] == ['markdown', 'code', 'code']
    assert [output.get('text') or output['data']['text/plain']
            for output in cells[1]['outputs']] == [['1\n'], ['2']]
    assert cells[2]['outputs'] == []
