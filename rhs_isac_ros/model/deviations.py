"""Scenario fields for deviations from the paper's model."""

import dataclasses

from rhs_isac_ros.model.fields import declare


@dataclasses.dataclass(frozen=True)
class Deviations:
    """Deviations of real signals from the paper's model; by default there are none.

    A standard deviation is that of a zero-mean Gaussian. Phases are angles, so their Gaussian is
    wrapped to the circle: from a standard deviation of 2 pi on, a phase is uniform in effect,
    because its mean resultant length, exp(-std^2 / 2), is below 3e-9.

    A user's gain and carrier offset are drawn once per user. Phases and the timing offset are
    drawn once per cycle, and element errors and failures once per surface.
    """

    multipath_to_los_db: float = declare(
        0.0, -200.0, 100.0,
        'Power of the multipath at an element, relative to the mean power of the direct path in '
        'the region. The paper does not normalise the profile of Eq. (2); 0 dB is the reading '
        'of this package.', 'dB',
        'inverse Rice factor, 3GPP TR 38.901, section 7.5', label='multipath / direct path')
    user_gain_std_db: float = declare(
        0.0, 0.0, 60.0,
        "Standard deviation of the gain of a user, log-normal, in addition to user_gain: "
        'transmit power, antenna and shadowing. It acts on the direct path and on the multipath.',
        'dB', 'log-normal shadow fading, 3GPP TR 38.901, section 7.4',
        label='user gain, standard deviation')
    phase_std_rad: float = declare(
        0.0, 0.0, 1e3,
        'Standard deviation of a phase that all bands of a cycle share; 6.2832 for a uniform '
        'phase.', 'rad',
        'wrapped normal distribution, Mardia and Jupp, Directional Statistics, 2000, '
        'section 3.5', label='common phase, standard deviation')
    band_phase_std_rad: float = declare(
        0.0, 0.0, 1e3,
        'Standard deviation of a phase that each band of a cycle draws independently, as after '
        'retuning an oscillator; 6.2832 for a uniform phase.', 'rad',
        'wrapped normal distribution, Mardia and Jupp, Directional Statistics, 2000, '
        'section 3.5', label='phase of a band, standard deviation')
    timing_std_s: float = declare(
        0.0, 0.0, 1.0,
        'Standard deviation of the sampling-time offset of a cycle, a phase that is linear over '
        'the sub-bands.', 's',
        'Speth, Fechtel, Fock and Meyr, Optimum receiver design for wireless broad-band systems '
        'using OFDM, part I, IEEE Trans. Commun. 47 (11), 1999',
        label='timing offset, standard deviation')
    carrier_offset_std_hz: float = declare(
        0.0, 0.0, 1e9,
        "Standard deviation of the carrier frequency offset of a user's oscillator, the same in "
        'all bands, a phase that is linear over the frames of a band.', 'Hz',
        'Moose, A technique for orthogonal frequency division multiplexing frequency offset '
        'correction, IEEE Trans. Commun. 42 (10), 1994',
        label='carrier offset, standard deviation')
    element_error_rms: float = declare(
        0.0, 0.0, 1.0,
        'RMS of the complex error of an element coefficient relative to its value; the error is '
        'the same in all bands and frames.', '',
        'Van Trees, Optimum Array Processing, 2002, section 2.6.3',
        label='relative error of an element, RMS')
    failed_element_share: float = declare(
        0.0, 0.0, 1.0,
        'Probability that an element has failed. A failed element is stuck at an amplitude that '
        'is uniform in [0, 1] and the same in all bands and frames.', '',
        'stuck-at faults, Taghvaee, Cabellos-Aparicio, Georgiou and Abadal, Error analysis of '
        'programmable metasurfaces for beam steering, IEEE J. Emerg. Sel. Top. Circuits Syst. '
        '10 (1), 2020', label='share of failed elements')
    amplitude_levels: int = declare(
        0, 0, 65536,
        'Number L of amplitudes k / (L - 1) that an element can take: 2 for one bit; 0 if '
        'amplitudes are continuous.', '',
        'Smith, Yurduseven, Mancera, Bowen and Kundtz, Analysis of a waveguide-fed metasurface '
        'antenna, Phys. Rev. Applied 8, 2017', label='amplitude levels $L$')
