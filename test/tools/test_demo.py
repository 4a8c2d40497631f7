"""The command line of the demonstration, without a network."""

import pytest

from rhs_isac_ros.tools import demo
from rhs_isac_ros.tools.demo import main


def test_an_invalid_recording_is_named_before_the_network_starts(tmp_path, capsys):
    with pytest.raises(SystemExit, match='2'):
        main(['--record', str(tmp_path / 'none' / 'run.mcap')])
    out, err = capsys.readouterr()
    assert out == ''
    assert f'--record: {tmp_path}/none/run.mcap: expected a file in a directory' in err


def test_a_signal_during_the_start_completes_the_recording(tmp_path, monkeypatch):
    pytest.importorskip('mcap', reason='mcap is not installed')

    def interrupted(*_, **__):
        raise KeyboardInterrupt
    # The environment of this process remains as it is.
    for name, replacement in (('start_network', interrupted), ('private_domain', dict),
                              ('use_discovery_profile', lambda: None)):
        monkeypatch.setattr(demo, name, replacement)
    assert main(['--record', str(tmp_path / 'run.mcap'),
                 '--picture', str(tmp_path / 'demo.png')]) == 0
    assert [file.name for file in tmp_path.iterdir()] == ['run.mcap']
