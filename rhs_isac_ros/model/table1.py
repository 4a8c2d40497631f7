"""The parameters of Table I of the paper."""

import dataclasses

from rhs_isac_ros.model.fields import declare
from rhs_isac_ros.model.gain_pattern import GainPattern


@dataclasses.dataclass(frozen=True)
class Table1:
    """Geometry, bands and propagation as the paper defines them."""

    center_frequencies_hz: tuple[float, ...] = declare(
        (2.5e9, 3.0e9), 1e6, 1e13, 'Centre frequency f_c,i of each band.', 'Hz',
        label='centre frequencies $f_{c,i}$')
    n_subbands: int = declare(
        8, 1, 4096, 'Sub-bands N_SB of each band.', label=r'sub-bands $N_\mathrm{SB}$')
    subband_width_hz: float = declare(
        125e3, 1.0, 1e10, 'Width W of a sub-band.', 'Hz', label='sub-band width $W$')
    n_frames: int = declare(4, 1, 4096, 'Frames F of each band.', label='frames $F$')
    frame_duration_s: float = declare(
        4e-6, 1e-12, 1.0, 'Duration of a frame.', 's', label=r'frame duration $\Delta_t$')
    elements_per_side: int = declare(
        10, 1, 128, 'Elements along one side of the square surface.',
        label=r'elements along a side $\sqrt{N_\mathrm{E}}$')
    element_interval_wavelengths: float = declare(
        0.3, 1e-3, 10.0, 'Spacing of the elements, in mean wavelengths.',
        label=r'element spacing in $\lambda_\mathrm{avr}$')
    n_feeds: int = declare(3, 1, 256, 'Feeds K of the surface.', label='feeds $K$')
    feed_positions_m: tuple[tuple[float, float, float], ...] | None = declare(
        None, -1e3, 1e3,
        'Positions of the feeds; if null, they are evenly spaced on the centre line.', 'm',
        label='feed positions')
    refractive_index: float = declare(
        2.1, 1.0, 100.0, 'Refractive index n_r of the board.', label='refractive index $n_r$')
    element_gain: float | GainPattern = declare(
        1.0, 1e-6, 1e6, 'Amplitude gain g^E of an element.', label=r'element gain $g^\mathrm{E}$')
    user_gain: float | GainPattern = declare(
        1.0, 1e-6, 1e6, "Amplitude gain g^U of the user's antenna.",
        label=r'user gain $g^\mathrm{U}$')
    delay_spread_s: float = declare(
        0.5e-6, 0.0, 1.0, 'RMS delay spread of the multipath.', 's',
        label=r'delay spread $\sigma_\mathrm{rms}$')
    max_user_speed_mps: float = declare(
        20 / 3.6, 0.0, 1e4, 'Highest speed of a user.', 'm/s',
        label=r'user speed $v_\mathrm{max}$')
    angular_spread_deg: float = declare(
        10.0, 1e-2, 1e3, 'Angular spread of the multipath, in azimuth and elevation.', 'deg',
        label='angular spread')
    noise_psd_dbm_hz: float = declare(
        -174.0, -400.0, 100.0, 'Power spectral density P_N of the noise.', 'dBm/Hz',
        label='noise density $P_N$')
    max_power_w: float = declare(
        1e-3, 1e-15, 1e6, 'Power P_max of the combining vectors.', 'W',
        label=r'power $P_\mathrm{max}$')
    roi_center_m: tuple[float, float, float] = declare(
        (10.0, 0.0, 0.0), -1e6, 1e6, 'Centre of the region of interest.', 'm',
        label='centre of the region')
    roi_size_m: tuple[float, float, float] = declare(
        (10.0, 10.0, 2.0), 1e-6, 1e6, 'Side lengths of the region of interest.', 'm',
        label='size of the region')
