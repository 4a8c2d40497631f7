"""Detection of surfaces whose pose is wrong."""

import itertools

import numpy as np
import pytest

from rhs_isac_ros.model import Pose
from rhs_isac_ros.positioning import Mixture, Sighting, fuse
from rhs_isac_ros.positioning.agreement import WINDOW, PoseTest, pair_agreements
from rhs_isac_ros.positioning.fusion import Fuser

BOUNDS = np.array([[5.0, -5.0, -1.0], [15.0, 5.0, 1.0]])
NAMES = ('front', 'opposite', 'side')
PAIRS = tuple(itertools.combinations(NAMES, 2))
POSES = {'front': Pose(), 'side': Pose((10.0, -10.0, 0.0), (0.0, 0.0, 1.0, 1.0)),
         'opposite': Pose((20.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0))}


def cycles(n, seed, shifts=None):
    """Agreements with heavy tails; `shifts` lowers those of a pair."""
    values = np.random.default_rng(seed).standard_t(2, size=(n, len(PAIRS)))
    return [{pair: value - (shifts or {}).get(pair, 0.0)
             for pair, value in zip(PAIRS, row, strict=True)} for row in values.tolist()]


def suspects(shifts=None, seed=1, n=WINDOW, references=500):
    test = PoseTest(cycles(references, 0))
    for cycle in cycles(n, seed, shifts):
        test.add(cycle)
    return test.suspects()


@pytest.mark.slow
def test_right_poses_raise_few_alarms():
    # Each of three pairs fails by chance in one of a thousand windows.
    assert sum(bool(suspects(seed=seed)) for seed in range(1, 301)) <= 4


@pytest.mark.parametrize(('disagreeing', 'expected'), [
    *([[pair for pair in PAIRS if wrong in pair], (wrong,)] for wrong in NAMES), (PAIRS, NAMES)],
    ids=[*NAMES, 'all'])
def test_the_suspect_is_the_surface_with_which_all_others_disagree(disagreeing, expected):
    assert suspects(dict.fromkeys(disagreeing, 1.5)) == expected


def test_single_cycles_that_disagree_are_no_alarm():
    test = PoseTest(cycles(500, 0))
    for number, cycle in enumerate(cycles(WINDOW, 1)):
        test.add(dict.fromkeys(PAIRS, -1e6) if number % 25 == 0 else cycle)
    assert test.suspects() == ()


def test_old_cycles_are_forgotten():
    test = PoseTest(cycles(500, 0))
    for cycle in cycles(WINDOW, 1, dict.fromkeys(PAIRS, 3.0)) + cycles(WINDOW, 2):
        test.add(cycle)
    assert test.suspects() == ()


def test_a_surface_that_is_silent_does_not_count():
    test = PoseTest(cycles(500, 0))
    assert (test.suspects(), test.deviations()) == ((), {})
    for cycle in cycles(WINDOW, 1, {PAIRS[0]: 2.0}):
        test.add({PAIRS[0]: cycle[PAIRS[0]], ('front', 'unknown'): -10.0})
    assert test.suspects() == PAIRS[0]
    assert set(test.deviations()) == {PAIRS[0]}


def test_the_deviation_of_the_lowest_ranks_is_known():
    test = PoseTest(cycles(9, 0))
    for _ in range(WINDOW):
        test.add({PAIRS[0]: -1e6})
    # The rank is 1/20, as there are nine references.
    assert test.deviations()[PAIRS[0]] == pytest.approx(0.45 * np.sqrt(12 * WINDOW))


def test_references_are_required():
    with pytest.raises(ValueError, match='references: none, expected agreements'):
        PoseTest([])


def test_agreements_are_those_of_each_pair():
    place, far = np.array([[8.0, 1.0, 0.0]]), np.array([[9.0, 1.0, 0.0]])
    covariances = 0.01 * np.eye(3)[None]
    sightings = {name: Sighting(POSES[name], Mixture(
        np.zeros(1), far if name == 'side' else place, covariances)) for name in POSES}
    found = pair_agreements(sightings, Fuser(BOUNDS))
    assert tuple(found) == PAIRS
    assert found['front', 'opposite'] == fuse(
        [sightings['front'], sightings['opposite']], BOUNDS).log_agreement
    assert found['front', 'side'] < 0 < found['front', 'opposite']


def moving(shift, references=400, n=WINDOW):
    """Deviation for a user who stays in a corner, where right agreements are lower by 3."""
    rng = np.random.default_rng(3)
    places = rng.uniform(*BOUNDS.tolist(), size=(references, 3))

    def agreement(place):
        return {PAIRS[0]: rng.standard_t(2) - 3.0 * float(place[0] < 9.0)}
    test = PoseTest([agreement(place) for place in places], places)
    for _ in range(n):
        place = BOUNDS[0] + rng.uniform(0.0, 0.5, size=3)
        test.add({pair: value - shift for pair, value in agreement(place).items()}, place)
    return test.deviations()[PAIRS[0]]


def test_agreements_are_compared_with_references_nearby():
    assert abs(moving(0.0)) < 2.0
    assert moving(3.0) > 4.0
