"""Two surfaces with the bands of Table I, from above: candidates of a user, and errors of several.

``python3 docs/pictures/site.py FILE`` also writes the picture to a file.
"""

import dataclasses
import sys

import numpy as np
from matplotlib import pyplot

from rhs_isac_ros.codebook import Codebook, default_codebook_file
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.geometry import element_positions
from rhs_isac_ros.positioning import Site, SiteEstimator
from rhs_isac_ros.system import System

# Less probable candidates are not shown.
MIN_PROBABILITY = 0.01
COLOURS = {'front': 'C0', 'side': 'C1', 'both': 'C2'}
codebook = Codebook.default()
example = Site.from_yaml(default_codebook_file().parent / 'site.yaml')
site = Site({name: System(dataclasses.replace(
    Scenario(), pose=one.pose, roi_center_m=one.scenario.roi_center_m,
    roi_size_m=one.scenario.roi_size_m), codebook)
    for name, one in example.surfaces.items()}, example.bounds_m)
estimator, rng = SiteEstimator(site), np.random.default_rng(2)
users = rng.uniform(*site.bounds_m, size=(16, 3))
received = site.sample(users, rng)


def signals(user, names):
    """Return the signals of a user at some surfaces."""
    return {name: received[name][user] for name in names}


def estimates(names):
    """Return the positions of all users from the signals of some surfaces."""
    return np.array([estimator.estimate(signals(user, names)).mixture.moments()[0]
                     for user in range(len(users))])


def arcs(sighting):
    """Yield the candidates as arcs around their surface, of four standard deviations."""
    mixture, origin = sighting.mixture, sighting.pose.origin[:2]
    variances, axes = np.linalg.eigh(mixture.covariances[:, :2, :2])
    for mean, half, probability in zip(
            mixture.means[:, :2] - origin, 2 * np.sqrt(variances[:, 1:]) * axes[:, :, 1],
            mixture.probabilities, strict=True):
        chord = mean + np.linspace(-1, 1, 21)[:, None] * half
        ranges = np.linalg.norm(chord, axis=1, keepdims=True)
        if probability >= MIN_PROBABILITY:
            yield origin + chord * np.linalg.norm(mean) / ranges, probability


figure, (left, right) = pyplot.subplots(1, 2, figsize=(9, 4.7), layout='constrained')
low, high = site.bounds_m[:, :2]
for axis in left, right:
    axis.add_patch(pyplot.Rectangle(low, *(high - low), fc='0.92'))
    axis.set(xlabel='$x$ [m]', ylabel='$y$ [m]', aspect='equal')
left.text(*(low + 0.2), 'region of interest', color='0.4', fontsize='small')

user, both = 12, estimates(site.surfaces)
for name, one in site.surfaces.items():
    colour, pose = COLOURS[name], one.pose
    left.plot(*pose.to_site(element_positions(one.scenario))[:, :2].T, 's', color=colour, ms=3)
    tip = pose.to_site(np.array([3.0, 0.0, 0.0]))[:2]
    left.annotate('', tip, pose.origin[:2], arrowprops={'arrowstyle': '->', 'color': colour})
    left.annotate(f'surface {name}', pose.origin[:2], xytext=(8, 8), textcoords='offset points',
                  color=colour)
    left.plot([], [], color=colour, lw=3, label=f'candidates of {name}')
for name, sighting in estimator.sightings(signals(user, site.surfaces)).items():
    for points, probability in arcs(sighting):
        left.plot(*points.T, COLOURS[name], lw=1 + 10 * probability, solid_capstyle='butt')
left.plot(*both[user, :2], 'o', color=COLOURS['both'], mfc='none', ms=15, mew=2,
          label='estimate of both')
left.plot(*users[user, :2], 'k+', ms=9, label='true position')
left.set_title('candidate positions of one user')
left.legend(loc='lower left', fontsize='small', markerscale=0.6)

for name, found in ('front', estimates(['front'])), ('both', both):
    ends = np.stack([users, found], axis=1)[:, :, :2]
    right.plot(*ends.transpose(2, 1, 0), color=COLOURS[name], lw=1)
    right.plot(*found[:, :2].T, 'o', color=COLOURS[name], mfc='none', ms=7, mew=1.5,
               label='estimate of both' if name == 'both' else f'estimate of {name} alone')
right.plot(*users[:, :2].T, 'k+', ms=7, label='true position')
right.set(title=f'errors of {len(users)} users', xlim=(low[0] - 0.3, high[0] + 0.3),
          ylim=(low[1] - 0.3, high[1] + 2.0))
right.legend(loc='upper center', ncols=2, fontsize='small')
if len(sys.argv) > 1:
    figure.savefig(sys.argv[1], dpi=120)
