"""Bad input ends every command with one line and exit code 2, before anything starts."""

import importlib.util
import os
import subprocess
from pathlib import Path

import pytest

from rhs_isac_ros.executables import EXECUTABLES

rclpy = pytest.importorskip('rclpy', reason='ROS is not installed')
ROOT = Path(__file__).parents[1]
SCRIPTS = ROOT / 'scripts'
CODEBOOK = str(ROOT / 'config' / 'codebook.yaml')
QUICK_CODEBOOK = str(ROOT / 'config' / 'codebook_quick.yaml')
QUICK = str(ROOT / 'config' / 'quick.yaml')
LONG = 300 * 'x'
NEEDS_MCAP = pytest.mark.skipif(
    not importlib.util.find_spec('mcap'), reason='mcap is not installed')

# Module whose main function is called, arguments, and a part of the error. Every call takes place
# in a folder with the files of the fixture `folder`.
CALLS = [
    ('tools.demo', ['--users', '0'], 'argument --users: 0, expected 1 to 4096'),
    ('tools.demo', ['--users', 'many'], "argument --users: 'many', expected an integer"),
    ('tools.demo', ['--users', '100000'], 'argument --users: 100000, expected 1 to 4096'),
    ('tools.demo', ['--cycles', str(10**30)], 'expected 1 to 1000000000'),
    ('tools.demo', ['--seed', '2147483648'], 'expected 0 to 2147483647'),
    ('tools.demo', ['--picture', 'x.xyz'], 'ends in .png, .pdf, .svg'),
    ('tools.demo', ['--picture', 'none/x.png'], 'none/x.png: expected a file in a directory'),
    ('tools.demo', ['--record', 'folder'], 'folder: a directory, expected a file'),
    ('tools.demo', ['--record', 'a.png', '--picture', './a.png'], 'a file other than --record'),
    ('tools.demo', ['--config', 'none.yaml'], "'none.yaml', expected an existing file"),
    ('tools.demo', ['--config', 'garbage'], 'garbage: cannot be read'),
    ('tools.demo', ['--codebook', 'garbage'], 'garbage: cannot be read'),
    ('tools.demo', ['--codebook', QUICK_CODEBOOK], 'analog: shape (2, 3, 36), expected'),
    ('tools.demo', ['--follow', 'garbage'], 'garbage: cannot be read'),
    ('tools.demo', ['--follow', str(ROOT / 'config' / 'library_bandplan.npz')],
     'scenario: sc043027b08ab600bf, expected sc'),
    ('tools.demo', ['--surface', 'magic'], "argument --surface: 'magic', expected one of"),
    ('tools.demo', ['--surface', 'opensourceris'], "missing a required argument: 'port'"),
    ('tools.demo', ['--port', 'emulated'], "unexpected keyword argument 'port'"),
    ('tools.demo', ['--radio', 'waveform'], 'frame_duration_s: 4e-06 s, expected at least'),
    ('tools.demo', ['--radio-options', 'path=x'], "unexpected keyword argument 'path'"),
    ('tools.demo', ['--samples', 'x'], 'argument --samples: the radio emulated has no samples'),
    ('tools.demo', ['--calibration', 'garbage'], 'garbage: cannot be read'),
    ('tools.demo', ['--pict', 'x.png'], 'unrecognized arguments: --pict'),
    ('tools.demo', ['a\nb'], 'unrecognized arguments: a b'),
    ('tools.record', [], 'required: file'),
    ('tools.record', [''], "argument file: '', expected a file"),
    ('tools.record', ['folder'], 'folder: a directory'),
    ('tools.record', ['/dev/null'], 'expected a regular file'),
    ('tools.record', ['/proc/x.mcap'], '/proc/x.mcap: expected a file in a directory'),
    ('tools.record', [LONG], 'File name too long'),
    ('tools.record', ['x.mcap', '--config', 'garbage'], 'garbage: cannot be read'),
    ('tools.record', ['x.mcap', '--site', 'garbage'], 'garbage: cannot be read'),
    ('tools.record', ['x.mcap', '--site', 'good.yaml', '--config', 'good.yaml'],
     'not allowed with argument --site'),
    ('tools.record', ['good.yaml', '--config', 'good.yaml'], 'a file other than --config'),
    ('tools.record', ['x.mcap', '-p', 'a:=1'], 'ROS arguments follow --ros-args'),
    ('tools.record', ['x.mcap', '--ros-args', '--bogus'], "invalid ROS arguments: ['--bogus']"),
    ('tools.calibrate', ['none.mcap'], "'none.mcap', expected an existing file"),
    pytest.param('tools.calibrate', ['garbage'], 'garbage: not a complete recording',
                 marks=NEEDS_MCAP),
    ('tools.calibrate', ['--site', 'garbage'], 'garbage: cannot be read'),
    ('tools.calibrate', ['--states', '1,-1', '--system', 'garbage'], 'garbage: '),
    ('tools.calibrate', ['--site', 'garbage', '--system', 'garbage'], 'not allowed with system'),
    ('tools.calibrate', ['--cycles', '0'], 'argument --cycles: 0, expected 1 to 1000000000'),
    ('tools.calibrate', ['--states', '1,-1', '--calibration', 'garbage'], 'with --multipath'),
    ('tools.calibrate', ['--states', '1,-1', '--codebook', 'garbage'], 'not allowed with'),
    ('tools.calibrate', ['--states', '1,-1', '--jobs', '2'], 'not allowed with jobs'),
    ('tools.calibrate', ['--states', '1,-1', 'garbage'], '--states: not allowed with file'),
    ('tools.calibrate', ['--namespace', '/lab'], 'expected together with a recording'),
    ('tools.calibrate', ['garbage', '--cycles', '9'], 'expected for a running network'),
    ('tools.calibrate', ['garbage', '--output', 'garbage'], 'a file other than'),
    ('tools.replay', ['none.mcap'], "'none.mcap', expected an existing file"),
    ('tools.replay', ['folder'], 'folder: expected a file, or a folder with'),
    pytest.param('tools.replay', ['garbage'], 'garbage: not a complete recording',
                 marks=NEEDS_MCAP),
    ('tools.replay', ['garbage', '--estimator', 'magic'], "estimator: 'magic', expected one of"),
    ('tools.replay', ['garbage', '--config', 'good.yaml', '--site', 'good.yaml'], 'with --site'),
    ('tools.replay', ['garbage', '--publish', '--estimator', 'ml'], 'not allowed with'),
    ('tools.replay', ['garbage', '--publish', '--library', 'garbage'], 'not allowed with'),
    ('tools.replay', ['garbage', '--estimator', 'neural', '--calibration', 'garbage'],
     'not allowed with --estimator neural'),
    ('tools.replay', ['garbage', '--rate', '2'], 'expected together with --publish'),
    ('tools.replay', ['garbage', '--publish', '--rate', '0'], '0.0, expected above 0'),
    ('tools.replay', ['garbage', '--estimator', 'ml', '--track'], 'expected together with'),
    ('tools.replay', ['garbage', '--track-speed', '2'], 'expected together with --track'),
    ('tools.replay', ['garbage', '--estimator-options', 'n=1'], 'an option of bayes'),
    ('tools.replay', ['garbage', '--publish', '--topic', 'codebook'], "choice: 'codebook'"),
    ('tools.replay', ['garbage', '--model', 'good.yaml'], 'together with --estimator neural'),
    ('tools.snapshot', ['--output', 'x.jpg'], 'ends in .png, .pdf, .svg'),
    ('tools.snapshot', ['--timeout', '-1'], '-1.0, expected at least 0'),
    ('tools.snapshot', ['--config', QUICK_CODEBOOK], 'unknown field'),
    ('tools.watch', ['--once', 'twice'], 'unrecognized arguments: twice'),
    ('parts.topic', ['show'], "invalid choice: 'show'"),
    ('parts.topic', ['echo'], 'required: topic_name'),
    ('parts.topic', ['list', '--spin-time', 'nan'], 'nan, expected at least 0'),
    ('parts.param', ['get', 'bs'], 'required: parameter_name'),
    ('parts.param', ['list', '--timeout', 'x'], 'expected a number, at least 0'),
    ('codebook.__main__', ['--output', '.'], '.: a directory, expected a file'),
    ('codebook.__main__', ['--plot', 'p.xyz'], 'ends in .png, .pdf, .svg'),
    ('codebook.__main__', ['--output', 'a.pdf', '--plot', 'a.pdf'], 'a file other than --output'),
    ('codebook.__main__', ['--steps', '-1'], '-1, expected 1 to 1000000000'),
    ('codebook.__main__', ['--start', 'none'], "'none', expected an existing file"),
    ('codebook.__main__', ['--start', QUICK_CODEBOOK], 'analog: shape (2, 3, 36)'),
    ('codebook.__main__', ['--resume'], 'expected codebook.yaml.part or codebook.yaml'),
    ('codebook.__main__', ['--scenario', 'good.yaml', '--output', 'good.yaml'],
     'a file other than'),
    ('codebook.__main__', ['--raster', '1e6'], 'argument --raster: no effect, expected together'),
    ('positioning.__main__', [], 'required: --codebook'),
    ('positioning.__main__', ['--codebook', 'garbage'], 'garbage: cannot be read'),
    ('positioning.__main__', ['--codebook', CODEBOOK, '--pairs', '3'], 'expected 20 to 10000000'),
    ('positioning.__main__', ['--codebook', CODEBOOK, '--output', 'folder'], 'a directory'),
    ('positioning.__main__', ['--codebook', CODEBOOK, '--scenario', QUICK], 'analog: shape'),
    ('experiments.__main__', ['swep'], "invalid choice: 'swep'"),
    ('experiments.__main__', ['sweep', '--vary', 'n_frames=0'], 'n_frames: 0, expected 1 to 4096'),
    ('experiments.__main__', ['sweep', '--vary', 'n_frames=1', '--codebook', 'garbage'],
     'garbage: cannot be read'),
    ('experiments.__main__', ['sweep', '--vary', 'n_frames=1', '--codebook', 'random', '--steps',
                              '9'], 'steps: no effect, expected a codebook of the kind optimize'),
    ('experiments.__main__', ['sweep', '--vary', 'n_frames=1', '--codebook', 'directional',
                              '--repeats', '9'], 'repeats: no effect, expected a codebook'),
    ('experiments.__main__', ['sweep', '--vary', 'n_frames=1', '--estimator', 'ml', '--measure',
                              'crlb'], 'argument --estimator: no effect, expected a --measure of'),
    ('experiments.__main__', ['sweep', '--vary', 'codebook=random', '--codebook', 'directional'],
     'argument --codebook: no effect, expected no --vary or --with codebook'),
    ('experiments.__main__', ['calibrate'], 'file: None, expected a file of arrays'),
    ('experiments.__main__', ['calibrate', 'garbage'], 'need scripts/calibrate, with ROS 2'),
    ('experiments.__main__', ['calibrate', '--fit', 'x'], 'expected together with --board'),
    ('frontend.__main__', [], 'required: command'),
    ('frontend.__main__', ['show', ''], "argument PORT: '', expected a device or emulated"),
    ('frontend.__main__', ['show', 'nothing'], 'nothing: the port cannot be used: No such file'),
    ('frontend.__main__', ['check', 'garbage'], 'garbage: the port cannot be used: Inappropriate'),
    ('frontend.__main__', ['check', 'emulated', '--timeout', '0'], '0.0, expected above 0'),
    ('nodes.user', ['-p', 'user_id:=2'], 'ROS arguments follow --ros-args'),
    ('nodes.user', ['2'], 'unrecognized arguments: 2'),
    ('nodes.bs', ['--policy', 'random'], 'unrecognized arguments: --policy random'),
    ('nodes.bs', ['--ros-args', '-p', 'policy'], "parameter override rule: '-p policy'"),
    ('nodes.network', ['--ros-args', '--params-file', 'garbage'], "'--params-file garbage'"),
    ('nodes.optimizer', ['--push', '--push-file', 'good.yaml'],
     'argument --push: no effect, expected no --push-file'),
    ('nodes.optimizer', ['--steps', '3', '--push-file', 'good.yaml'],
     'argument --steps: no effect, expected no --push-file'),
    ('nodes.optimizer', ['--push-file', 'garbage'], 'garbage: cannot be read'),
]
# The scripts, as processes.
PROCESSES = [
    (['record', ''], "record: error: argument file: '', expected a file"),
    (['run', 'user', 'seed:=1'], 'user: error: unrecognized arguments: seed:=1'),
    (['board', 'show', 'nothing'], 'scripts/board: error: nothing: the port cannot be used'),
    (['run', '../setup'], 'no executable named ../setup'),
    (['reproduce', 'fig5'], 'no experiment named fig5'),
    (['benchmark', 'channels', '--blocked', '2'],
     "argument --blocked: 2.0, expected 0 to 1"),
]


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """The working directory, with files and a folder that must stay as they are."""
    (tmp_path / 'folder').mkdir()
    (tmp_path / 'garbage').write_bytes(bytes(range(128, 256)) * 10)
    (tmp_path / 'good.yaml').write_text('n_frames: 4\n', encoding='utf-8')
    monkeypatch.chdir(tmp_path)
    return tmp_path


def contents(folder):
    return {path.name: path.is_file() and path.read_bytes() for path in folder.rglob('*')}


def exit_code(main, arguments):
    try:
        return main(arguments)
    except SystemExit as exit:
        return exit.code


def main_of(module):
    """The main function of a module of the package, or of the parts of scripts."""
    return importlib.import_module(
        module if module.startswith('parts.') else f'rhs_isac_ros.{module}').main


def assert_one_line(errors, expected):
    assert 'Traceback' not in errors
    assert len(errors.splitlines()) == 1, errors
    assert expected in errors


@pytest.mark.parametrize(('module', 'arguments', 'expected'), CALLS)
def test_a_bad_call_prints_one_line_and_starts_and_changes_nothing(
        module, arguments, expected, folder, monkeypatch, capfd):
    def refuse(*args, **options):
        raise AssertionError('the command starts')
    main = main_of(module)
    before = contents(folder)
    with monkeypatch.context() as patch:
        patch.setattr(subprocess, 'Popen', refuse)
        patch.setattr(rclpy, 'init', refuse)
        code = exit_code(main, arguments)
    output, errors = capfd.readouterr()
    assert code == 2
    assert output == ''
    assert_one_line(errors, expected)
    assert contents(folder) == before


@pytest.mark.parametrize('module', ['nodes.bs', 'tools.demo', 'parts.topic'])
def test_an_invalid_domain_is_an_error(module, monkeypatch, capfd):
    monkeypatch.setenv('ROS_DOMAIN_ID', '233')
    main = main_of(module)
    assert exit_code(main, ['list'] if module == 'parts.topic' else []) == 2
    assert_one_line(capfd.readouterr().err, "ROS_DOMAIN_ID: '233', expected an integer")


@pytest.fixture(scope='module')
def processes(built_scripts, tmp_path_factory):
    """The processes of all scripts, which run concurrently, with their working directories."""
    started = []
    for command, _ in PROCESSES:
        folder = tmp_path_factory.mktemp('folder')
        started.append((folder, subprocess.Popen(
            [SCRIPTS / command[0], *command[1:]], cwd=folder, stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)))
    return started


@pytest.mark.parametrize('index', range(len(PROCESSES)), ids=lambda i: ' '.join(PROCESSES[i][0]))
def test_a_script_prints_one_line_and_exits_with_code_2(index, processes):
    folder, process = processes[index]
    output, errors = process.communicate(timeout=240)
    assert (process.returncode, output) == (2, '')
    assert_one_line(errors, PROCESSES[index][1])
    assert not os.listdir(folder)


@pytest.mark.parametrize('executable', [
    name for name, package in EXECUTABLES.items() if package == 'nodes'])
def test_the_help_of_a_node_lists_its_parameters(executable, capsys):
    from rhs_isac_ros.ros.parameters import NODES
    main = importlib.import_module(f'rhs_isac_ros.nodes.{executable}').main
    assert exit_code(main, ['--help']) == 0
    text = capsys.readouterr().out
    assert text.startswith(f'usage: {executable} ')
    assert f'example: {executable} --ros-args -p ' in text
    for parameter in NODES[executable]:
        assert f'\n  {parameter.name} ({parameter.type}; default ' in text
        assert f'{parameter.range}' in text
        assert f'\n      {parameter.text}\n' in text


def test_closed_standard_streams_do_not_change_the_exit_code(built_scripts, tmp_path):
    command = f"'{SCRIPTS}/run' watch --timeout x 0<&- 1>&- 2>&-"
    assert subprocess.run(['bash', '-c', command], cwd=tmp_path, check=False).returncode == 2


def test_a_reader_that_closes_the_output_early_is_no_error(built_scripts):
    done = subprocess.run(
        ['bash', '-c', f"set -o pipefail; '{SCRIPTS}/run' user --help | head -c 1"],
        capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, 'u', '')
