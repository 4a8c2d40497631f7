"""Errors of synchronisation: plans, advice, and the command with jobs replaced."""

import csv

import numpy as np
import pytest

from rhs_isac_ros.codebook import default_codebook_file, random_codebook
from rhs_isac_ros.experiments import sweep
from rhs_isac_ros.model import Scenario

for library in ('joblib', 'matplotlib'):
    pytest.importorskip(library)
from figures import synchronisation as figure  # noqa: E402


@pytest.fixture
def located(monkeypatch):
    """The blocks that were located, with the jobs replaced by formulas."""
    def evaluate(family, scenario, codebook, seed, first, n, estimator):
        record((Scenario(**scenario).id, first))
        return {'squared_error_m2': [0.1 + Scenario(**scenario).band_phase_std_rad] * n}

    made = []
    record = made.append
    monkeypatch.setattr(sweep, 'design', lambda scenario, **_: random_codebook(
        Scenario(**scenario), np.random.default_rng(0)).to_parameters())
    monkeypatch.setattr(sweep, 'evaluate', evaluate)
    return made


def test_plans_have_the_same_spectrum_and_pilots():
    for plan in figure.PLANS.values():
        scenario = Scenario(**plan.changes)
        assert scenario.n_bands * scenario.n_frames == 8
        assert 2.5e9 == min(scenario.center_frequencies_hz)
        assert 3.0e9 == max(scenario.center_frequencies_hz)


def test_the_error_doubles_between_the_values():
    assert figure.doubling((0, 1, 2), (1.0, 1.5, 2.5)) == 1.5
    assert figure.doubling((0, 1), (1.0, 1.9)) == np.inf


def test_codebooks_are_optimised_without_the_errors():
    planned = figure.sweep_of(figure.PLANS, 1, 10)
    designs = {job.name for setting in planned.settings for job in planned.designs(setting)}
    assert len(designs) == 3
    for setting in planned.settings:
        assert planned.scenario_of_codebook(setting).changes().keys() <= {
            'center_frequencies_hz', 'n_frames'}


@pytest.mark.slow
def test_the_command_gives_advice_and_repeats_no_job(located, tmp_path, capsys):
    call = ['--quick', '--jobs', '1', '--output', str(tmp_path)]
    assert figure.main(call) == 0
    out = capsys.readouterr().out
    assert 'Table I): the squared error doubles at a phase of a band of 0.1 rad, no' in out
    assert 'With a uniform phase of each band, the error is 6.38 [6.38, 6.38] m²' in out
    n = len(located)
    # The point without errors is the same on all curves.
    assert n == len(set(located)) == 3 * (7 + 3 + 4)
    assert figure.main([*call, '--format', 'pdf']) == 0
    assert len(located) == n
    with open(tmp_path / 'synchronisation.csv', encoding='utf-8') as stream:
        assert len([*csv.DictReader(stream)]) == 3 * (7 + 4 + 5) * len(figure.MEASURES)
    assert {path.name for path in tmp_path.glob('*.p*')} == {
        'synchronisation.png', 'synchronisation.pdf'}


@pytest.mark.parametrize(('plans', 'expected'), [
    ([('quick', 'codebook')], 'codebook.yaml: analog: shape'),
    ([('codebook', 'codebook')], 'codebook.yaml: /**/optimizer: unknown field'),
    ([('bandplan', 'quick')], 'quick.yaml: expected ros__parameters'),
    ([('bandplan', 'codebook_bandplan')] * 2, 'bandplan more than once')])
def test_a_plan_is_checked_before_anything_runs(plans, expected, capsys):
    config = default_codebook_file().parent
    options = [part for plan in plans for part in (
        '--plan', *(str(config / f'{name}.yaml') for name in plan))]
    with pytest.raises(SystemExit, match='2'):
        figure.main(options)
    errors = capsys.readouterr().err
    assert 'argument --plan: ' in errors and expected in errors
    assert len(errors.splitlines()) == 1
