"""The surface of a node, and the site to which the surface belongs."""

import dataclasses
import types
from collections.abc import Container, Iterable, Iterator
from typing import NamedTuple

from rhs_isac_ros.model import Scenario
from rhs_isac_ros.positioning.site import Site, SiteError
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.support.errors import translated
from rhs_isac_ros.support.fields import ParameterError
from rhs_isac_ros.system import System

# Distance between the seeds of two surfaces, which exceeds every seed that a parameter may have.
_SEED_STEP = 2**31


class Source(NamedTuple):
    """The topic of a class of messages, and their scenario."""

    kind: type[m.Message]
    prefix: str  # empty, or a namespace with a final slash
    scenario: Scenario


@dataclasses.dataclass(frozen=True, eq=False)
class NodeSurface:
    """The scenario of a node, its system if a file names one, and its site, if any.

    In a site, the surface is named after the last part of the namespace; the part before is the
    same for all surfaces. A node of the whole site is in this part, and has the scenario of the
    surface whose base station leads.
    """

    scenario: Scenario
    system: System | None = None  #: Of the system file, or of the surface in the site file.
    site: Site | None = None
    base: str = ''  #: Namespace of the surfaces of the site, without a final slash.
    name: str = ''  #: Name of the surface; empty without a site, and for a node of the whole site.

    @classmethod
    def of(cls, values: types.SimpleNamespace, namespace: str, of_site: bool = False
           ) -> 'NodeSurface':
        """Return the surface given by the parameters and the namespace of a node.

        A node `of_site` belongs to no surface. Raises ScenarioError or ParameterError if a file is
        invalid, or no surface has the name of the namespace.
        """
        files = {name: getattr(values, name) for name in (
            'scenario_file', 'system_file', 'site_file') if getattr(values, name)}
        if len(files) > 1 or of_site and 'site_file' not in files:
            given = ', '.join(f'{name}: {file!r}' for name, file in files.items())
            raise ParameterError(f'{given or "site_file: none"}, expected only '
                                 f'{"a site file" if of_site else "one of these"}')
        if not values.site_file:
            if not values.system_file:
                return cls(Scenario.from_yaml(*files.values()) if files else Scenario())
            with translated(ValueError, ParameterError, 'system_file'):
                system = System.from_yaml(values.system_file)
            return cls(system.scenario, system)
        with translated(SiteError, ParameterError, 'site_file'):
            site = Site.from_yaml(values.site_file)
        base, _, name = namespace.rpartition('/')
        if of_site:
            return cls(site.surfaces[site.leader].scenario, None, site, namespace.rstrip('/'))
        if name not in site.surfaces:
            raise ParameterError(f'namespace: {namespace!r}, expected the name of a surface of '
                                 f'{values.site_file} at its end: {", ".join(site.surfaces)}')
        system = site.surfaces[name]
        return cls(system.scenario, system, site, base, name)

    def seed(self, seed: int) -> int:
        """Return the seed of the surface, so that surfaces have independent random numbers."""
        number = list(self.site.surfaces).index(self.name) if self.site and self.name else 0
        return seed + _SEED_STEP * number

    @property
    def site_prefix(self) -> str:
        """Namespace of the nodes of the whole site, with a final slash; empty without a site."""
        return f'{self.base}/' if self.site else ''

    def is_carried(self, message: m.Message) -> bool:
        """Return whether a message is `Data` whose scenario is that of a surface of the site."""
        surfaces = self.site.surfaces.values() if self.site else ()
        return isinstance(message, m.Data) and message.scenario_id in (
            one.scenario.id for one in surfaces)

    def sources(self, kinds: Iterable[type[m.Message]], from_all: Container[type[m.Message]] = ()
                ) -> Iterator[Source]:
        """Yield the topics on which the node receives messages of some classes.

        In a site, messages in `OF_USERS` come from the surface whose base station leads, and those
        in `LOCATED` from the fusion. The leader also sends all `Data`, with the scenario of the
        surface that carries them. Classes in `from_all` come from every surface.
        """
        if not self.site:
            yield from (Source(kind, '', self.scenario) for kind in kinds)
            return
        surfaces = [(f'{self.base}/{name}/', one.scenario)
                    for name, one in self.site.surfaces.items()]
        prefix, scenario = surfaces[0]
        for kind in kinds:
            if kind in from_all:
                yield from (Source(kind, *surface) for surface in surfaces)
            elif kind in m.OF_USERS:
                yield Source(kind, prefix, scenario)
            elif kind in m.LOCATED:
                yield Source(kind, self.site_prefix, scenario)
            else:
                yield Source(kind, prefix if kind is m.Data else '', self.scenario)
