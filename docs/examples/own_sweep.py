"""A sweep from Python, with an estimator of its own in this file."""

from pathlib import Path

from own_estimator import RandomSearch

from rhs_isac_ros.experiments.sweep import Sweep, run_sweep
from rhs_isac_ros.experiments.sweep_settings import parse_axis, settings_of
from rhs_isac_ros.model import Scenario

base = Scenario(elements_per_side=4, n_subbands=2)
settings = settings_of(base, [parse_axis('noise_psd_dbm_hz=-174,-154'),
                              parse_axis('n_frames=2,4')], 'random', RandomSearch)
sweep = Sweep(base, settings, measures=['crlb', 'rmse'], n_positions=60)
for point in run_sweep(sweep, Path('results/own_sweep'), n_jobs=2):
    print(point.setting.varied, point.measure, point.interval)
