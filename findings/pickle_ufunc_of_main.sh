#!/usr/bin/env bash
# CPython 3.11 to 3.13 with NumPy: the pickle of a SciPy ufunc depends on whether the main program has imported
# multiprocessing before. If it has, and names the ufunc itself, the pickle names the alias of the main
# program, so that a process with another main program cannot load it.
#
# Guess before the run: as without multiprocessing, the pickle names the module of SciPy. The implementation of pickle in
# Python does so, and leaves out the alias. The script fails if the behaviour changes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check \
  'scipy==1.17.1' 'numpy==2.3.5'
for multiprocessing in False True; do
  cat > "$folder/observe_$multiprocessing.py" <<PYTHON
import pickle

if $multiprocessing:
    import multiprocessing
from scipy.special import chdtri


def module(pickled):
    """Return the name of the module in the pickle of a function."""
    return pickled.split(b'\x8c')[1][1:].rstrip(b'\x94').decode()


print('multiprocessing:', $multiprocessing)
print('C:', module(pickle.dumps(chdtri)))
print('Python:', module(pickle._dumps(chdtri)))
PYTHON
done
found=$(for one in False True; do timeout 120 "$folder/venv/bin/python" "$folder/observe_$one.py"; done)
"$folder/venv/bin/python" -c 'import platform, scipy; print(platform.python_version(), scipy.__version__)'
echo "$found"
[[ $found == $'multiprocessing: False\nC: scipy.special._ufuncs\nPython: scipy.special._ufuncs\nmultiprocessing: True\nC: __mp_main__\nPython: scipy.special._ufuncs' ]]
