"""Random generators that depend on their purpose, not on the order in which they are used."""

import numpy as np

(CHANNEL, RECEIVER, USER, BASE_STATION, SAMPLES, START, HELD_OUT, SKETCH, PAIRS,
 METHOD, PHASES, TRAINING, AIR, SURFACE, USER_DEVIATION, CYCLE_DEVIATION, PLANS,
 BLOCKAGE, AGREEMENTS, RADIO) = range(20)


def generator(seed: int, stream: int, *key: int) -> np.random.Generator:
    """Create a generator that yields the same sequence for the same arguments.

    `stream` is one of the constants of this module. The non-negative integers `key`, such as the
    numbers of a user and a cycle, distinguish the uses of a stream.
    """
    return np.random.default_rng([seed, stream, *key])
