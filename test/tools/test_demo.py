"""The command line of the demonstration and the durations of its parts, without a network."""

import time

import pytest

from rhs_isac_ros.executables import STARTED_S
from rhs_isac_ros.tools import demo
from rhs_isac_ros.tools.demo import main, parts_text, process_age_s

# That of the clock in which the system gives the start of a process.
RESOLUTION_S = 0.02


def test_an_invalid_recording_is_named_before_the_network_starts(tmp_path, capsys):
    with pytest.raises(SystemExit, match='2'):
        main(['--record', str(tmp_path / 'none' / 'run.mcap')])
    out, err = capsys.readouterr()
    assert out == ''
    assert f'--record: {tmp_path}/none/run.mcap: expected a file in a directory' in err


def test_progress_is_printed_at_the_start_after_ten_cycles_and_at_the_end(monkeypatch, capsys):
    monkeypatch.setenv('ROS_DOMAIN_ID', '7')
    for complete in range(13):
        demo._show_progress(complete, 12)
    assert capsys.readouterr().err.splitlines() == [
        'network started with ROS_DOMAIN_ID=7, waiting for the first cycle',
        'cycle 10 of 12', 'cycle 12 of 12']


def test_a_signal_during_the_start_completes_the_recording(tmp_path, monkeypatch):
    pytest.importorskip('mcap', reason='mcap is not installed')

    def interrupted(*_, **__):
        raise KeyboardInterrupt
    # The environment of this process remains as it is.
    for module, name, replacement in (
            (demo, 'start_network', interrupted), (demo, 'private_domain', dict),
            (demo.startup, 'use_discovery_profile', lambda: None)):
        monkeypatch.setattr(module, name, replacement)
    assert main(['--record', str(tmp_path / 'run.mcap'),
                 '--picture', str(tmp_path / 'demo.png')]) == 0
    assert [file.name for file in tmp_path.iterdir()] == ['run.mcap']


def test_the_text_contains_the_total_and_each_part():
    assert parts_text(10.0, [('imports', 10.5), ('cycles', 12.25)]) == (
        'time: 2.25 s (imports 0.50, cycles 1.75)')


@pytest.mark.skipif(not demo._STAT_FILE.exists(), reason='this system has no /proc')
def test_the_age_of_a_process_grows_with_time():
    def look():
        return time.monotonic(), process_age_s(), time.monotonic()

    before_s, age_s, after_s = look()
    assert age_s >= before_s - STARTED_S - RESOLUTION_S
    again_s = age_s
    while again_s == age_s:
        before_again_s, again_s, after_again_s = look()
    assert before_again_s - after_s - RESOLUTION_S <= again_s - age_s
    assert again_s - age_s <= after_again_s - before_s + RESOLUTION_S


@pytest.mark.parametrize('text', [None, '', '12 (demo) S 1', '12 (demo) ' + 'x ' * 30])
def test_the_age_is_unknown_without_a_readable_start(tmp_path, monkeypatch, text):
    file = tmp_path / 'stat'
    if text is not None:
        file.write_text(text)
    monkeypatch.setattr(demo, '_STAT_FILE', file)
    assert process_age_s() is None
