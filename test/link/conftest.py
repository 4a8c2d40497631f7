"""Reference implementation of the transmission phase: the paper's equations as plain loops."""

import numpy as np
import pytest

from rhs_isac_ros.link import Beamformer


class ReferenceLink:
    """The link of one band, computed one index at a time from a given covariance V."""

    def __init__(self, plain, spatial, band=0):
        self.plain, self.spatial, self.band = plain, spatial, band
        scenario = plain.scenario
        self.noise = 10**(scenario.noise_psd_dbm_hz / 10) / 1000 * scenario.subband_width_hz
        self.elements = range(scenario.elements_per_side**2)
        self.onboard = np.array([[[plain.onboard(band, j, k, m) for m in self.elements]
                                  for k in range(scenario.n_feeds)]
                                 for j in range(scenario.n_subbands)])

    def los(self, position):
        """Line-of-sight gains, [N_SB, N_E]."""
        return np.array([[self.plain.los(position, self.band, j, m) for m in self.elements]
                         for j in range(self.plain.scenario.n_subbands)])

    def capacity(self, beam, position):
        scenario, los, total = self.plain.scenario, self.los(position), 0.0
        for j in range(scenario.n_subbands):
            t = [beam.analog[m] * sum(beam.digital[j, k] * self.onboard[j, k, m]
                                      for k in range(scenario.n_feeds)) for m in self.elements]
            direct = abs(sum(t[m] * los[j, m] for m in self.elements))**2
            scattered = sum(t[a] * self.spatial[a, b] * np.conj(t[b])
                            for a in self.elements for b in self.elements).real
            total += np.log2(1 + (direct + scattered) / self.noise)
        return scenario.subband_width_hz * total

    def best_beam(self, analog, position):
        """Beam with the highest capacity for a given configuration."""
        scenario, los = self.plain.scenario, self.los(position)
        gains, directions = [], []
        for j in range(scenario.n_subbands):
            configured = self.onboard[j] * analog
            direct = configured @ los[j]
            channel = np.outer(direct, direct.conj())
            channel += configured @ self.spatial @ configured.conj().T
            values, vectors = np.linalg.eigh(channel)
            gains.append(values[-1] / self.noise)
            directions.append(vectors[:, -1].conj())
        shares = water_filling_by_bisection(np.array(gains), scenario.max_power_w)
        return Beamformer(analog, np.array(directions) * np.sqrt(shares)[:, None], self.band)


def water_filling_by_bisection(gains, power):
    """Water-filling by bisection of the water level."""
    floors = np.array([1 / g if g > 0 else np.inf for g in gains])
    low, high = floors.min(), floors.min() + power
    for _ in range(200):
        level = (low + high) / 2
        if np.maximum(level - floors, 0).sum() > power:
            high = level
        else:
            low = level
    return np.maximum(low - floors, 0)


@pytest.fixture(scope='session')
def bisection():
    return water_filling_by_bisection


@pytest.fixture(scope='session')
def reference_link(plain):
    """Callable that takes a case and a band and returns the reference link."""
    def make(case, band=0):
        return ReferenceLink(plain(case.scenario), case.vectors['V'][band], band)
    return make
