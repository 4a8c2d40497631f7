#!/usr/bin/env bash
# SciPy 1.17.1: a Sobol sequence depends on the seed of a NumPy generator and on the number of
# sequences made from it before, but not on its state. Numbers drawn in between make no difference.
#
# Guess before the run: the scrambling uses the next numbers of the generator, so that a generator
# after ten draws gives other points than a fresh one. The script fails if the behaviour changes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check \
  'scipy==1.17.1' 'numpy==2.3.5'
cat > "$folder/observe.py" <<'PYTHON'
import numpy as np
import scipy
from scipy.stats import qmc


def points(generator):
    """Return the first points of a scrambled sequence."""
    return qmc.Sobol(3, rng=generator).random(4)


fresh, used = np.random.default_rng(0), np.random.default_rng(0)
used.random(10)
print('scipy', scipy.__version__)
print('numbers of both generators equal:', fresh.random() == used.random())
first = points(fresh)
print('points of both generators equal:', np.array_equal(first, points(used)))
print('second points of one generator equal:', np.array_equal(first, points(fresh)))
PYTHON
found=$(timeout 120 "$folder/venv/bin/python" "$folder/observe.py")
echo "$found"
[[ $found == $'scipy 1.17.1\nnumbers of both generators equal: False\npoints of both generators equal: True\nsecond points of one generator equal: False' ]]
