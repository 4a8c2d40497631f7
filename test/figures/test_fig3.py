"""Fig. 3: a trial, the report of synthetic trials, and the command."""

import json
import math
import os

import numpy as np
import pytest

from rhs_isac_ros.bounds import crlb
from rhs_isac_ros.codebook import random_codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.support import streams

for library in ('pymoo', 'joblib', 'matplotlib'):
    pytest.importorskip(library)
from figures import fig3  # noqa: E402


@pytest.fixture(scope='module')
def entries():
    """Synthetic trials in which all claims of the paper hold."""
    level = {'alternating': 1.0, 'direct': 2.0, 'genetic': 3.0, 'lbfgs': 0.5}
    return [{'method': method, 'n_bands': n, 'seed': seed, 'seconds': level[method],
             'crlb_m2': level[method] * (1 + 0.01 * seed) - (method == 'alternating') * n / 10,
             'held_out_m2': level[method], 'evaluations': 1}
            for seed in range(3) for n in fig3.BANDS for method in fig3.METHODS]


def verdicts(summary):
    return ['does not hold' not in claim for claim in summary.claims()]


def test_all_claims_hold_for_the_synthetic_trials(entries):
    assert verdicts(fig3.Summary(entries)) == [True] * 4


@pytest.mark.parametrize(('changes', 'expected'), [
    ({'crlb_m2': 5.0}, [False, True, False, False]),
    ({'seconds': 2.5}, [True, False, True, True])])
def test_one_number_of_bands_can_refute_a_claim(
        entries, changes, expected):
    changed = [entry | changes if (entry['method'], entry['n_bands']) == ('alternating', 4)
               else entry for entry in entries]
    assert verdicts(fig3.Summary(changed)) == expected


def test_a_relative_lead_may_grow_while_the_absolute_one_shrinks():
    own = dict(zip(fig3.BANDS, (1.0, 0.6, 0.3, 0.1), strict=True))
    lead = dict(zip(fig3.BANDS, (0.5, 0.4, 0.3, 0.2), strict=True))
    trials = [{'method': method, 'n_bands': n, 'seed': 0, 'seconds': 1.0,
               'crlb_m2': own[n] + (lead[n] if method != 'alternating' else 0)}
              for n in fig3.BANDS for method in fig3.METHODS]
    claim = fig3.Summary(trials).claims()[3]
    assert 'absolute lead: does not hold over direct, 0.5000, 0.4000, 0.3000, 0.2000 m²' in claim
    assert 'relative to the rival: holds over direct, 33, 40, 50, 67 %' in claim


def test_the_table_has_a_row_for_each_method_and_number_of_bands(entries):
    rows = fig3.Summary(entries).table().splitlines()[2:]
    assert len(rows) == len(fig3.METHODS) * len(fig3.BANDS)
    first = [cell.strip() for cell in rows[0].strip('|').split('|')]
    assert first == ['alternating', '1', '0.910 ± 0.010', '1.00 ± 0.00', '1.00', '1.00 ± 0.00',
                     '1.00 ± 0.00']


def test_a_trial_optimises_with_its_arguments():
    result = fig3.trial('lbfgs', 2, 5, samples=6, held_out=50, max_steps=3)
    assert (result['steps'], result['reason']) == (3, 'max_steps reached')
    scenario = Scenario(center_frequencies_hz=(2.5e9, 3.0e9), n_frames=4)
    samples = scenario.sample_positions(6, streams.generator(5, streams.SAMPLES))
    start = random_codebook(scenario, streams.generator(5, streams.START))
    assert result['crlb_m2'] < crlb(scenario, start, samples).mean()
    assert result['seconds'] > 0


def test_the_command_writes_all_files_and_repeats_no_finished_trial(
        tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(fig3, 'METHODS', ('alternating', 'direct', 'genetic'))
    monkeypatch.setattr(fig3, 'BANDS', (1, 2))
    made = []
    record = made.append

    def trial(method, n_bands, seed, samples, held_out, max_steps):
        record((method, n_bands, seed))
        return {'crlb_m2': 1.0 / n_bands, 'held_out_m2': 1.0, 'seconds': 1.0}
    monkeypatch.setattr(fig3, 'trial', trial)
    call = ['--jobs', '1', '--output', str(tmp_path)]
    assert fig3.main(['--trials', '1', *call]) == 0
    assert len(made) == 6
    assert fig3.main(['--trials', '2', *call]) == 0
    # Six more; the results of the first trial are reused.
    assert len(made) == len(set(made)) == 12
    assert {'fig3.json', 'fig3.md', 'fig3.png'} <= set(os.listdir(tmp_path))
    assert fig3.main(['--trials', '2', '--format', 'svg', *call]) == 0
    assert len(made) == 12
    assert (tmp_path / 'fig3.svg').read_bytes().startswith(b'<?xml')
    assert '(fig3.svg)' in (tmp_path / 'fig3.md').read_text(encoding='utf-8')
    figures = json.loads((tmp_path / 'fig3.json').read_text(encoding='utf-8'))
    assert len(figures['trials']) == 12
    out = capsys.readouterr().out
    assert '(1) alternating reaches a lower CRLB' in out
    assert np.all([entry['samples'] == 10 for entry in figures['trials']])


def test_mean_and_std_are_those_of_a_sample():
    mean, std = fig3.mean_and_std([1.0, 2.0, 6.0])
    assert mean == 3.0
    assert std == pytest.approx(math.sqrt((4 + 1 + 9) / 2))


@pytest.mark.parametrize('values', [[2.0], [1.0, math.inf], [math.inf, math.inf]])
def test_an_undefined_deviation_is_nan(values):
    mean, std = fig3.mean_and_std(values)
    assert mean == np.mean(values)
    assert math.isnan(std)


@pytest.mark.parametrize(('mean', 'std', 'text'), [
    (0.04057, 0.00123, '0.0406 ± 0.0012'), (12.345, 0.5, '12.3 ± 0.5'), (1234.5, 7.0, '1234 ± 7'),
    (0.0, 0.0, '0.00 ± 0.00'), (-0.0512, math.nan, '-0.0512'), (math.inf, math.nan, 'inf')])
def test_mean_and_deviation_have_the_same_places(mean, std, text):
    assert fig3.plus_minus(mean, std) == text
