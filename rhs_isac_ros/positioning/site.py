"""A site: several surfaces around one region, and the position of a user from all of them."""

import dataclasses
import json
import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from rhs_isac_ros.model import Pose, Scenario
from rhs_isac_ros.model.arrays import checked_bounds, numbers
from rhs_isac_ros.positioning.agreement import Pair, pair_agreements
from rhs_isac_ros.positioning.estimate import (
    MISS_PROBABILITY,
    SITE,
    Estimate,
    Sighting,
    SignalError,
    checked_received,
)
from rhs_isac_ros.positioning.estimators import BayesEstimator
from rhs_isac_ros.positioning.fusion import Fuser, fuse
from rhs_isac_ros.support.errors import translated
from rhs_isac_ros.support.files import mapping_of, read_yaml
from rhs_isac_ros.system import System, SystemFiles

# Number of decimals of regions [m], and tolerance of their comparisons [m].
_DECIMALS, _TOLERANCE_M = 6, 2e-6


class SiteError(ValueError):
    """A site file is invalid, or the surfaces of a site contradict each other."""


@dataclasses.dataclass(frozen=True, eq=False)
class Site:
    """Systems by the names of their surfaces, and the region of interest in the frame of the site.

    Raises SiteError without surfaces, if a name is not valid in a ROS namespace, if two surfaces
    have the same scenario and pose, or if the region of a scenario does not contain that of the
    site.
    """

    surfaces: Mapping[str, System]
    bounds_m: np.ndarray  #: Lower and upper corner of the region, float64 [2, 3] [m].

    def __post_init__(self) -> None:
        """Check the surfaces."""
        if not self.surfaces:
            raise SiteError('surfaces: none, expected at least one')
        with translated(ValueError, SiteError):
            object.__setattr__(self, 'bounds_m', checked_bounds(self.bounds_m))
        names: dict[str, str] = {}
        for name, one in self.surfaces.items():
            if not re.fullmatch('[a-z][a-z0-9_]*', name):
                raise SiteError(f'surfaces: {name!r}, expected a name of small letters, digits '
                                'and underscores')
            # Messages name their surface by the identifier of its scenario.
            same = names.setdefault(one.scenario.id, name)
            if same != name:
                raise SiteError(f'{same}, {name}: pose {one.pose.position_m} m, expected surfaces '
                                'with different scenarios or poses')
            low, high = one.scenario.roi_bounds_m
            places = one.pose.to_surface(_corners(self.bounds_m))
            if (places < low - _TOLERANCE_M).any() or (places > high + _TOLERANCE_M).any():
                raise SiteError(
                    f'{name}: roi_center_m {one.scenario.roi_center_m}, roi_size_m '
                    f'{one.scenario.roi_size_m}, expected a region that contains that of the '
                    f'site, from {places.min(axis=0).tolist()} to '
                    f'{places.max(axis=0).tolist()} m in the frame of the surface')

    @classmethod
    def from_yaml(cls, path: str | Path) -> 'Site':
        """Read a site file; raise SiteError if it cannot be read or is invalid.

        Paths in the file are relative to its folder. The region of a surface is the smallest box
        in its own frame that contains the region of the site.
        """
        with translated(ValueError, SiteError):
            content = read_yaml(path)
        with translated((ValueError, TypeError, KeyError), SiteError, path):
            content = mapping_of(content, {'roi_center_m', 'roi_size_m', 'surfaces'})
            region = Scenario(
                roi_center_m=content['roi_center_m'], roi_size_m=content['roi_size_m'])
            if not isinstance(content['surfaces'], dict):
                raise SiteError('surfaces: expected a mapping of names to surfaces')
            bounds_m = region.roi_bounds_m
            return cls({str(name): _surface(str(name), value, Path(path).parent, bounds_m)
                        for name, value in content['surfaces'].items()}, bounds_m)

    @property
    def users(self) -> tuple[float, float]:
        """What `fuse` assumes of users, by the leader's scenario.

        The prior probability that a user is outside of the region, and the standard deviation of
        each component of the velocity [m/s].
        """
        scenario = self.surfaces[self.leader].scenario
        return scenario.outside_probability, scenario.user_speed_std_mps

    @property
    def leader(self) -> str:
        """Name of the surface whose base station leads: the first one."""
        return next(iter(self.surfaces))

    def sample(self, positions: np.ndarray, rng: np.random.Generator) -> dict[str, np.ndarray]:
        """Draw signals for users at positions [N, 3] [m], complex128 [N, N_B, N_SB F] by name.

        With columns for the velocity, [N, 6], users move; velocities that the leader's scenario
        declares are drawn. Multipath, noise and impairments of different surfaces are independent.
        """
        states = numbers('positions', positions, shapes=[('N', 3), ('N', 6)])
        _, speed_mps = self.users
        if speed_mps and states.shape[1:] == (3,):
            # All surfaces see the same velocity.
            states = np.hstack([states, speed_mps * (np.ptp(self.bounds_m, axis=0) > 0)
                                * rng.standard_normal(states.shape)])
        return {name: one.sample(one.pose.states_to_surface(states), rng)
                for name, one in self.surfaces.items()}


def share_left_out(site: object) -> float:
    """Return the share of a surface's posterior that modes may have which are left out.

    In a site, the only modes on which all surfaces agree may be unlikely for each of them. The
    argument is true for a surface of a site.
    """
    return 5e-5 if site else MISS_PROBABILITY


class SiteEstimator:
    """The position of a user of a site, from the signals of one cycle.

    All surfaces together decide whether the user is outside of the region.
    """

    def __init__(self, site: Site, table_folder: str | Path | None = None) -> None:
        self._site = site
        self._estimators = {name: BayesEstimator(
            one, table_folder, reject_outside=True, left_out=share_left_out(site))
                            for name, one in site.surfaces.items()}

    def sightings(self, received: Mapping[str, np.ndarray]) -> dict[str, Sighting]:
        """Return the likelihoods of the surfaces, by name; see `Estimate.sighting`.

        `received` contains signals, complex128 [N_B, N_SB F], of some or all surfaces.
        """
        found = [sightings for _, sightings in self._each(received)]
        if len(found) != 1:
            raise SignalError(f'received: {len(found)} shots, expected one')
        return found[0]

    def _each(self, received: Mapping[str, np.ndarray]
              ) -> Iterator[tuple[dict[str, Estimate], dict[str, Sighting]]]:
        """Yield the posteriors of the surfaces for each shot, and their sightings, by name."""
        if not received or not received.keys() <= self._estimators.keys():
            raise SignalError(f'received: surfaces {sorted(received)}, expected some of '
                              f'{sorted(self._estimators)}')
        found = {name: self._estimators[name].posterior(
            checked_received(self._site.surfaces[name].codebook, signals))
                 for name, signals in received.items()}
        lengths = {name: len(one.mean) for name, one in found.items()}
        if len(set(lengths.values())) > 1:
            raise SignalError(f'received: {lengths} shots, expected equal numbers')
        for n in range(max(lengths.values(), default=0)):
            posteriors = {name: one[n] for name, one in found.items()}
            yield posteriors, {name: sighting for name, one in posteriors.items()
                               if (sighting := one.sighting)}

    def draw_agreements(self, n: int, rng: np.random.Generator
                        ) -> tuple[list[dict[Pair, float]], np.ndarray]:
        """Draw `n` users, and return references and places for a `PoseTest`.

        Users without a position are left out.
        """
        low, high = self._site.bounds_m
        agreements, places = [], []
        for _, sightings in self._each(
                self._site.sample(rng.uniform(low, high, size=(n, 3)), rng)):
            fuser = Fuser(self._site.bounds_m, *self._site.users)
            # In the order of the pairs, so that products are reused.
            if sightings and (fused := fuser.fuse(
                    [one for _, one in sorted(sightings.items())])).fix:
                agreements.append(pair_agreements(sightings, fuser))
                places.append(fused.mean)
        return agreements, np.array(places).reshape(-1, 3)

    def estimate(self, received: Mapping[str, np.ndarray]) -> Estimate:
        """Return the position with its mixture, in the frame of the site; see `sightings`.

        For several shots, complex128 [N, N_B, N_SB F] by name, there are N positions. Raises
        `SignalError` if signals are unusable, there are none, a name is not that of a surface, or
        the numbers of shots differ.
        """
        found = [self._fused(*one) for one in self._each(received)]
        single = any(np.ndim(signals) == 2 for signals in received.values())
        return found[0] if single else Estimate.of_each(found, SITE)

    def _fused(self, posteriors: Mapping[str, Estimate], sightings: Mapping[str, Sighting]
               ) -> Estimate:
        if sightings:
            return fuse(list(sightings.values()), self._site.bounds_m, *self._site.users)
        return Estimate.without_fix('; '.join(
            f'{name}: {one.reason}' for name, one in posteriors.items()), frame=SITE)


def site_text(path: str | Path, poses: Mapping[str, Pose], folder: Path) -> str:
    """Return the content of a site file with other poses of some surfaces, by name.

    Paths in the result are relative to `folder`.
    """
    content = read_yaml(path)
    for name, surface in content['surfaces'].items():
        # A relative path begins at the real folder, also behind a link.
        surface.update({key: os.path.relpath(
            os.path.realpath(Path(path).parent / surface[key]), os.path.realpath(folder))
            for key in SystemFiles._fields if key in surface})
        if name in poses:
            # A copy through JSON shares no values, for which YAML would write anchors and aliases.
            surface['pose'] = json.loads(json.dumps(dataclasses.asdict(poses[name])))
    return yaml.safe_dump(content, sort_keys=False, default_flow_style=None)


def _corners(bounds_m: np.ndarray) -> np.ndarray:
    """Return the corners of a box with bounds [2, 3] [m], float64 [8, 3] [m]."""
    return np.stack(np.meshgrid(*bounds_m.T), axis=-1).reshape(-1, 3)


def _surface(name: str, content: Any, folder: Path, bounds_m: np.ndarray) -> System:
    def adapted(scenario: Scenario) -> Scenario:
        if pose:
            scenario = dataclasses.replace(scenario, pose=pose[0])
        # Rounded, so that errors of the rotation do not change the identifier of the scenario; the
        # sum turns -0.0 into 0.0.
        places = np.round(scenario.pose.to_surface(_corners(bounds_m)), _DECIMALS) + 0.0
        low, high = places.min(axis=0), places.max(axis=0)
        return dataclasses.replace(scenario, roi_center_m=(low + high) / 2, roi_size_m=high - low)

    with translated(ValueError, SiteError, name):
        files = dict(mapping_of(content, {'scenario', 'codebook'}, {'calibration', 'pose'}))
        pose = [files.pop('pose')] if 'pose' in files else []
        return SystemFiles.of(files, folder).load(adapted)
