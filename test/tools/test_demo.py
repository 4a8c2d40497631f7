"""The command line of the demonstration, without a network."""

import signal

import pytest

from rhs_isac_ros.tools import demo
from rhs_isac_ros.tools.demo import main


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


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_during_the_start_completes_the_recording(
        number, tmp_path, monkeypatch):
    pytest.importorskip('mcap', reason='mcap is not installed')

    def interrupted(*_, **__):
        signal.raise_signal(number)
    # The environment of this process remains as it is.
    for module, name, replacement in (
            (demo, 'start_network', interrupted), (demo, 'private_domain', dict)):
        monkeypatch.setattr(module, name, replacement)
    assert main(['--record', str(tmp_path / 'run.mcap'),
                 '--picture', str(tmp_path / 'demo.png')]) == 0
    assert [file.name for file in tmp_path.iterdir()] == ['run.mcap']
