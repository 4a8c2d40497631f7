"""What a calibration found, as text."""

import numpy as np

from rhs_isac_ros.calibration.calibration import Calibration
from rhs_isac_ros.model import Scenario

# Number of elements that are listed.
_N_WORST = 5


def report(calibration: Calibration, scenario: Scenario) -> str:
    """Describe failed elements, the largest errors, and gains and phases of the bands.

    Uncertainties are standard deviations.
    """
    surface, about = calibration.surface, calibration.about
    n = scenario.n_elements
    std = surface.std()
    failed: list[int] = np.nonzero(surface.failed)[0].tolist()
    expected = float(surface.failed_probability.sum())
    lines = [
        f'{about.get("pilots", 0)} pilots, scenario {calibration.scenario_id}',
        f'failed elements: {len(failed)} of {n} (expected number {expected:.2f})']
    if not about.get('converged', True):
        lines.append(f'warning: the estimation did not converge in {about.get("rounds")} rounds')
    lines += [f'  {_place(scenario, m)}: stuck at {surface.offsets[m].real:.3f} '
              f'+- {std[n + m]:.3f}, probability {surface.failed_probability[m]:.3f}'
              for m in failed]
    errors = np.abs(surface.gains - 1)
    working = np.nonzero(~surface.failed)[0]
    if len(working):
        lines.append(
            f'errors of working elements: {_percent(_rms(errors[working]))} rms, known to '
            f'{_percent(_rms(std[working]))} rms')
        order = np.argsort(-errors[working], kind='stable')
        worst: list[int] = working[order][:_N_WORST].tolist()
        lines += [f'  {_place(scenario, m)}: {_percent(errors[m])} +- {_percent(std[m])}'
                  for m in worst]
    for band, (gain, deviation) in enumerate(
            zip(surface.band_gains, std[2 * n:], strict=True)):
        lines.append(
            f'band {band}: gain {20 * np.log10(abs(gain)):+.2f} dB +- '
            f'{20 / np.log(10) * deviation:.2f} dB, phase {np.angle(gain):+.3f} rad +- '
            f'{deviation:.3f} rad')
    return '\n'.join(lines)


def _place(scenario: Scenario, element: int) -> str:
    row, column = divmod(element, scenario.elements_per_side)
    return f'element {element} (row {row}, column {column})'


def _percent(value: float) -> str:
    return f'{100 * value:.2f} %'


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))
