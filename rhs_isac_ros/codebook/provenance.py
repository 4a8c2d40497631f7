"""How a codebook was made, in a form that people and programs read."""

import dataclasses
from typing import Any

import yaml

from rhs_isac_ros import __version__
from rhs_isac_ros.codebook.codebook import Codebook
from rhs_isac_ros.codebook.search import Progress


@dataclasses.dataclass(frozen=True)
class Provenance:
    """What an optimisation was asked for, and how far it came.

    Attributes
    ----------
    method, objective, seed, sampling, positions
        Arguments of `optimize`; positions counts them.
    scenario
        Fields of the scenario that differ from Table I.
    version
        Version of this package.
    steps, evaluations
        How many of them were done.
    value_m2
        The objective [m^2].
    reason
        Why it stopped.
    """

    method: str
    objective: str
    seed: int
    sampling: str
    positions: int
    scenario: dict[str, Any]
    version: str = __version__
    steps: int = 0
    evaluations: int = 0
    value_m2: float = float('nan')
    reason: str = ''

    def of_result(self, end: Progress, reason: str) -> str:
        """Return the text for a codebook.

        Parameters
        ----------
        end
            The last progress.
        reason
            Why the optimisation stopped.

        Returns
        -------
        str
            One line of YAML.
        """
        whole = dataclasses.replace(
            self, steps=end.step, evaluations=end.evaluations, value_m2=float(end.value_m2),
            reason=reason)
        return yaml.safe_dump(dataclasses.asdict(whole), default_flow_style=True,
                              sort_keys=False, width=10**9).strip()

    def resumed(self, codebook: Codebook) -> 'Provenance':
        """Return what an earlier optimisation with the same arguments has done.

        Parameters
        ----------
        codebook
            Its result.

        Returns
        -------
        Provenance
            That of the codebook.

        Raises
        ------
        ValueError
            If the codebook is no such result.
        """
        earlier = Provenance.parse(codebook.provenance)
        if earlier is None:
            raise ValueError(
                f'resume: provenance {codebook.provenance!r}, expected that of an optimisation')
        for name in ('method', 'objective', 'seed', 'sampling', 'positions', 'scenario'):
            wanted, there = getattr(self, name), getattr(earlier, name)
            if wanted != there:
                raise ValueError(
                    f'{name}: {wanted!r}, expected {there!r} as in the codebook to resume from')
        return earlier

    @classmethod
    def parse(cls, text: str) -> 'Provenance | None':
        """Read a codebook's text.

        Parameters
        ----------
        text
            What `of_result` returned, or anything else.

        Returns
        -------
        Provenance or None
            None if the text is something else.
        """
        try:
            return cls(**yaml.safe_load(text))
        except (yaml.YAMLError, TypeError, ValueError, RecursionError):
            return None
