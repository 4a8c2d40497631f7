"""Measured multipath: a covariance that takes the place of the declared one.

Gains g of the elements in all measurements of a band are Gaussian with the covariance C_0 that
three fields of the scenario declare. A survey with the radiation matrix T replaces the covariance
L_0 of its signals T g + noise by a measured one, L, and leaves the distribution of g given these
signals as it is. Of all covariances whose signals have the covariance L, that of g is then the
closest to C_0 in the sense of Kullback and Leibler, apart from the noise:

    C = C_0 + C_0 T^H M T C_0    with    M = L_0^-1 (L - L_0) L_0^-1.

It yields the covariance for any other beams, and for single elements.
"""

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np

from rhs_isac_ros.support.files import ArchiveError, ArrayFile, read_archive, write_archive

_FORMAT = 1
# Fields of the scenario that a measured covariance replaces.
FIELDS = ('multipath_to_los_db', 'delay_spread_s', 'angular_spread_deg')
# Fields on which it depends; they are written to the file.
CONDITIONS = (
    'center_frequencies_hz', 'n_subbands', 'subband_width_hz', 'n_frames', 'elements_per_side',
    'element_interval_wavelengths', 'multipath_direction_deg', 'roi_center_m', 'roi_size_m')


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class MultipathEstimate(ArrayFile):
    """A measured covariance of the multipath, as a value of the field `Scenario.multipath`.

    Attributes
    ----------
    multipath_to_los_db, delay_spread_s, angular_spread_deg
        The fields of C_0.
    radiation
        T_i of the survey, complex128 [N_B, N_SB F, N_E].
    excess
        M_i, complex128 [N_B, N_SB F, N_SB F] [1/W].
    conditions
        Fields of the scenario of the survey on which it depends.
    about
        How it was made: ``positions``, their number; ``prior_weight`` nu, ``inflation`` t and
        ``level_std_db``, the standard deviation of the power among users [dB];
        ``coverage``, the expected share of positions in the 95 % region, with its interval;
        ``warnings``; ``codebook``, its id; ``version``.
    path
        File from which it was read.

    Raises
    ------
    ArchiveError
        If sizes disagree or a number is not finite.
    """

    multipath_to_los_db: float
    delay_spread_s: float
    angular_spread_deg: float
    radiation: np.ndarray
    excess: np.ndarray
    conditions: dict[str, Any]
    about: dict[str, Any] = dataclasses.field(default_factory=dict)
    path: str = ''

    def __post_init__(self) -> None:
        """Check sizes and numbers, and make the arrays read-only."""
        n_bands, n_rows = np.shape(self.radiation)[:2] if np.ndim(self.radiation) == 3 else (0, 0)
        if not n_bands or np.shape(self.excess) != (n_bands, n_rows, n_rows):
            raise ArchiveError(
                f'excess: shape {np.shape(self.excess)} with radiation '
                f'{np.shape(self.radiation)}, expected [N_B, R, R] with [N_B, R, N_E]')
        for name in (*FIELDS, 'radiation', 'excess'):
            if not np.isfinite(getattr(self, name)).all():
                raise ArchiveError(f'{name}: not finite, expected finite numbers')
        for array in (self.radiation, self.excess):
            array.flags.writeable = False

    @property
    def level_db(self) -> tuple[float, float]:
        """Median and standard deviation of the level of a user's multipath [dB].

        The median is below 0 dB, because the covariance is larger than the multipath by the
        inflation of the survey.
        """
        return (-10 * math.log10(self.about.get('inflation', 1.0)),
                self.about.get('level_std_db', 0.0))

    def content(self) -> tuple[np.ndarray, ...]:
        """Return the arrays that the digest covers."""
        fields = np.array([getattr(self, name) for name in FIELDS])
        return fields, self.radiation, self.excess

    def misfit(self, scenario: Any) -> str:
        """Return why the covariance does not fit a scenario; empty if it does."""
        for name in CONDITIONS:
            own, other = _plain(self.conditions.get(name)), _plain(getattr(scenario, name))
            if own != other:
                return f'a survey with {name} {own}, expected {other} as in the scenario'
        return ''

    def save(self, path: str | Path) -> None:
        """Write the estimate to a file of NumPy's format ``.npz``, without pickled objects.

        An existing file is replaced at the end, or kept if there is an `OSError`.
        """
        write_archive(path, {'radiation': self.radiation, 'excess': self.excess}, {
            'format': _FORMAT, 'about': self.about, 'conditions': self.conditions,
            **{name: getattr(self, name) for name in FIELDS}})

    @classmethod
    def load(cls, path: str | Path) -> 'MultipathEstimate':
        """Read an estimate from a file.

        Raises
        ------
        ArchiveError
            If the file cannot be read, is damaged, or does not contain an estimate.
        """
        arrays, about = read_archive(path, 'multipath', _FORMAT, {'radiation', 'excess'})
        try:
            level, delay, angle = (float(about[name]) for name in FIELDS)
            return cls(level, delay, angle, arrays['radiation'].astype(complex),
                       arrays['excess'].astype(complex), dict(about['conditions']),
                       dict(about['about']), str(path))
        except (KeyError, TypeError, ValueError) as error:
            raise ArchiveError(f'{path}: {error}') from None


def _plain(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value
