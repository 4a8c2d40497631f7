"""The command line of the demonstration, without a network."""

import pytest

from rhs_isac_ros.tools.demo import main


def test_an_invalid_recording_is_named_before_the_network_starts(tmp_path, capsys):
    pytest.importorskip('mcap', reason='mcap is not installed')
    assert main(['--record', str(tmp_path / 'none' / 'run.mcap')]) == 2
    out, err = capsys.readouterr()
    assert out == ''
    assert err.startswith(f'error: {tmp_path}/none/run.mcap: cannot be written')
