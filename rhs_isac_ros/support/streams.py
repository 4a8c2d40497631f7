"""Random generators that depend on their purpose, not on the order in which they are used."""

import functools
import threading
from typing import Any

import numpy as np

_FIRST_SOBOL = threading.Lock()
(CHANNEL, RECEIVER, USER, BASE_STATION, SAMPLES, START, HELD_OUT, SKETCH, PAIRS,
 METHOD, PHASES, TRAINING, AIR, SURFACE, USER_DEVIATION, CYCLE_DEVIATION, PLANS,
 BLOCKAGE, AGREEMENTS, RADIO) = range(20)
# The first point of a sequence and the bits in which its mirrored parts differ, by number of
# dimensions. Importing SciPy's generator would take a second of each process that estimates.
_GRAY_CODES = {
    3: (
        (913309191, 1000046633, 389465047),
        (890445161, 577319138, 801189754),
        (370832894, 1055209724, 951528116),
        (238432895, 719124076, 490310762),
        (75618629, 816451087, 719540080),
        (62685513, 546003867, 812796586),
        (27862645, 1027821192, 290676479),
        (11382659, 679897902, 738536991),
        (8319170, 871831266, 961484276),
        (2703081, 576121273, 528562144),
        (1694335, 1053377466, 700797908)),
    6: (
        (913309191, 1000046633, 389465047, 391432754, 150265301, 602049772),
        (681110348, 860456725, 1040808916, 835676900, 757700840, 855920776),
        (282308595, 657049575, 632903075, 610760352, 286478233, 367147665),
        (162632696, 1055372129, 298607441, 149558748, 172159395, 525869775),
        (68078127, 760246396, 991591303, 314885988, 565922817, 237589839),
        (65276494, 811261151, 764564816, 688511380, 856848078, 605141480),
        (21574574, 622490690, 496695295, 460128184, 950033414, 190649034),
        (15563801, 1026775413, 1034514683, 964927512, 513302116, 269148128),
        (7833107, 804828944, 616083362, 910769889, 704382214, 718189145),
        (2750281, 863456717, 329891584, 566865343, 350835472, 745128123),
        (2020348, 654974423, 940220068, 167381512, 147144715, 467287914))}


def generator(seed: int, stream: int, *key: int) -> np.random.Generator:
    """Create a generator that yields the same sequence for the same arguments.

    `stream` is one of the constants of this module. The non-negative integers `key`, such as the
    numbers of a user and a cycle, distinguish the uses of a stream.
    """
    return np.random.default_rng([seed, stream, *key])


def sobol(n_dimensions: int, seed: int | np.random.Generator) -> Any:
    """Return a scrambled Sobol sequence of SciPy."""
    # A slow import, which loading a codebook does not need.
    from scipy.stats import qmc

    # SciPy has no lock for the table that the first sequence loads.
    with _FIRST_SOBOL:
        return qmc.Sobol(n_dimensions, scramble=True, seed=seed)


@functools.cache
def unit_points(n_dimensions: int = 3) -> np.ndarray:
    """Return quasi-random points in the unit cube, float64 [1024, n_dimensions], read-only.

    These are the first points of SciPy's scrambled Sobol sequence with the seed 0 in 3 or 6
    dimensions. Successive points differ as a reflected Gray code does.
    """
    points = np.array(_GRAY_CODES[n_dimensions][:1])
    for flipped in _GRAY_CODES[n_dimensions][1:]:
        points = np.concatenate([points, points[::-1] ^ flipped])
    units = points / 2.0**30
    units.flags.writeable = False
    return units
