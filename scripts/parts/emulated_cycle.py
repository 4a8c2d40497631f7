"""The signals of cycles that the role `channel` emulates, with any surface and radio."""

from collections.abc import Callable

import numpy as np

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.frontend import Air, EmulatedRadio, EmulatedSurface, FrontEnd, Radio
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.elements import SurfaceEstimate
from rhs_isac_ros.model.los import draw_blocked
from rhs_isac_ros.model.measurement import receive_feeds
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.channel import Channel, apply_patterns
from rhs_isac_ros.protocol.settings import Impairments
from rhs_isac_ros.support import streams


class EmulatedLink:
    """The channel and the front end of one surface; the multipath of each cycle is a new draw.

    The seed determines the surface, the users, their multipath and noise.
    """

    def __init__(self, scenario: Scenario, seed: int, make: Callable[[Scenario, Air], Radio],
                 states: SurfaceEstimate | None = None) -> None:
        self._scenario, self._seed = scenario, seed
        self._air = Air(scenario, np.random.default_rng(seed))
        self._radio = make(scenario, self._air)
        self._front_end = FrontEnd(
            EmulatedSurface(scenario.n_elements), self._radio, self._air)
        self._channel = Channel(scenario, seed, Impairments(multipath_memory=False), states)

    def is_blocked(self, user: int) -> bool:
        """Return whether a user has no direct path; drawn like the channel draws it."""
        rng = streams.generator(self._seed, streams.BLOCKAGE, user)
        return bool(draw_blocked(self._scenario, 1, rng)[0])

    def received(self, codebook: Codebook, cycle_id: int, user: int, position: np.ndarray
                 ) -> np.ndarray:
        """Return the signals of a cycle, complex128 [N_B, N_SB F].

        `position` is that in the site, [3] [m], or position and velocity, [6] [m, m/s].
        """
        # Start and carrier of the radio are drawn again.
        self._radio.close()
        feeds = np.stack([self._feeds(codebook, cycle_id, user, position, band)
                          for band in range(self._scenario.n_bands)])
        # Other radios have noise of their own.
        noise = self._air.rng if isinstance(self._radio, EmulatedRadio) else None
        signals = receive_feeds(self._scenario, codebook, feeds, noise)
        return signals.reshape(len(feeds), -1)

    def _feeds(self, codebook: Codebook, cycle_id: int, user: int, position: np.ndarray,
               band: int) -> np.ndarray:
        """Return the signals at the feeds for the pilots of a band, complex128 [F, N_SB, K]."""
        analog = codebook.analog[band]
        for event in (
                m.GroundTruth(cycle_id=cycle_id, user=user, position=position[:3],
                              velocity=np.append(position[3:], np.zeros(3))[:3]),
                m.RhsConfiguration(cycle_id=cycle_id, mode=m.Mode.POSITIONING, band=band,
                                   codebook_id=codebook.id, analog=analog),
                m.Pilot(cycle_id=cycle_id, user=user, band=band,
                        symbols=np.ones(len(analog), complex))):
            actions = self._channel.handle(event, 0.0)
        (answer,) = self._channel.handle(apply_patterns(self._front_end, actions[0]), 0.0)
        return answer.message.signals
