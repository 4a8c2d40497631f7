"""Files of a stranger are rejected in one line, within a second and little memory."""

import io
import os
import subprocess
import sys
import zipfile

import numpy as np
import pytest

from rhs_isac_ros.support.files import ArchiveError, read_archive, read_yaml, write_whole

# Each list contains the one before ten times.
BOMB = ', '.join(['&a0 [1, 1]', *(
    f'&a{level} [{", ".join([f"*a{level - 1}"] * 10)}]' for level in range(1, 10))])
FILES = {
    'n_frames: ' + 100_000 * '[': 'nested more than 16 times',
    100_000 * '[': 'nested more than 16 times',
    100_000 * '- ': 'nested more than 16 times',
    f'n_frames: [{BOMB}]': 'reference *a0, expected none',
    f'/**: {{ros__parameters: {{codebook: {{shape: [{BOMB}]}}}}}}': 'reference *a0, expected none',
    '!!python/object/apply:os.system [exit 1]': 'could not determine a constructor',
    '\0': 'characters are not allowed'}
# In a process with 2 GB of memory, because a defect would use more or end it.
READ = """
import resource, sys
resource.setrlimit(resource.RLIMIT_AS, (2 * 10**9, 2 * 10**9))
from rhs_isac_ros.codebook import Codebook, CodebookError
from rhs_isac_ros.model import Scenario, ScenarioError
for file in sys.argv[1:]:
    for read, kind in ((Scenario.from_yaml, ScenarioError), (Codebook.load, CodebookError)):
        try:
            read(file)
        except kind as error:
            print(error)
"""


def test_yaml(tmp_path):
    files = [tmp_path / f'{number}.yaml' for number in range(len(FILES))]
    for file, content in zip(files, FILES, strict=True):
        file.write_text(content, encoding='utf-8')
    done = subprocess.run([sys.executable, '-c', READ, *files], capture_output=True, text=True,
                          timeout=240, check=True)
    for index, line in enumerate(done.stdout.splitlines()):
        assert line.startswith(f'{files[index // 2]}: cannot be read: ')
        assert [*FILES.values()][index // 2] in line
    assert done.stdout.count('\n') == 2 * len(FILES)


def test_a_file_without_end(tmp_path, monkeypatch):
    monkeypatch.setattr('rhs_isac_ros.support.files._MAX_YAML_BYTES', 1000)
    (tmp_path / 'longest').write_text(1000 * '1')
    assert read_yaml(tmp_path / 'longest') == int(1000 * '1')
    (tmp_path / 'umlauts').write_text('a' + 600 * 'ä', encoding='utf-8')
    for file in ('/dev/zero', tmp_path / 'umlauts'):
        with pytest.raises(ValueError, match=f'{file}: cannot be read: more than 1000 bytes'):
            read_yaml(file)


def npy(shape, kind='<f8'):
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        stream, {'descr': kind, 'fortran_order': False, 'shape': shape})
    return stream.getvalue() + bytes(80)


@pytest.mark.parametrize(('name', 'content', 'compression'), [
    ('x', npy((10**15,)), zipfile.ZIP_STORED),
    ('x', npy((10**30,)), zipfile.ZIP_STORED),
    ('x', npy((10,)), zipfile.ZIP_DEFLATED),
    ('x', npy((10,), '|O'), zipfile.ZIP_STORED),
    ('y', npy((10,)), zipfile.ZIP_STORED)])
def test_archives(tmp_path, name, content, compression):
    file = tmp_path / 'a.npz'
    with zipfile.ZipFile(file, 'w', compression) as archive:
        archive.writestr(f'{name}.npy', content)
    with pytest.raises(ArchiveError, match='a.npz: (cannot be read|not a model)'):
        read_archive(file, 'model', 1, {'x'})


@pytest.mark.parametrize(('umask', 'mode'), [(0o077, 0o600), (0o022, 0o644), (0o002, 0o664)])
def test_a_written_file_has_the_permissions_of_a_new_file(tmp_path, umask, mode):
    before = os.umask(umask)
    try:
        write_whole(tmp_path / 'a', 'text')
    finally:
        os.umask(before)
    assert (tmp_path / 'a').stat().st_mode & 0o777 == mode
    assert [path.name for path in tmp_path.iterdir()] == ['a']
