"""Position error bounds in the near field beside those of a published implementation.

Problem: publications on the near field bound the error of a user with an unknown complex gain, and
a known or unknown clock, in a plane. Does the Cramer-Rao bound of a scenario with unknown phase,
gain and timing agree? The reference values are outputs of the function getPEBGeneral of
github.com/henkwymeersch/NearField5GLocalization, for a line of 33 antennas and 33 sub-carriers at
28 GHz. Its information lacks the factor 2 of complex signals, so its bounds are divided by the
square root of 2.
"""

import math

import numpy as np
from parts import frame

from rhs_isac_ros.bounds import crlb
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.surface import AppliedBeams

# Boltzmann's constant times 290 K, in dBm/Hz.
NOISE_DBM_HZ = 10 * math.log10(1.380649e-23 * 290 * 1e3)
# Its speed of light is 3e8 m/s; all frequencies and the power are scaled accordingly.
SCALE = 299_792_458 / 3e8
N = 33
RANGES_M = (1, 2, 4, 8, 16, 32)
# Spacing [wavelengths], and bounds with a known and an unknown clock at each range [m].
PUBLISHED = {
    0.5: ((0.001602587363, 0.002594025895, 0.004861811802, 0.009614907901, 0.01983658922,
           0.04488212816),
          (0.005886409654, 0.01459210817, 0.07775543838, 0.5555607623, 4.31705058, 34.2842716)),
    2.0: ((0.0003448490329, 0.0008669660546, 0.00344729956, 0.009167786897, 0.01888726866,
           0.03816667549),
          (0.0003525335078, 0.0009175972361, 0.004884300331, 0.03477772607, 0.2699289312,
           2.142994959)),
    8.0: ((1.892723459e-05, 6.547419303e-05, 0.0003296011428, 0.002171128337, 0.01264160765,
           0.03633100561),
          (1.892824882e-05, 6.549109992e-05, 0.0003303064518, 0.002228865573, 0.01698384681,
           0.1341651764))}


def bound_m(spacing_wavelengths: float, range_m: float, *, clock_is_known: bool) -> float:
    """Compute the bound on the position error in the plane of the antennas [m]."""
    scenario = Scenario(
        center_frequencies_hz=(28e9 * SCALE,), n_subbands=N, subband_width_hz=0.1e9 * SCALE / N,
        n_frames=N, elements_per_side=(N, 1), element_interval_wavelengths=spacing_wavelengths,
        n_feeds=1, max_power_w=1e-3 * SCALE, noise_psd_dbm_hz=NOISE_DBM_HZ,
        multipath_to_los_db=-200.0, phase_std_rad=math.inf, user_gain_std_db=math.inf,
        timing_std_s=0.0 if clock_is_known else math.inf,
        # The height is known, and the prior is negligible along the other axes.
        roi_center_m=(1e3, 0.0, 0.0), roi_size_m=(1.99e3, 2e3, 0.0))
    # One antenna in each frame.
    beams = AppliedBeams(np.eye(N, dtype=complex)[None], np.full(
        (1, N, N, 1), math.sqrt(scenario.max_power_w / N), complex))
    position = np.array([[range_m, 1.0, 0.0]])
    return math.sqrt(crlb(scenario, beams, position, region_prior=True)[0])


def main() -> None:
    """Run the benchmark."""
    options = frame.benchmark_parser('near_field', __doc__, default_seed=None).parse_args()
    table = frame.Table(['spacing [wavelengths]', 'range [m]', 'clock'], {
        'bound [mm]': ('bound_mm', 4), 'published [mm]': ('published_mm', 4),
        'ratio': ('ratio', 4)})
    rows = []
    for spacing, published in PUBLISHED.items():
        for clock, values in zip(('known', 'unknown'), published, strict=True):
            for range_m, value in zip(RANGES_M, values, strict=True):
                published_mm = 1e3 * value / math.sqrt(2)
                bound_mm = 1e3 * bound_m(spacing, range_m, clock_is_known=clock == 'known')
                rows.append({'spacing': spacing, 'range_m': range_m, 'clock': clock, **table.row(
                    str(spacing), str(range_m), clock, bound_mm=bound_mm,
                    published_mm=published_mm, ratio=published_mm / bound_mm)})
    frame.write_results(options.json, rows)


if __name__ == '__main__':
    frame.run(main)
