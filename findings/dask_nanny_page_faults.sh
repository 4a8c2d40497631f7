#!/usr/bin/env bash
# Dask 2026.8.0 with glibc: NumPy with temporary arrays of 1 MB takes several times as much processor time on a worker with
# a nanny, the default, as in a process of its own. The nanny sets MALLOC_TRIM_THRESHOLD_=65536, and with any value of it,
# glibc no longer adapts the size above which memory comes from the system anew: each array begins with page faults.
#
# Guess before the run: the same time and no page faults in both, as the work has no data of Dask. The script fails if
# the behaviour changes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check \
  'distributed==2026.8.0' 'dask==2026.8.0' 'numpy==2.3.5'
cat > "$folder/observe.py" <<'PYTHON'
import os
import resource

import numpy as np
from distributed import Client, LocalCluster


def work():
    """Return a setting, the processor time [s] and the page faults of 1000 steps, the second time."""
    for _ in range(2):
        x, before = np.ones(1 << 17), resource.getrusage(resource.RUSAGE_THREAD)
        for _ in range(1000):
            x = np.sqrt(x * x + 1.0) - 0.5
        after = resource.getrusage(resource.RUSAGE_THREAD)
    seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return os.environ.get('MALLOC_TRIM_THRESHOLD_'), seconds, after.ru_minflt - before.ru_minflt


if __name__ == '__main__':
    for processes in (False, True):
        with LocalCluster(n_workers=1, threads_per_worker=1, processes=processes,
                          dashboard_address=None) as cluster, Client(cluster) as client:
            setting, seconds, faults = client.submit(work).result(timeout=60)
        print('with a nanny:' if processes else 'without:', f'MALLOC_TRIM_THRESHOLD_={setting},',
              f'{seconds:.2f} s,', 'page faults in each step' if faults > 1000 else 'few page faults')
PYTHON
cd "$folder"
found=$(timeout 240 "$folder/venv/bin/python" -W ignore observe.py)
"$folder/venv/bin/python" -c 'import platform, distributed; print(platform.python_version(), distributed.__version__, *platform.libc_ver())'
echo "$found"
[[ $found == *'without: MALLOC_TRIM_THRESHOLD_=None, '*'few page faults'*'with a nanny: MALLOC_TRIM_THRESHOLD_=65536, '*'page faults in each step' ]]
