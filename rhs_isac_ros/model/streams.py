"""Random generators that depend on what they are for, not on when they are used."""

import numpy as np

(CHANNEL, RECEIVER, USER, BASE_STATION, SAMPLES, START, HELD_OUT, SKETCH, PAIRS,
 METHOD, PHASES, TRAINING, AIR) = range(13)


def generator(seed: int, stream: int, *key: int) -> np.random.Generator:
    """Make the generator of one purpose.

    Parameters
    ----------
    seed
        Seed of the run.
    stream
        The purpose, one of this module's constants.
    *key
        What tells its uses apart, such as user and cycle; not negative.

    Returns
    -------
    numpy.random.Generator
        The same sequence for the same arguments.
    """
    return np.random.default_rng([seed, stream, *key])
