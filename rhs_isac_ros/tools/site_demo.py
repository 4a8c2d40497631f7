"""The demonstration of a site: its processes, an observer of all surfaces, and its table."""

import collections
import functools
import itertools
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rhs_isac_ros.monitoring.cycle_log import CompleteCycle
from rhs_isac_ros.positioning.site import Site
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros import endpoints
from rhs_isac_ros.ros.parameters import NODES
from rhs_isac_ros.ros.processes import Processes
from rhs_isac_ros.ros.recording import CycleObserver
from rhs_isac_ros.ros.roster import FOLLOWING
from rhs_isac_ros.tools.command import text_table

# Name of the fusion in tables.
FUSED = 'fused'


def start_others(processes: Processes, file: Path, site: Site, **given: Any) -> None:
    """Start `fusion` and the surfaces of a site file that follow the base station of the leader.

    Each parameter in `given` applies to all nodes that have it.
    """
    names = [name for name in site.surfaces if name != site.leader]
    for namespace, role in [*((name, role) for name in names for role in FOLLOWING),
                            ('', 'fusion')]:
        known = {parameter.name for parameter in NODES[role]}
        processes.start(role, namespace=namespace, site_file=file.resolve(), **{
            name: value for name, value in given.items() if name in known})


class SiteObserver(CycleObserver):
    """Collects the cycles of the leader, the positions of all, and the carriers of the data."""

    def __init__(self, site: Site, **options: Any) -> None:
        super().__init__(namespace=site.leader, **options)
        # By cycle, for each surface and for the fusion.
        self.estimates: dict[str, dict[int, m.PositionEstimate]] = {}
        # By cycle, the surface that delivered the uplink data.
        self.carriers: dict[int, str] = {}
        for name, one in site.surfaces.items():
            endpoints.subscribe_messages(
                self, [m.Data], one.scenario, functools.partial(self._keep_carrier, name),
                on_foreign=lambda message: None, exchange=endpoints.OBSERVATION,
                prefix=f'/{name}/')
        for name, prefix in [*((name, f'/{name}/') for name in site.surfaces), (FUSED, '/')]:
            self.estimates[name] = {}
            endpoints.subscribe_messages(
                self, [m.PositionEstimate], None,
                functools.partial(self._keep, self.estimates[name]),
                exchange=endpoints.OBSERVATION, prefix=prefix)

    @staticmethod
    def _keep(estimates: dict[int, m.PositionEstimate], message: m.Message) -> None:
        assert isinstance(message, m.PositionEstimate)
        estimates[message.cycle_id] = message

    def _keep_carrier(self, name: str, message: m.Message) -> None:
        assert isinstance(message, m.Data)
        if (message.direction, message.stage) == (m.Direction.UPLINK, m.Stage.DELIVERED):
            self.carriers[message.cycle_id] = name

    @property
    def complete(self) -> Sequence[CompleteCycle]:
        """Cycles with a position of the fusion, from the first one that all surfaces located."""
        return list(itertools.dropwhile(
            lambda cycle: any(cycle.cycle_id not in one for one in self.estimates.values()),
            (cycle for cycle in self.log.complete
             if cycle.cycle_id in self.estimates[FUSED] and cycle.cycle_id in self.carriers)))

    def errors_m(self, cycle: CompleteCycle) -> dict[str, float]:
        """Return the error of each surface and of the fusion in a cycle [m]; NaN without a fix."""
        return {name: float(np.linalg.norm(estimates[cycle.cycle_id].position
                                           - cycle.truth.position))
                if cycle.cycle_id in estimates else math.nan
                for name, estimates in self.estimates.items()}


def report(observer: SiteObserver) -> Iterator[str]:
    """Yield a table with a line for each cycle, the errors of each surface, and its data."""
    cycles = observer.complete
    errors_m = [observer.errors_m(cycle) for cycle in cycles]
    names = [*observer.estimates]
    heads = ('cycle', 'user', 'true position [m]', *(f'{name}\n[m]' for name in names), 'data')
    yield text_table(heads, (
        (str(cycle.cycle_id), str(cycle.user),
         ' '.join(f'{coordinate:6.2f}' for coordinate in cycle.truth.position),
         *(f'{error_m:.3f}' for error_m in of_cycle.values()),
         observer.carriers.get(cycle.cycle_id, ''))
        for cycle, of_cycle in zip(cycles, errors_m, strict=True)), '>' * len(heads))
    for name in names:
        found = np.array([of_cycle[name] for of_cycle in errors_m])
        found = found[np.isfinite(found)]
        yield (f'{name}: {len(found)} positions, root mean square error '
               f'{np.sqrt(np.mean(found**2)) if len(found) else math.nan:.3f} m')
    yield _carriage(observer, cycles)


def _carriage(observer: SiteObserver, cycles: Sequence[CompleteCycle]) -> str:
    """Describe how many cycles each surface carried, and how often users changed the surface."""
    latest: dict[int, str] = {}
    n_handovers = 0
    for cycle in cycles:
        carrier = observer.carriers[cycle.cycle_id]
        n_handovers += latest.get(cycle.user, carrier) != carrier
        latest[cycle.user] = carrier
    carried = collections.Counter(observer.carriers[cycle.cycle_id] for cycle in cycles)
    return (f'data: {", ".join(f"{n} over {name}" for name, n in sorted(carried.items()))}; '
            f'{n_handovers} handover{"s" * (n_handovers != 1)}')

