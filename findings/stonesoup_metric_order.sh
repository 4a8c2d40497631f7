#!/usr/bin/env bash
# Stone Soup 1.9.1: the order p of two metrics has no effect where it should. OSPA assigns tracks to truths by the sum of
# distances, also for p = 2 and infinity, so that it is larger than the minimum over all assignments. GOSPA adds the term
# of switched tracks as squares, also for p = 1 and 3.
#
# Guess before the run: the minimum over all permutations of the formula in the documentation of `compute_OSPA_distance`,
# and (distance^p + switching^p)^(1/p), as the other terms of GOSPA are sums of powers of p. The script fails if the
# behaviour changes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check \
  'stonesoup==1.9.1' 'numpy==2.3.5' 'scipy==1.17.1'
cat > "$folder/observe.py" <<'PYTHON'
import datetime
import itertools
from importlib.metadata import version

import numpy as np
from stonesoup.metricgenerator.manager import MultiManager
from stonesoup.metricgenerator.ospametric import GOSPAMetric, OSPAMetric
from stonesoup.types.groundtruth import GroundTruthPath
from stonesoup.types.state import State
from stonesoup.types.track import Track

START = datetime.datetime(2026, 1, 1)


def states(places, second=0):
    """Return states in one dimension."""
    time = START + datetime.timedelta(seconds=second)
    return [State([[float(place)]], timestamp=time) for place in places]


print('stonesoup', version('stonesoup'))
truths, tracks, cutoff = (0, 4), (4, 8), 7.0
for p in (1, 2, np.inf):
    found = OSPAMetric(p=p, c=cutoff).compute_OSPA_distance(states(tracks), states(truths)).value
    lowest = min(
        max(costs) if p == np.inf else (sum(cost**p for cost in costs) / len(costs))**(1 / p)
        for costs in ([min(abs(x - y), cutoff) for x, y in zip(truths, chosen)]
                      for chosen in itertools.permutations(tracks)))
    print(f'OSPA p={p}: {found:.3f}, lowest of all assignments: {lowest:.3f}')
# Two tracks, 1 m beside the truths, are switched between two times.
paths = [[first, second] for first, second in zip(states((0, 10)), states((0, 10), 1))]
estimates = [[first, second] for first, second in zip(states((1, 11)), states((11, 1), 1))]
for p in (1, 2, 3):
    manager = MultiManager([GOSPAMetric(p=p, c=5.0, switching_penalty=1.0)])
    manager.add_data({'tracks': [Track(one) for one in estimates],
                      'groundtruth_paths': [GroundTruthPath(one) for one in paths]})
    (metric,) = manager.generate_metrics()['gospa_generator'].values()
    found = metric.value[-1].value
    terms = found['localisation'] + found['missed'] + found['false'] + found['switching']**p
    print(f'GOSPA p={p}: {found["distance"]:.3f}, root of the sum of terms: {terms**(1 / p):.3f}')
PYTHON
found=$(timeout 120 "$folder/venv/bin/python" -W ignore "$folder/observe.py")
echo "$found"
[[ $found == 'stonesoup 1.9.1
OSPA p=1: 3.500, lowest of all assignments: 3.500
OSPA p=2: 4.950, lowest of all assignments: 4.000
OSPA p=inf: 7.000, lowest of all assignments: 4.000
GOSPA p=1: 2.828, root of the sum of terms: 4.000
GOSPA p=2: 2.000, root of the sum of terms: 2.000
GOSPA p=3: 1.782, root of the sum of terms: 1.587' ]]
