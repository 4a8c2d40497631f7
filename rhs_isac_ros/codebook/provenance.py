"""The provenance of a codebook, as text that both people and programs can read."""

import dataclasses
from typing import Any

from rhs_isac_ros import __version__
from rhs_isac_ros.codebook import provenance_text
from rhs_isac_ros.codebook.codebook import Codebook
from rhs_isac_ros.codebook.search import Progress


@dataclasses.dataclass(frozen=True)
class Provenance:
    """The arguments of an optimisation and the progress it made.

    Attributes
    ----------
    positions
        Number of positions.
    scenario
        Fields of the scenario that differ from Table I.
    version
        Version of this package.
    calibration
        Id of the calibration; empty without one.
    steps, evaluations
        Totals, including those of the runs that it resumed.
    value_m2
        The objective [m^2].
    reason
        Why the search stopped.
    """

    method: str
    objective: str
    seed: int
    sampling: str
    positions: int
    scenario: dict[str, Any]
    version: str = __version__
    calibration: str = ''
    steps: int = 0
    evaluations: int = 0
    value_m2: float = float('nan')
    reason: str = ''

    def to_text(self, end: Progress, reason: str) -> str:
        """Return one line that describes a result, for `Codebook.provenance`."""
        result = dataclasses.replace(
            self, steps=end.step, evaluations=end.evaluations, value_m2=float(end.value_m2),
            reason=reason)
        fields = dataclasses.asdict(result)
        if not self.calibration:
            del fields['calibration']
        return provenance_text.encode(fields)

    def resumed(self, codebook: Codebook) -> 'Provenance':
        """Return the provenance of an earlier result, to resume it.

        Raise ValueError unless it is the result of an optimisation with the same arguments.
        """
        earlier = Provenance.parse(codebook.provenance)
        if earlier is None:
            raise ValueError(
                f'resume: provenance {codebook.provenance!r}, expected that of an optimisation')
        for name in ('method', 'objective', 'seed', 'sampling', 'positions', 'scenario',
                     'calibration'):
            given, expected = getattr(self, name), getattr(earlier, name)
            if given != expected:
                raise ValueError(
                    f'{name}: {given!r}, expected {expected!r} as in the codebook to resume from')
        return earlier

    @classmethod
    def parse(cls, text: str) -> 'Provenance | None':
        """Parse the text that `to_text` returns; return None for any other text."""
        try:
            return cls(**provenance_text.decode(text))
        except (TypeError, ValueError, RecursionError):
            return None
