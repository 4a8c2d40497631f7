"""The demo's command line; the network that it starts is tested elsewhere."""

import pytest

from rhs_isac_ros.tools.demo import main


def test_a_recording_that_cannot_be_written_is_named_before_anything_starts(tmp_path, capsys):
    pytest.importorskip('mcap', reason='there is no mcap here')
    assert main(['--record', str(tmp_path / 'none' / 'run.mcap')]) == 2
    out, err = capsys.readouterr()
    assert out == ''
    assert err.startswith(f'error: {tmp_path}/none/run.mcap: cannot be written')
