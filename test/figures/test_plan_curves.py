"""The curves of band plans: points, advice, and the commands with jobs replaced."""

import json

import numpy as np
import pytest

from rhs_isac_ros.codebook import random_codebook
from rhs_isac_ros.model import Scenario

pytest.importorskip('joblib')
pytest.importorskip('matplotlib')


@pytest.fixture(scope='module')
def synchronisation(load_figure):
    return load_figure('synchronisation')


@pytest.fixture(scope='module')
def curves(load_figure):
    return load_figure('curves')


@pytest.fixture
def parts(curves, monkeypatch):
    """The module of the jobs, with the jobs replaced by formulas."""
    from parts import plan_curves

    def optimise(scenario, steps):
        return plan_curves.plain(random_codebook(Scenario(**scenario), np.random.default_rng(0)))

    def locate(scenario, codebook, trial):
        made.append((Scenario(**scenario).id, trial))
        phase = Scenario(**scenario).band_phase_std_rad
        return {'squared_errors_m2': [0.1 + phase, 0.1 + phase]}

    made = []
    monkeypatch.setattr(plan_curves, 'choose', lambda n_bands, candidates: plan_curves.spaced(
        'unequal', n_bands))
    monkeypatch.setattr(plan_curves, 'optimise', optimise)
    monkeypatch.setattr(plan_curves, 'locate', locate)
    monkeypatch.setattr(plan_curves, 'bounds', lambda scenario, codebook, phases: {
        'crlb_m2': 0.01, 'bound_m2': 0.09, 'bound_error_m2': 0.001})
    plan_curves.made = made
    return plan_curves


@pytest.mark.parametrize('spacing', ['equal', 'unequal'])
@pytest.mark.parametrize('n_bands', [1, 2, 4, 8])
def test_plans_have_the_same_spectrum_and_pilots(parts, spacing, n_bands):
    scenario = Scenario(**parts.spaced(spacing, n_bands))
    assert scenario.n_bands * scenario.n_frames == 8
    assert 2.5e9 <= min(scenario.center_frequencies_hz)
    assert max(scenario.center_frequencies_hz) <= 3.0e9
    assert len(set(scenario.center_frequencies_hz)) == n_bands


def test_the_error_doubles_between_the_values(synchronisation):
    assert synchronisation.doubling((0, 1, 2), (1.0, 1.5, 2.5)) == 1.5
    assert synchronisation.doubling((0, 1), (1.0, 1.9)) == np.inf


def test_synchronisation_gives_advice_and_repeats_no_job(
        synchronisation, parts, tmp_path, capsys):
    call = ['--jobs', '1', '--output', str(tmp_path)]
    assert synchronisation.main(['--quick', *call]) == 0
    out = capsys.readouterr().out
    assert 'Table I): the squared error doubles at a phase of each band of 0.1 rad, no' in out
    assert 'With a uniform phase of each band, the error is 6.38 ± 0.00 m²' in out
    n = len(parts.made)
    # The point without errors is the same on all curves.
    assert n == len(set(parts.made)) == 3 * (7 + 3 + 4)
    assert synchronisation.main(['--quick', *call]) == 0
    assert len(parts.made) == n
    written = json.loads((tmp_path / 'synchronisation.json').read_text(encoding='utf-8'))
    assert len(written['points']) == 3 * (7 + 4 + 5)
    assert (tmp_path / 'synchronisation.png').stat().st_size > 10_000


def test_curves_write_a_figure_each(curves, parts, tmp_path, capsys):
    call = ['--quick', '--jobs', '1', '--output', str(tmp_path)]
    assert curves.main(['bands', 'rice', '--format', 'pdf', *call]) == 0
    assert {path.name for path in tmp_path.glob('*.p*')} == {'bands.pdf', 'rice.pdf'}
    assert 'Rice factor [dB]' in capsys.readouterr().out


def test_codebooks_get_the_power_of_the_scenario(curves, parts, tmp_path):
    call = ['--quick', '--jobs', '1', '--output', str(tmp_path)]
    assert curves.main(['power', *call]) == 0
    for file in (tmp_path / 'jobs').glob('errors-*.json'):
        case = json.loads(file.read_text(encoding='utf-8'))['arguments']
        parts.Codebook.from_parameters(case['codebook']).check(Scenario(**case['scenario']))


def test_the_picture_has_a_legend_for_every_line_and_intervals(curves, synchronisation):
    from parts import plan_report
    bands = curves.CURVES['bands']
    entries = [{'curve': 'bands', 'line': line, 'value': value, 'mse_m2': 0.5,
                'mse_error_m2': 0.4, 'crlb_m2': 0.04, 'bound_m2': 0.3, 'bound_error_m2': 0.01}
               for line in ('one', 'other') for value in bands.values]
    axes, above = plan_report.picture({'bands': bands}, entries).axes
    assert (axes.get_xlabel(), axes.get_yscale()) == (bands.label, 'log')
    legend = above.get_legend()
    assert [text.get_text() for text in legend.get_texts()] == [
        'one', 'other', 'global bound', 'root of the average CRLB']
    assert legend.get_title().get_text() == 'bars: intervals of two standard errors'
    # The interval ends at zero at the lowest.
    middle, ends = plan_report.roots(entries[:1], 'mse_m2')
    np.testing.assert_allclose([middle[0] - ends[0, 0], middle[0] + ends[1, 0]],
                               [0, np.sqrt(1.3)])
    assert plan_report.roots(entries, 'crlb_m2')[1] is None

    only = {'timing_std_s': synchronisation.CURVES['timing_std_s']}
    entries = [{'curve': 'timing_std_s', 'line': 'one', 'value': value, 'mse_m2': 0.5,
                'mse_error_m2': 0.1} for value in only['timing_std_s'].values]
    axes, above = plan_report.picture(only, entries).axes
    assert axes.get_yscale() == 'linear' and axes.get_ylim()[0] == 0
    assert [text.get_text() for text in above.get_legend().get_texts()] == ['one']


def test_an_unknown_curve_is_an_error(curves):
    with pytest.raises(SystemExit, match='NAME: fame, expected some of bands, pilots'):
        curves.main(['fame'])


def test_the_optimiser_of_plans_chooses_bands(parts, monkeypatch):
    monkeypatch.undo()
    monkeypatch.setattr('rhs_isac_ros.codebook.band_plan._short_error', lambda scenario, seed: max(
        scenario.center_frequencies_hz))
    chosen = parts.choose(2, 2)
    assert chosen['n_frames'] == 4
    low, high = chosen['center_frequencies_hz']
    assert 2.5e9 <= low < high <= 3.0e9


def test_jobs_locate_and_bound(parts, monkeypatch):
    monkeypatch.undo()
    small = {'elements_per_side': 4, 'n_subbands': 2, 'n_frames': 1, 'n_feeds': 2}
    codebook = parts.plain(random_codebook(Scenario(**small), np.random.default_rng(0)))
    monkeypatch.setattr(parts, 'BLOCK', 4)
    errors = parts.locate(small, codebook, 1)['squared_errors_m2']
    assert len(errors) == 4
    assert max(errors) > 0
    result = parts.bounds(small, codebook, 16)
    assert 0 < result['crlb_m2']
    assert 0 < result['bound_error_m2'] < result['bound_m2'] < 17
