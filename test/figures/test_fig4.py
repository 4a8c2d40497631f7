"""Fig. 4: the command with few pairs and positions, and the report of synthetic results."""

import argparse
import csv
import functools
import os

import numpy as np
import pytest
from parts import fig4_report

from rhs_isac_ros.model import Scenario

for library in ('sklearn', 'joblib', 'matplotlib'):
    pytest.importorskip(library)
from figures import fig4  # noqa: E402

# Mean squared errors of the synthetic results [m^2]: 50 % below scan-width, 70 % below random.
LEVELS = {'algorithm-1': 3.0, 'crlb': 3.0, 'ambiguity': 1.5, 'scan-width': 6.0,
          'scan-per-band': 5.18, 'scan-grid': 4.0, 'random': 10.0}


@pytest.fixture(scope='module')
def results():
    """Synthetic results of a network: errors and losses of every row at 10 000 positions."""
    return synthetic(10_000, 3)


def synthetic(n, trials, losses=60):
    rng = np.random.default_rng(0)
    truth, condition = rng.uniform(size=(n, 3)), fig4.Condition('neural', 'parts', 0.0)
    errors, results = rng.normal(size=(n, 3)) / np.sqrt(3), fig4.Results(truth)
    for row, level in LEVELS.items():
        for trial in range(trials):
            means = truth + np.sqrt(level * (1 + 0.002 * trial)) * errors
            results.add(condition, row, {
                'means': means, 'validation_mse_m2': abs(trial - 1.0), 'without_fix': 1}, 0, 1)
        results.add_losses(condition, row, level * np.abs(errors[:losses, 0]))
    return results


def cells(row):
    return [cell.strip() for cell in row.strip('|').split('|')]


@pytest.mark.parametrize(('interval', 'positions', 'trainings', 'expected'), [
    ((43, 50), 10_000, 2, 'holds'), ((42, 50), 10_000, 2, 'holds'),
    ((40, 44), 10_000, 2, 'undecided'), ((30, 41), 10_000, 2, 'does not hold'),
    ((43, 50), 9_999, 2, 'too few positions'), ((43, 50), 10_000, 1, 'too few trainings')])
def test_a_verdict_follows_from_the_interval_of_enough_results(
        interval, positions, trainings, expected):
    assert fig4_report.verdict(42, *interval, positions, trainings) == expected


def test_the_claims_have_the_measured_reductions(results):
    (condition,) = results.conditions
    for benchmark, claimed, percent, expected in (
            ('scan-width', 42, 50, 'holds'), ('scan-per-band', 42, 42, 'undecided'),
            ('scan-grid', 42, 25, 'does not hold'), ('random', 69, 70, 'holds')):
        error = fig4_report.finding(
            results, condition, 'error', 'algorithm-1', benchmark, claimed)
        assert error.percent == pytest.approx(percent, abs=0.3)
        assert error.low < error.percent < error.high
        assert error.verdict == expected
    loss = fig4_report.finding(results, condition, 'median loss', 'ambiguity', 'random', 86)
    assert loss.percent == pytest.approx(85, abs=1)
    assert loss.verdict == 'too few positions'
    header, _, *rows = map(cells, fig4_report.claims_table(
        results, {'one': (condition, 'crlb'), 'other': (condition, 'ambiguity')}).splitlines())
    assert header == ['claim', 'one', 'other']
    assert ['median capacity loss 86 % below random', str(loss)] in [row[::2] for row in rows]
    assert len(rows) == 12


def test_the_best_training_is_that_of_the_smallest_validation_error(results):
    condition = results.conditions[0]
    np.testing.assert_array_equal(
        results.best_estimates(condition, 'crlb'), results.estimates[condition, 'crlb'][1])
    # The codebooks of this row differ, so that all trials serve positions.
    best = results.best_estimates(condition, 'random')
    for trial in range(3):
        np.testing.assert_array_equal(
            best[trial::3], results.estimates[condition, 'random'][trial, trial::3])


def test_trials_may_share_the_positions():
    truth, condition = np.zeros((25, 3)), fig4.Condition('bayes', '', 0.0)
    results = fig4.Results(truth)
    for trial, size in enumerate((13, 12)):
        results.add(condition, 'random', {
            'means': np.full((size, 3), trial + 1.0), 'validation_mse_m2': 0.0,
            'without_fix': 1}, trial, 2)
    best = results.best_estimates(condition, 'random')
    assert best[:5, 0].tolist() == [1, 2, 1, 2, 1]
    assert results.statistics(condition, 'random')['error'].values[0] == pytest.approx(
        (13 * 3 + 12 * 12) / 25)
    assert results.without_fix[condition, 'random'] == 2


def test_the_report_has_tables_picture_and_data(results, tmp_path, capsys):
    options = argparse.Namespace(trials=3, pairs=7, output=tmp_path, format='png')
    fig4_report.write(results, options)
    out = capsys.readouterr().out
    assert '10000 test positions; 3 trainings with 7 pairs' in out
    assert out.count('## Claims about ') == out.count('## Claims about algorithm-1\n') == 1
    tables = [cells(line) for line in out.splitlines() if line.startswith('| scan-grid ')]
    assert [row[0] for row in tables] == ['scan-grid']
    assert float(tables[0][1].split()[0]) == pytest.approx(4.0, rel=0.05)
    assert tables[0][3] == '3'
    assert (tmp_path / 'fig4.png').read_bytes().startswith(b'\x89PNG')
    rows = list(csv.DictReader((tmp_path / 'fig4b.csv').read_text().splitlines()))
    assert len(rows) == len(LEVELS) * 60
    assert float(rows[0]['loss_bps']) == pytest.approx(
        results.losses[results.conditions[0], 'algorithm-1'][0, 0], rel=1e-5)
    assert len((tmp_path / 'fig4a.csv').read_text().splitlines()) == 1 + len(LEVELS) * 3


@pytest.mark.parametrize('text', ['bayes', 'ml:0', 'parts:', 'parts:nan', 'parts:x'])
def test_an_invalid_condition_is_refused(text, capsys):
    with pytest.raises(SystemExit):
        fig4.main(['--conditions', text])
    assert (f"argument --conditions: '{text}', expected magnitudes, parts or bayes, a colon and"
            in capsys.readouterr().err)


@pytest.mark.parametrize(('arguments', 'conditions'), [
    ([], ['magnitudes-+0dB', 'magnitudes--30dB', 'parts-+0dB', 'parts--30dB', 'bayes-+0dB',
          'bayes--30dB']),
    (['--conditions', 'bayes:-20'], ['bayes--20dB']),
    (['--conditions', 'magnitudes:-30', 'bayes:0'], ['magnitudes--30dB', 'bayes-+0dB']),
    (['--quick'], ['parts-+0dB', 'magnitudes--30dB', 'bayes-+0dB', 'bayes--30dB'])])
def test_options_select_the_conditions(monkeypatch, arguments, conditions):
    seen = []
    monkeypatch.setattr(fig4, 'reproduce', seen.append)
    assert fig4.main(arguments) == 0
    assert [condition.slug for condition in seen[0].conditions] == conditions
    assert seen[0].rows == (fig4.QUICK_ROWS if '--quick' in arguments else fig4.ROWS)


def test_the_command_writes_all_files_and_repeats_no_job(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(fig4, 'optimize', functools.partial(fig4.optimize, max_steps=8))
    monkeypatch.setattr(fig4, 'SAMPLES', 4)
    monkeypatch.setattr(fig4, 'MIN_DRAWS', 2)
    call = ['--trials', '1', '--pairs', '200', '--positions', '6', '--losses', '2', '--rows',
            'algorithm-1', 'random', '--conditions', 'magnitudes:-30',
            '--jobs', '1', '--output', str(tmp_path)]
    assert fig4.main(call) == 0
    out = capsys.readouterr().out
    assert 'network, magnitudes, -30 dB' in out and 'too few positions' in out
    assert {'fig4.md', 'fig4.png', 'fig4a.csv', 'fig4b.csv'} <= set(os.listdir(tmp_path))
    jobs = {path.name: path.stat().st_mtime_ns for path in (tmp_path / 'jobs').iterdir()}
    # An optimisation, three trials and a block of losses.
    assert len(jobs) == 1 + 3 + 1
    assert fig4.main(call) == 0
    assert capsys.readouterr().out == out
    # No job was repeated.
    assert jobs == {path.name: path.stat().st_mtime_ns for path in (tmp_path / 'jobs').iterdir()}


def test_trials_of_bayes_locate_their_share_of_the_positions():
    world = Scenario(multipath_to_los_db=-30.0)
    book = fig4.directional_codebook(world).to_parameters()
    located = fig4.locate('bayes', '', world.changes(), book, 0, 0, 6, 1, 2)
    truth, _ = fig4.System(world, fig4.directional_codebook(world)).pairs(6, fig4.TEST_SEED)
    assert located['without_fix'] == 0
    np.testing.assert_allclose(located['means'], truth[1::2], atol=0.2)


def test_capacity_losses_depend_on_the_estimates():
    world = Scenario()
    truth, _ = fig4.System(world, fig4.directional_codebook(world)).pairs(2, fig4.TEST_SEED, 3)
    losses = fig4.capacity_losses({}, 3, {
        'right': truth.tolist(), 'wrong': (truth + [0, 2, 0]).tolist()})
    assert np.allclose(losses['right'], 0)
    assert (np.array(losses['wrong']) > 0).all()
