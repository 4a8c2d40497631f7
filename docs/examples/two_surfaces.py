"""Locates users with the surfaces of config/site.yaml, and with the first of them alone."""

import sys

import numpy as np

from rhs_isac_ros.positioning import Site, SiteEstimator

site = Site.from_yaml(sys.argv[1] if len(sys.argv) > 1 else 'config/site.yaml')
estimator = SiteEstimator(site)
rng = np.random.default_rng(1)
users = rng.uniform(*site.bounds_m, size=(5, 3))
received = site.sample(users, rng)

for number, user in enumerate(users):
    errors_m = []
    for names in (['front'], list(site.surfaces)):
        found = estimator.estimate({name: received[name][number] for name in names})
        errors_m.append(np.linalg.norm(found.mean - user))
    print(f'{user.round(2)} m: error {errors_m[0]:.2f} m with one surface, {errors_m[1]:.2f} m '
          f'with all, standard deviations {np.sqrt(np.diag(found.covariance)).round(2)} m')
