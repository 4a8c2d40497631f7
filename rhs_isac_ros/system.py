"""The system: one surface with its base station, and the file that names its parts.

A `System` answers all questions about a positioning phase: it is the `MeasurementModel` of the
signals, simulates them, bounds the error and steers beams. Estimators and sites take a system. The
file of a system names a scenario, a codebook and, optionally, a calibration, as does each entry of
the file of a site.
"""

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rhs_isac_ros.bounds import crlb_of
from rhs_isac_ros.calibration import load_surface
from rhs_isac_ros.codebook import Codebook, CodebookError
from rhs_isac_ros.link import Beamformer, Choice, choose_beam, steer
from rhs_isac_ros.model import MeasurementModel, Pose, Scenario
from rhs_isac_ros.model.elements import SurfaceEstimate
from rhs_isac_ros.model.measurement import KnownSurface
from rhs_isac_ros.support import streams
from rhs_isac_ros.support.arguments import input_file
from rhs_isac_ros.support.errors import translated
from rhs_isac_ros.support.fields import whole
from rhs_isac_ros.support.files import mapping_of, read_yaml
from rhs_isac_ros.support.threads import map_blocks

# Number of pairs that share a random generator and all matrix products. Another number would
# change the pairs of every seed.
_CHUNK = 512
# Options of commands for files that describe a system.
_FILES = {
    'config': "scenario file; by default that of the recording, if any, or the paper's Table I",
    'codebook': 'codebook to assume; by default that of the recording, if any',
    'calibration': 'calibration of the surface; by default the surface of the scenario',
    'system': 'system file, which names these files, except for those that are also given'}


class System(MeasurementModel):
    """A scenario, a codebook, and the knowledge of the surface: the model of all signals.

    Without a `surface`, the errors of its elements have the distribution that the scenario
    declares. Otherwise the errors are known (`ElementErrors`), or the coefficients are estimated
    (the attribute `surface` of a `Calibration`). The pose is that of the scenario. These are the
    attributes `scenario`, `codebook` and `surface`; estimators, sites and roles take the system.

    Raises CodebookError if the codebook does not fit the scenario, ValueError if the surface does
    not, and TypeError if one of them has another class.

    Examples
    --------
    >>> system = System(Scenario(), Codebook.default())
    >>> users = np.array([[8.0, 1.0, 0.2], [12.0, -2.0, 0.5]])
    >>> received = system.sample(users, np.random.default_rng(1))
    >>> received.shape, np.sqrt(system.crlb(users)).round(2)  # [m]
    ((2, 2, 32), array([0.11, 0.25]))
    """

    def __init__(self, scenario: Scenario, codebook: Codebook,
                 surface: KnownSurface | None = None) -> None:
        for name, value, kind, expected in (
                ('scenario', scenario, Scenario, 'a Scenario'),
                ('codebook', codebook, Codebook, 'a Codebook'),
                ('surface', surface, KnownSurface | None, 'the surface of a Calibration')):
            if not isinstance(value, kind):
                raise TypeError(f'{name}: {type(value).__name__}, expected {expected}')
        with translated(CodebookError, CodebookError, f'codebook {codebook.id}'):
            codebook.check(scenario)
        super().__init__(scenario, codebook, surface)
        self.codebook = codebook

    @classmethod
    def from_yaml(cls, path: str | Path) -> 'System':
        """Read the file of a system, and the files that it names; paths are relative to it.

        Raises ValueError if one of them is invalid, or they do not fit together.
        """
        return SystemFiles.named_in(path).load()

    @property
    def pose(self) -> Pose:
        """Pose of the surface in the frame of its site."""
        return self.scenario.pose

    def crlb(self, positions: np.ndarray, *, region_prior: bool = False) -> np.ndarray:
        """Compute the Cramer-Rao bound at positions [N, 3] [m], float64 [N] [m^2]; see `crlb`."""
        return crlb_of(self, positions, region_prior=region_prior)

    def steer(self, position: np.ndarray, band: int = 0) -> Beamformer:
        """Find the beam for a user at a position, float64 [3] [m]; see the function `steer`."""
        return steer(self.scenario, position, band, self._steered)

    def choose_beam(self, mean: np.ndarray, covariance: np.ndarray | None = None,
                    bands: Sequence[int] | None = None) -> Choice:
        """Choose a beam and its band for an estimate; see the function `choose_beam`."""
        return choose_beam(self.scenario, mean, covariance, bands, self._steered)

    @property
    def _steered(self) -> SurfaceEstimate | None:
        if self.surface is None or isinstance(self.surface, SurfaceEstimate):
            return self.surface
        raise ValueError('surface: known errors of elements, expected an estimate for steering')

    def pairs(self, n: int, seed: int, first: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """Simulate positioning phases at random positions of the region of interest.

        A seed defines an infinite sequence of pairs, of which this method returns n, beginning
        with `first`. The pairs do not depend on how calls divide the sequence. Returns positions,
        float64 [n, 3] [m], uniform in the region, and received signals,
        complex128 [n, N_B, N_SB F], sub-band-major. Raises ValueError unless all arguments
        are integers from 0.
        """
        n, seed, first = whole('n', n), whole('seed', seed), whole('first', first)
        positions = np.empty((n, 3))
        received = np.empty((n, *self.shape), complex)

        def fill(chunk: int) -> None:
            begin = chunk * _CHUNK
            part = slice(max(first - begin, 0), min(first + n - begin, _CHUNK))
            target = slice(begin + part.start - first, begin + part.stop - first)
            # Draw the whole chunk, because the rounding of matrix products depends on their sizes.
            rng = streams.generator(seed, streams.PHASES, chunk)
            drawn = self.scenario.sample_positions(_CHUNK, rng)
            positions[target] = drawn[part]
            received[target] = self.sample(drawn, rng)[part]

        map_blocks(fill, range(first // _CHUNK, -(-(first + n) // _CHUNK)))
        return positions, received


class SystemFileError(ValueError):
    """The file of a system is invalid."""


class SystemFiles(NamedTuple):
    """Paths of the files of a system."""

    scenario: Path
    codebook: Path
    calibration: Path | None = None

    @classmethod
    def named_in(cls, path: str | Path) -> 'SystemFiles':
        """Read the file of a system; raise SystemFileError if it is invalid."""
        with translated(ValueError, SystemFileError):
            content = read_yaml(path)
        with translated((ValueError, TypeError), SystemFileError, path):
            return cls.of(content, Path(path).parent)

    @classmethod
    def of(cls, content: Any, folder: Path) -> 'SystemFiles':
        """Take the paths in a mapping, which are relative to a folder."""
        names = mapping_of(content, {'scenario', 'codebook'}, {'calibration'})
        return cls(**{name: folder / path for name, path in names.items()})

    def load(self, adapted: Callable[[Scenario], Scenario] = lambda scenario: scenario) -> System:
        """Load the system, whose scenario may be adapted to a site.

        Raises ValueError if a file is invalid or does not belong to the scenario.
        """
        scenario = Scenario.from_yaml(self.scenario)
        surface = load_surface(str(self.calibration or ''), scenario)
        scenario = adapted(scenario)
        return System(scenario, Codebook.load(self.codebook, scenario), surface)


def add_files(parser: argparse.ArgumentParser, *names: str) -> None:
    """Add options for files that describe a system; the names are keys of `_FILES`."""
    for name in names:
        parser.add_argument(f'--{name}', type=input_file, metavar='FILE', help=_FILES[name])


def fill_in(options: argparse.Namespace) -> None:
    """Fill in the files that are named by a system file and are not given as options."""
    if getattr(options, 'system', None):
        for name, path in SystemFiles.named_in(options.system)._asdict().items():
            option = 'config' if name == 'scenario' else name
            if getattr(options, option, path) is None:
                setattr(options, option, path)
