"""The command: the same files however the jobs run, and errors before anything runs."""

import csv

import pytest

from rhs_isac_ros.experiments import __main__
from rhs_isac_ros.experiments import sweep as sweep_module

pytest.importorskip('joblib')
pytest.importorskip('matplotlib')

SMALL = 'elements_per_side: 4\nn_subbands: 2\nn_feeds: 2\nn_frames: 1\n'
FILES = ('sweep.csv', 'sweep.png')


@pytest.fixture
def sweep(tmp_path, monkeypatch):
    """Callable that runs a sweep of two settings in a folder, and returns its exit code."""
    monkeypatch.chdir(tmp_path)
    # Two blocks of positions, the second one shorter.
    monkeypatch.setattr(sweep_module, 'BLOCK', 10)
    (tmp_path / 'small.yaml').write_text(SMALL, encoding='utf-8')

    def run(folder, *options):
        return __main__.main([
            'sweep', '--scenario', 'small.yaml', '--vary', 'n_frames=1,2', '--measure',
            'crlb,mse', '--codebook', 'random', '--positions', '12', '--output', folder,
            *options])
    return run


def files(folder):
    return [(folder / name).read_bytes() for name in FILES]


@pytest.mark.slow
def test_a_cluster_and_an_interrupted_run_write_the_same_files(
        sweep, tmp_path, monkeypatch, capsys):
    distributed = pytest.importorskip('distributed')
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, processes=False,
                                  dashboard_address=':0') as cluster:
        # Addresses in the same process are no HOST:PORT.
        monkeypatch.setattr('rhs_isac_ros.support.job_commands._address', str)
        assert sweep('dask', '--dask', cluster.scheduler_address) == 0
    shown = capsys.readouterr().out
    assert 'written: dask/sweep.csv and dask/sweep.png' in shown
    assert '| n_frames | ' in shown

    done = []

    def stop(**arguments):
        if len(done) == 5:
            raise KeyboardInterrupt
        done.append(arguments)
        return evaluate(**arguments)

    evaluate = sweep_module.evaluate
    with monkeypatch.context() as patch:
        patch.setattr(sweep_module, 'evaluate', stop)
        assert sweep('again', '--jobs', '1') == 130
    assert not (tmp_path / 'again' / 'sweep.csv').exists()
    n_before = len(list((tmp_path / 'again' / 'jobs').iterdir()))
    assert n_before == 2 + 5
    assert sweep('again', '--jobs', '1') == 0
    assert files(tmp_path / 'again') == files(tmp_path / 'dask')


@pytest.mark.slow
def test_every_setting_and_measure_has_a_row(sweep, tmp_path):
    assert sweep('folder', '--jobs', '1', '--codebook', 'optimize', '--objective', 'crlb',
                 '--steps', '2', '--measure', 'crlb,mse,capacity', '--positions', '20', '--vary',
                 'multipath_to_los_db=0,-10', '--picture', 'picture.svg') == 0
    with open('folder/sweep.csv', encoding='utf-8') as stream:
        rows = list(csv.DictReader(stream))
    assert [(row['n_frames'], row['multipath_to_los_db'], row['measure']) for row in rows] == [
        (frames, level, measure) for frames in '12' for level in ('-10.0', '0.0')
        for measure in ('crlb', 'mse', 'capacity')]
    assert {row['elements_per_side'] for row in rows} == {'4'}
    assert (tmp_path / 'picture.svg').read_text(encoding='utf-8').startswith('<?xml')


def test_without_matplotlib_the_table_is_written(sweep, tmp_path, monkeypatch, capsys):
    find = __main__.importlib.util.find_spec
    monkeypatch.setattr(__main__.importlib.util, 'find_spec', lambda name, *arguments: (
        None if name == 'matplotlib' else find(name, *arguments)))
    assert sweep('folder', '--jobs', '1', '--measure', 'crlb') == 0
    assert 'needs matplotlib, which is not installed (pip install' in capsys.readouterr().out
    assert {path.name for path in (tmp_path / 'folder').iterdir()} == {'jobs', 'sweep.csv'}
    with pytest.raises(SystemExit, match='2'):
        sweep('folder', '--picture', 'a.png')
    assert 'drawing needs matplotlib' in capsys.readouterr().err


@pytest.mark.parametrize(('options', 'expected'), [
    ([], 'required: --vary'),
    (['--vary', 'n_frames=1,0'], 'argument --vary: n_frames: 0, expected 1 to 4096'),
    (['--vary', 'n_frames=1,1'], 'argument --vary: n_frames: 1 more than once'),
    (['--with', 'n_frames=1'], 'argument --with: expected after --vary'),
    (['--vary', 'n_frames=1,2', '--with', 'n_subbands=1,2', '--with', 'n_feeds=1'],
     'n_feeds: 1 values, expected 2'),
    (['--vary', 'n_frames=1', '--measure', 'mse+rmse'], 'expected a measure in m²'),
    (['--vary', 'roi_size_m=[30,1,1]'], 'reaches behind the surface'),
    (['--vary', 'n_frames=1', '--estimator', 'neural'], "'neural', expected one without"),
    (['--vary', 'codebook=optimize,none.yaml'], "'none.yaml', expected directional"),
    (['--vary', 'codebook=bad.yaml'], 'error: bad.yaml: expected ros__parameters'),
    (['--vary', 'n_frames=1', '--scenario', 'bad.yaml'], 'bad.yaml: colour: unknown field'),
    (['--vary', 'n_frames=' + ','.join(map(str, range(1, 200))), '--vary',
      'n_feeds=' + ','.join(map(str, range(1, 200)))], '39601 settings, expected at most 10000'),
])
def test_an_error_is_one_line_and_nothing_runs(options, expected, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / 'bad.yaml').write_text('colour: red\n', encoding='utf-8')
    with pytest.raises(SystemExit, match='2'):
        __main__.main(['sweep', *options])
    errors = capsys.readouterr().err
    assert expected in errors
    assert len(errors.splitlines()) == 1
    assert [path.name for path in tmp_path.iterdir()] == ['bad.yaml']
