"""Makes the environment .venv smaller; scripts/setup runs it after it has installed the wheels.

Wheels contain copies instead of symbolic links, and several wheels contain the same library. Hard
links between equal files save a quarter of .venv, together with the removal of the libraries'
tests, the sources of compiled modules and the bytecode of pip. Must not run beside pip, which may
write to either of two files that are still equal.
"""

import collections
import hashlib
import os
import shutil
import sys
from pathlib import Path

venv = Path(sys.argv[1])
libraries = [path for path in sorted(venv.glob('lib/**/*.so*'))
             if path.is_file() and not path.is_symlink()]
sizes = collections.Counter(path.stat().st_size for path in libraries)
first = {}
for path in libraries:
    # Most files, with most of the data, have a size of their own and need not be read.
    if sizes[path.stat().st_size] > 1:
        original = first.setdefault(hashlib.sha256(path.read_bytes()).digest(), path)
        if original != path:
            link = path.with_name(f'{path.name}.link')
            try:
                os.link(original, link)
            except OSError:
                raise SystemExit from None  # A file system without hard links.
            link.replace(path)
for pattern in ('matplotlib/**/tests', 'numpy/**/tests', 'scipy/**/tests', 'pip/**/__pycache__'):
    for folder in list(venv.glob(f'lib/python*/site-packages/{pattern}')):
        shutil.rmtree(folder, ignore_errors=True)
for folder in (*venv.glob('lib/python*/site-packages'), venv / 'include'):
    for path in list(folder.rglob('*')):
        if path.suffix in ('.c', '.cpp', '.pyx'):
            path.unlink()
