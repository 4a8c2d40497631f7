"""The command line of the demonstration, without a network."""

import pytest

from rhs_isac_ros.tools.demo import main


def test_an_invalid_recording_is_named_before_the_network_starts(tmp_path, capsys):
    with pytest.raises(SystemExit, match='2'):
        main(['--record', str(tmp_path / 'none' / 'run.mcap')])
    out, err = capsys.readouterr()
    assert out == ''
    assert f'--record: {tmp_path}/none/run.mcap: expected a file in a directory' in err
