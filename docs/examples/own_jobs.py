"""Own jobs on the cores of this machine, or on the Dask cluster of an address."""

import sys
from pathlib import Path

import numpy as np

from rhs_isac_ros.bounds import crlb
from rhs_isac_ros.codebook import random_codebook
from rhs_isac_ros.experiments import Job, run_jobs
from rhs_isac_ros.model import Scenario


def trial(seed, noise_dbm_hz):
    """Return the mean CRLB of a random codebook."""
    scenario, rng = Scenario(noise_psd_dbm_hz=noise_dbm_hz), np.random.default_rng(seed)
    codebook = random_codebook(scenario, rng)
    return {'crlb_m2': crlb(scenario, codebook, scenario.sample_positions(100, rng)).mean()}


jobs = [Job(f'{noise:g}-{seed}', {'seed': seed, 'noise_dbm_hz': noise})
        for noise in (-174.0, -154.0) for seed in range(3)]
address = sys.argv[1] if len(sys.argv) > 1 else None
for result in run_jobs(trial, jobs, Path('results/own'), dask=address):
    print(f'{result["crlb_m2"]:.4f} m^2')
