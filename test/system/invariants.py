"""Invariants of the published results, checked passively against the messages on the topics.

No position and no capacity may be published for a cycle whose signals were incomplete, stale,
mixed between users or channels, received with two codebooks, or inconsistent with the true
position of the node that was granted the cycle.
"""

import collections
import dataclasses
import math
from collections.abc import Iterable, Iterator

import numpy as np

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import MeasurementModel, Scenario
from rhs_isac_ros.model.measurement import receive_feeds
from rhs_isac_ros.protocol import messages as m

# Messages that the checker needs.
RECEIVES = (m.Grant, m.GroundTruth, m.RhsConfiguration, m.FeedSignals, m.ReceivedSignals,
            m.PositionEstimate, m.Beam, m.Capacity)
# Messages of different topics arrive in any order, so a result is checked after this delay [s].
CHECK_DELAY_S = 1.0
# Number of cycles whose messages are kept.
_MAX_CYCLES = 64
# Noise is complex Gaussian: |n|^2 exceeds this multiple of its power with probability e^-40.
_MAX_NOISE_FACTOR = 40.0
# Signals may deviate from their mean up to a limit, exceeded with at most probability e^-20.
_RESIDUAL_EXPONENT = 20.0
# The type of message whose absence is the fault, or None, and a description of the fault.
_Fault = tuple[type[m.Message] | None, str]


@dataclasses.dataclass
class _CycleMessages:
    """The messages of a cycle; each may be repeated, but repetitions must agree."""

    users: set[int] = dataclasses.field(default_factory=set)
    instances: set[int] = dataclasses.field(default_factory=set)
    # True positions by user and instance.
    truths: dict[tuple[int, int], np.ndarray] = dataclasses.field(default_factory=dict)
    # Configurations for positioning by band.
    applied: dict[int, list[m.RhsConfiguration]] = dataclasses.field(
        default_factory=lambda: collections.defaultdict(list))
    beam_applied: list[m.RhsConfiguration] = dataclasses.field(default_factory=list)
    # Signals by band.
    feeds: dict[int, list[m.FeedSignals]] = dataclasses.field(
        default_factory=lambda: collections.defaultdict(list))
    signals: list[m.ReceivedSignals] = dataclasses.field(default_factory=list)
    estimates: list[m.PositionEstimate] = dataclasses.field(default_factory=list)
    beams: list[m.Beam] = dataclasses.field(default_factory=list)
    # Types of messages that may have been published before their publisher was discovered.
    undiscovered: set[type[m.Message]] = dataclasses.field(default_factory=set)

    def add(self, message: m.Message) -> None:
        match message:
            case m.Grant():
                self.users.add(message.user)
                self.instances.add(message.user_instance)
            case m.GroundTruth():
                self.truths[message.user, message.sender] = message.position
            case m.RhsConfiguration(mode=m.Mode.POSITIONING):
                self.applied[message.band].append(message)
            case m.RhsConfiguration():
                self.beam_applied.append(message)
            case m.FeedSignals():
                self.feeds[message.band].append(message)
            case m.ReceivedSignals():
                self.signals.append(message)
            case m.PositionEstimate():
                self.estimates.append(message)
            case m.Beam():
                self.beams.append(message)


class InvariantChecker:
    """Collects the published messages and checks every result against them.

    Attributes
    ----------
    checked
        Number of results that were checked.
    unverified
        Number of these results whose only fault is the absence of messages that may have been
        published before their publisher was discovered.
    violations
        Descriptions of the results that violate an invariant.
    """

    def __init__(self, scenario: Scenario) -> None:
        self._scenario = scenario
        self._models: dict[str, MeasurementModel] = {}
        self._codebooks: dict[str, Codebook] = {}
        self._cycles: dict[int, _CycleMessages] = {}
        self._results: collections.deque[tuple[float, m.PositionEstimate | m.Capacity]] = (
            collections.deque())
        # At first, no publisher has been discovered.
        self._undiscovered: dict[type[m.Message], int] = dict.fromkeys(RECEIVES, 0)
        # The latest sender of each type.
        self._senders: dict[type[m.Message], int] = {}
        self.checked = self.unverified = 0
        self.violations: list[str] = []

    def add_codebook(self, codebook: Codebook) -> None:
        """Add a codebook that cycles may use."""
        self._codebooks[codebook.id] = codebook
        self._models.setdefault(codebook.id, MeasurementModel(self._scenario, codebook))

    def expect_rediscovery(
            self, kinds: Iterable[type[m.Message]], by_another: bool = False) -> None:
        """Tolerate missing messages of some types until the first of each type arrives.

        Call this when a publisher has terminated or is unreachable, or before another node
        replaces it, because other nodes may discover its successor earlier than this node.

        Parameters
        ----------
        kinds
            Types of the messages that the publisher sends.
        by_another
            Whether the first message of each type must be from another node than the latest one.
        """
        self._undiscovered |= {
            kind: self._senders.get(kind, 0) if by_another else 0 for kind in kinds}

    def add(self, message: m.Message, now_s: float) -> None:
        """Add a message of one of the types `RECEIVES` that arrived at `now_s` [s].

        Results that are due by then are checked.
        """
        cycle = self._messages_of(message.cycle_id)
        cycle.undiscovered |= self._undiscovered.keys()
        kind = type(message)
        if message.sender == 0 or message.sender != self._undiscovered.get(kind, 0):
            self._undiscovered.pop(kind, None)
        self._senders[kind] = message.sender
        cycle.add(message)
        if isinstance(message, m.PositionEstimate | m.Capacity):
            self._results.append((now_s + CHECK_DELAY_S, message))
        while self._results and self._results[0][0] <= now_s:
            self._check(self._results.popleft()[1])

    def _messages_of(self, cycle_id: int) -> _CycleMessages:
        cycle = self._cycles.get(cycle_id)
        if cycle is None:
            cycle = self._cycles[cycle_id] = _CycleMessages()
            if len(self._cycles) > _MAX_CYCLES:
                del self._cycles[next(iter(self._cycles))]
        return cycle

    def _check(self, result: m.PositionEstimate | m.Capacity) -> None:
        self.checked += 1
        cycle = self._cycles.get(result.cycle_id, _CycleMessages())
        faults: list[_Fault] = []
        if cycle.users != {result.user}:
            faults.append((None if cycle.users else m.Grant,
                           f'granted to {sorted(cycle.users) or "nobody"}'))
        if isinstance(result, m.PositionEstimate):
            faults += self._signal_faults(result, cycle)
        else:
            faults += self._beam_faults(result, cycle)
        proven = [text for missing, text in faults if missing not in cycle.undiscovered]
        self.unverified += bool(faults) and not proven
        if proven:
            self.violations.append(
                f'{type(result).__name__} of cycle {result.cycle_id}, user {result.user}, '
                f'codebook {result.codebook_id}: {"; ".join(proven)}')

    def _signal_faults(
            self, estimate: m.PositionEstimate, cycle: _CycleMessages) -> Iterator[_Fault]:
        """Yield the faults of the signals from which a position was estimated."""
        if not cycle.signals:
            yield m.ReceivedSignals, 'no received signals'
            return
        for signals in cycle.signals:
            if (signals.user, signals.codebook_id) != (estimate.user, estimate.codebook_id):
                yield None, (f'received signals of user {signals.user}, '
                             f'codebook {signals.codebook_id}')
            if not np.array_equal(signals.signals, cycle.signals[0].signals):
                yield None, 'received signals that differ from each other'
        sizes = self._scenario.sizes
        for band in range(sizes['N_B']):
            ids = {applied.codebook_id for applied in cycle.applied.get(band, ())}
            if ids != {estimate.codebook_id}:
                missing = None if ids else m.RhsConfiguration
                yield missing, f'band {band} measured with {sorted(ids) or "no configuration"}'
        absent = [band for band in range(sizes['N_B']) if not cycle.feeds.get(band)]
        if absent:
            yield m.FeedSignals, f'incomplete: no signals of bands {absent}'
        users = {feeds.user for messages in cycle.feeds.values() for feeds in messages}
        if users - {estimate.user}:
            yield None, f'signals of users {sorted(users)}'
        yield from _identity_faults(estimate, cycle)
        codebook = self._codebooks.get(estimate.codebook_id)
        if codebook is None:
            yield None, 'codebook that was never offered'
        elif not absent:
            yield from self._content_faults(cycle, codebook)

    def _content_faults(self, cycle: _CycleMessages, codebook: Codebook) -> Iterator[_Fault]:
        """Compare the received signals with the feed signals, combined by the codebook."""
        yield from self._position_faults(cycle)
        for band, reports in cycle.applied.items():
            if any(not np.array_equal(report.analog, codebook.analog[band]) for report in reports):
                yield None, f'band {band} measured with a configuration not in the codebook'
        # Two channels may have answered, but the base station must have used one of them.
        channels = [feeds for sender in {feeds.sender for feeds in cycle.feeds[0]}
                    if (feeds := _feeds_of(sender, cycle, self._scenario.n_bands))]
        if not channels:
            yield None, 'signals of several channels'
        elif not any(self._matches(feeds, cycle, codebook) for feeds in channels):
            yield None, 'received signals do not match the feed signals'

    def _matches(
            self, feeds: list[np.ndarray], cycle: _CycleMessages, codebook: Codebook) -> bool:
        """Return whether the received signals are the combined feed signals and noise."""
        # Compare amplitudes, because the powers of forged signals may overflow. Sums that overflow
        # do not match.
        with np.errstate(over='ignore', invalid='ignore'):
            expected = receive_feeds(self._scenario, codebook, np.stack(feeds), None)
            noise = np.abs(cycle.signals[0].signals - expected).max()
            allowed = math.hypot(math.sqrt(_MAX_NOISE_FACTOR * self._scenario.noise_power_w),
                                 1e-6 * np.abs(expected).max())
        return bool(noise <= allowed < math.inf)

    def _position_faults(self, cycle: _CycleMessages) -> Iterator[_Fault]:
        """Compare the received signals with their distribution at the true position."""
        received = cycle.signals[0]
        position = cycle.truths.get((received.user, received.user_instance))
        model = self._models.get(received.codebook_id)
        # Signals of an unknown codebook are a fault of their own.
        if position is None or model is None:
            return
        signals = received.signals.reshape(model.shape)
        residual = model.whiten(signals - model.mean(position[None])[0])
        n, t = residual.size, _RESIDUAL_EXPONENT
        # The bound of Laurent and Massart (2000) on the norm of n complex unit Gaussians.
        if np.sum(np.abs(residual)**2) > n + np.sqrt(2 * n * t) + t:
            yield None, f'received signals do not match the true position {position.round(3)}'

    def _beam_faults(self, report: m.Capacity, cycle: _CycleMessages) -> Iterator[_Fault]:
        """Yield the faults of the beam for which a capacity was reported."""
        key = report.user, report.codebook_id
        if not any((e.user, e.codebook_id) == key for e in cycle.estimates):
            yield m.PositionEstimate, 'no such estimate'
        beams = [beam for beam in cycle.beams
                 if (beam.user, beam.codebook_id, beam.band) == (*key, report.band)]
        if not beams:
            yield m.Beam, 'no such beam'
        elif not any(np.array_equal(applied.analog[0], beam.analog) and
                     applied.codebook_id == report.codebook_id
                     for applied in cycle.beam_applied for beam in beams):
            yield m.RhsConfiguration, 'beam not applied by the surface'


def _identity_faults(estimate: m.PositionEstimate, cycle: _CycleMessages) -> Iterator[_Fault]:
    """Yield the faults of the nodes that took part in the measurement."""
    instances = {estimate.user_instance, *cycle.instances,
                 *(received.user_instance for received in cycle.signals)}
    if len(instances) > 1:
        yield None, f'estimate for other nodes of the user than granted: {sorted(instances)}'


def _feeds_of(sender: int, cycle: _CycleMessages, n_bands: int) -> list[np.ndarray]:
    """Return the signals of all bands from one channel; empty if a band is missing."""
    found = [feeds.signals for band in range(n_bands)
             for feeds in [f for f in cycle.feeds[band] if f.sender == sender][:1]]
    return found if len(found) == n_bands else []
