"""Fig. 4: the command with few pairs and positions, and the report of synthetic results."""

import csv
import os

import numpy as np
import pytest

pytest.importorskip('sklearn')
pytest.importorskip('joblib')
pytest.importorskip('matplotlib')


@pytest.fixture(scope='module')
def fig4(load_figure):
    return load_figure('fig4')


@pytest.fixture(scope='module')
def report(fig4):
    from parts import fig4_report
    return fig4_report


@pytest.fixture
def summary(report):
    """Synthetic results: those of `optimised` are half of directional's, a third of random's."""
    level = {'optimised': 6.0, 'ambiguity': 3.0, 'directional': 12.0, 'random': 18.0}
    shape = np.random.default_rng(0).exponential(size=(400, 3))
    return report.Summary(
        list(level),
        {(estimator, name): value * np.array([1.0, 1.1] if estimator == 'neural' else [0.5])
         for estimator in report.ESTIMATORS for name, value in level.items()},
        {f'{estimator} {name}': value * shape
         for estimator in report.ESTIMATORS for name, value in level.items()})


def cells(row):
    return [cell.strip() for cell in row.strip('|').split('|')]


def test_the_table_of_claims_has_the_measured_reductions(summary):
    rows = [cells(row) for row in summary.claims().splitlines()[2:]]
    assert [row[1] for row in rows] == ['42 %', '69 %', '82 %', '86 %', '50 %', '64 %']
    for row, less in zip(rows, [50, 67, 50, 67, 50, 67], strict=True):
        assert row[2:4] == [f'{less} % [{less}, {less}]'] * 2
    assert [row[4].split()[0] for row in rows] == ['75', '83'] * 3


def test_the_table_has_a_row_for_each_pair(summary):
    rows = [cells(row) for row in summary.table().splitlines()[2:]]
    assert len(rows) == 8
    assert rows[0][:3] == ['neural, optimised', '6.300 ± 0.424', '6.000']
    assert rows[4][:3] == ['bayes, optimised', '3.000', '3.000']


def test_the_data_are_available_as_csv(report, summary):
    tables = report.tables(summary)
    rows = list(csv.DictReader(tables['fig4b.csv'].splitlines()))
    assert len(rows) == 8 * 400
    assert float(rows[0]['loss_bps']) == pytest.approx(
        summary.losses['neural optimised'][0, 0], rel=1e-5)
    assert len(tables['fig4a.csv'].splitlines()) == 1 + 4 * 3


def test_the_picture_is_drawn(report, summary):
    assert report.picture(summary).startswith(b'\x89PNG')


def test_the_command_writes_all_files_and_repeats_no_job(fig4, tmp_path, capsys):
    call = ['--trials', '1', '--pairs', '200', '--positions', '4', '--jobs', '1',
            '--output', str(tmp_path)]
    assert fig4.main(call) == 0
    out = capsys.readouterr().out
    assert 'neural, optimised' in out and 'bayes, ambiguity' in out
    assert {'fig4.md', 'fig4.png', 'fig4a.csv', 'fig4b.csv'} <= set(os.listdir(tmp_path))
    jobs = {path.name: path.stat().st_mtime_ns for path in (tmp_path / 'jobs').iterdir()}
    assert len(jobs) == 4 + 4 + 1
    assert fig4.main(call) == 0
    assert capsys.readouterr().out == out
    # No job was repeated.
    assert jobs == {path.name: path.stat().st_mtime_ns for path in (tmp_path / 'jobs').iterdir()}


def test_capacity_losses_depend_on_the_estimates(fig4):
    truth, _ = fig4.simulate_pairs(
        fig4.Scenario(), fig4.directional_codebook(fig4.Scenario()), 2, fig4.TEST_SEED, 3)
    still = np.zeros((2, 3, 3)).tolist()
    losses = fig4.capacity_losses(3, {
        'right': {'means': truth.tolist(), 'covariances': still},
        'wrong': {'means': (truth + [0, 2, 0]).tolist(), 'covariances': still}})
    assert np.allclose(losses['right'], 0)
    assert (np.array(losses['wrong']) > 0).all()
