"""The place of a node: its surface, and the site to which the surface belongs."""

import dataclasses
import types
from collections.abc import Iterable, Iterator
from typing import NamedTuple

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.positioning.site import Site, SiteError
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.support.errors import translated
from rhs_isac_ros.support.fields import ParameterError

# Distance between the seeds of two surfaces, which exceeds every seed that a parameter may have.
_SEED_STEP = 2**31


class Source(NamedTuple):
    """Topics with the same prefix, and the scenario of their messages."""

    prefix: str  # empty, or a namespace with a final slash
    scenario: Scenario
    kinds: tuple[type[m.Message], ...]


@dataclasses.dataclass(frozen=True, eq=False)
class Place:
    """The surface of a node, and its site, if any.

    In a site, the surface is named after the last part of the namespace, and all surfaces share
    the part before. A node of the whole site is in this part, and has the scenario of the surface
    whose base station leads.
    """

    scenario: Scenario
    site: Site | None = None
    base: str = ''  #: Namespace that the surfaces of the site share, without a final slash.
    name: str = ''  #: Name of the surface; empty without a site, and for a node of the whole site.

    @classmethod
    def of(cls, values: types.SimpleNamespace, namespace: str, of_site: bool = False) -> 'Place':
        """Return the place given by the parameters and the namespace of a node.

        A node `of_site` belongs to no surface. Raises ScenarioError or ParameterError if a file is
        invalid, or no surface has the name of the namespace.
        """
        if not (values.site_file or of_site):
            file = values.scenario_file
            return cls(Scenario.from_yaml(file) if file else Scenario())
        if not values.site_file or values.scenario_file:
            raise ParameterError(
                f'site_file: {values.site_file!r}, scenario_file: {values.scenario_file!r}, '
                'expected only a site file')
        with translated(SiteError, ParameterError, 'site_file'):
            site = Site.from_yaml(values.site_file)
        base, _, name = namespace.rpartition('/')
        if of_site:
            return cls(site.surfaces[site.leader].scenario, site, namespace.rstrip('/'))
        if name not in site.surfaces:
            raise ParameterError(f'namespace: {namespace!r}, expected the name of a surface of '
                                 f'{values.site_file} at its end: {", ".join(site.surfaces)}')
        return cls(site.surfaces[name].scenario, site, base, name)

    @property
    def codebook(self) -> Codebook | None:
        """Codebook of the surface in the site file; None without a site."""
        return self.site.surfaces[self.name].codebook if self.site else None

    def seed(self, seed: int) -> int:
        """Return the seed of the surface, so that surfaces have independent random numbers."""
        number = list(self.site.surfaces).index(self.name) if self.site and self.name else 0
        return seed + _SEED_STEP * number

    def sources(self, kinds: Iterable[type[m.Message]]) -> Iterator[Source]:
        """Yield the topics on which the node receives messages of some classes.

        Messages in `SHARED` come from the surface whose base station leads. A node of the whole
        site receives the messages of every surface.
        """
        site, kinds = self.site, tuple(kinds)
        if site is None:
            yield Source('', self.scenario, kinds)
        elif self.name:
            shared = tuple(kind for kind in kinds if kind in m.SHARED)
            yield Source('', self.scenario, tuple(kind for kind in kinds if kind not in shared))
            yield self._of(site, site.leader, shared)
        else:
            for name in site.surfaces:
                yield self._of(site, name, kinds)

    def _of(self, site: Site, name: str, kinds: tuple[type[m.Message], ...]) -> Source:
        return Source(f'{self.base}/{name}/', site.surfaces[name].scenario, kinds)
