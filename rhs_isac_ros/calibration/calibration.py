"""A calibration: the estimate of a surface, the scenario to which it applies, and its file."""

import dataclasses
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rhs_isac_ros import __version__
from rhs_isac_ros.calibration.estimate import (
    MAX_UNEXPLAINED,
    TOLERANCE,
    Pilots,
    check_pilots,
    estimate_surface,
    prior_of,
    residuals_of,
)
from rhs_isac_ros.calibration.mixture import SurfacePrior
from rhs_isac_ros.model import MeasurementModel, Scenario, SurfaceEstimate
from rhs_isac_ros.model.constants import NEPERS_PER_DB
from rhs_isac_ros.model.gaussian import energy_limit
from rhs_isac_ros.support.errors import translated
from rhs_isac_ros.support.files import ArchiveError, read_archive, read_once, write_archive

_FORMAT = 1
# Arrays in a file, and standard deviations, which are only for human readers.
_ARRAYS = tuple(field.name for field in dataclasses.fields(SurfaceEstimate))
_DEVIATIONS = ('gains_std', 'offsets_std', 'band_gains_std')
# Number of working elements that a report lists.
_N_WORST = 5


class CalibrationWarning(UserWarning):
    """A calibration does not explain the signals of its pilots."""


class CalibrationError(ValueError):
    """A calibration cannot be read, is malformed, or belongs to another scenario."""


@dataclasses.dataclass(frozen=True, eq=False)
class Calibration:
    """An estimate of a surface, the scenario to which it applies, and a record of its origin."""

    surface: SurfaceEstimate  #: The estimate, as used by estimators, bounds and beams.
    scenario_id: str  #: `Scenario.id` without pose, files of the hall and movement of users.
    #: Record of the calibration: ``pilots``, their number; ``codebooks``, their ids; ``prior`` of
    #: the elements; ``scenario``, the fields that differ from Table I; ``rounds`` of the
    #: estimation, and whether it ``converged``; ``warnings``; ``version``. The record of known
    #: ``states`` has no estimation.
    about: dict[str, Any]

    @property
    def id(self) -> str:
        """Hash of the coefficients and their covariance: ``ca`` and 16 hexadecimal digits."""
        return f'ca{self.surface.id}'

    def check(self, scenario: Scenario) -> None:
        """Raise CalibrationError unless the calibration applies to a scenario."""
        expected_id = _of_surface(scenario).id
        if self.scenario_id != expected_id:
            raise CalibrationError(
                f'scenario_id: {self.scenario_id}, a calibration for the scenario '
                f'{self.about.get("scenario")}, expected {expected_id}')
        sizes = len(self.surface.band_gains), len(self.surface.gains)
        expected = scenario.n_bands, scenario.n_elements
        if sizes != expected:
            raise CalibrationError(f'gains: N_B, N_E = {sizes}, expected {expected}')

    def save(self, path: str | Path) -> None:
        """Write the calibration to a file of NumPy's format ``.npz``, without pickled objects.

        An existing file is replaced only when the new one is complete.
        """
        surface, std = self.surface, self.surface.std()
        n = len(surface.gains)
        deviations = dict(zip(_DEVIATIONS, np.split(std, [n, 2 * n]), strict=True))
        arrays = {name: getattr(surface, name) for name in _ARRAYS}
        write_archive(path, arrays | deviations, {
            'format': _FORMAT, 'scenario_id': self.scenario_id, **self.about})

    @classmethod
    @read_once
    def load(cls, path: str | Path) -> 'Calibration':
        """Read a calibration from a file; raise CalibrationError if the file is invalid."""
        with translated(ArchiveError, CalibrationError):
            arrays, about = read_archive(path, 'calibration', _FORMAT, {*_ARRAYS, *_DEVIATIONS})
        with translated((TypeError, ValueError), CalibrationError, path):
            surface = SurfaceEstimate(**{name: arrays[name] for name in _ARRAYS})
            return cls(surface, str(about.pop('scenario_id', '')), about)


def calibrate(scenario: Scenario, pilots: Sequence[Pilots],
              prior: SurfacePrior | None = None) -> Calibration:
    """Estimate a surface from pilots of one or several codebooks; add the scenario and a record.

    The default prior is the result of `prior_of`. Without pilots, the estimate is the prior.
    Pilots at one place, within a quarter of a wavelength, together have the weight of one pilot.

    Raises ValueError if positions are far from the region, or signals are zero. Warns with
    CalibrationWarning if the result does not explain the signals of a third of the pilots.
    """
    prior = prior or prior_of(scenario)
    check_pilots(scenario, pilots)
    surface, changes = estimate_surface(scenario, pilots, prior)
    texts = _warnings(scenario, pilots, surface)
    if texts:
        warnings.warn('; '.join(texts), CalibrationWarning, stacklevel=2)
    codebooks = sorted({str(getattr(group.beams, 'id', '')) for group in pilots} - {''})
    return Calibration(surface, _of_surface(scenario).id, {
        'pilots': sum(len(group.positions) for group in pilots), 'codebooks': codebooks,
        'prior': dataclasses.asdict(prior), 'scenario': scenario.changes(),
        'rounds': len(changes), 'converged': not changes or changes[-1] < TOLERANCE,
        'warnings': texts, 'version': __version__})


def known_states(scenario: Scenario, off: complex, on: complex) -> Calibration:
    """Return the calibration of a surface whose elements have the coefficients `off` and `on`.

    These are the coefficients for 0 and 1 in a configuration, known exactly, in all bands.
    Raises ValueError if one of them is not finite, or the board has other coefficients.
    """
    if not scenario.board.is_amplitude:
        raise ValueError(f'board: {scenario.board.kind!r} with states of elements, expected '
                         "'paper': the board itself has the coefficients")
    n, n_bands = scenario.n_elements, scenario.n_bands
    surface = SurfaceEstimate(
        np.full(n, on - off), np.full(n, off), np.ones(n_bands),
        np.zeros((2 * n + n_bands, 0)), np.zeros(n))
    return Calibration(surface, _of_surface(scenario).id, {
        'pilots': 0, 'states': [str(off), str(on)], 'scenario': scenario.changes(),
        'version': __version__})


def _warnings(
        scenario: Scenario, pilots: Sequence[Pilots], surface: SurfaceEstimate) -> list[str]:
    """Return reasons why an estimate of a surface may be wrong."""
    n, n_unexplained = sum(len(group.positions) for group in pilots), 0
    for group in pilots:
        model = MeasurementModel(scenario, group.beams, surface)
        white = model.whiten(residuals_of(model, group))
        energies = np.sum(np.abs(white)**2, axis=(1, 2))
        n_unexplained += int(np.sum(energies > energy_limit(int(np.prod(model.shape)))))
    if n_unexplained <= MAX_UNEXPLAINED * n:
        return []
    return [f'positions: {n_unexplained} of {n} pilots do not fit the surface, as if they were '
            f'shifted, expected at most {100 * MAX_UNEXPLAINED:.0f} %']


def _of_surface(scenario: Scenario) -> Scenario:
    """Return a scenario without what does not affect a surface.

    These are its pose, files of the hall, and the movement of users in a cycle.
    """
    return dataclasses.replace(scenario.unplaced, multipath=None, channel=None, retune_s=0.0,
                               user_speed_std_mps=0.0)


def load_surface(path: str, scenario: Scenario) -> SurfaceEstimate | None:
    """Return the estimate in a calibration file; None if the path is empty.

    Raises CalibrationError if the file is invalid or belongs to another scenario.
    """
    if not path:
        return None
    calibration = Calibration.load(path)
    with translated(CalibrationError, CalibrationError, path):
        calibration.check(scenario)
    return calibration.surface


def report(calibration: Calibration, scenario: Scenario) -> str:
    """Describe failed elements, largest errors and band gains, each with a standard deviation."""
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
    lines += [f'warning: {text}' for text in about.get('warnings', ())]
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
            f'{deviation / NEPERS_PER_DB:.2f} dB, phase {np.angle(gain):+.3f} rad +- '
            f'{deviation:.3f} rad')
    return '\n'.join(lines)


def _place(scenario: Scenario, element: int) -> str:
    if scenario.element_positions_m is not None:
        return f'element {element}'
    row, column = divmod(element, scenario.n_columns)
    return f'element {element} (row {row}, column {column})'


def _percent(value: float) -> str:
    return f'{100 * value:.2f} %'


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))
