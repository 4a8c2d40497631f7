"""What the network promises of its results, checked from outside by what is on the topics.

No position and no capacity is ever published for a cycle whose signals were incomplete, stale,
mixed between users, or taken with two codebooks.
"""

import collections
import dataclasses
from collections.abc import Iterable, Iterator

import numpy as np

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.receive import receive_feeds
from rhs_isac_ros.protocol import messages as m

# Messages that it needs.
RECEIVES = (m.Grant, m.RhsConfiguration, m.FeedSignals, m.ReceivedSignals, m.PositionEstimate,
            m.Beam, m.Capacity)
# Topics have no common order: a result is judged when so much more must have been heard.
SETTLE_S = 1.0
# Cycles whose messages are kept.
_MOST_CYCLES = 64
# What is wrong, and the kind of message whose absence it is, if any.
_Fault = tuple[type[m.Message] | None, str]
# Noise is complex Gaussian: |n|^2 is beyond so many times its power once in e^40 values.
_MOST_NOISE = 40.0


@dataclasses.dataclass
class _Evidence:
    """What was heard of a cycle; repeats are allowed, contradictions are not."""

    users: set[int] = dataclasses.field(default_factory=set)
    # By band: codebook ids, and the configurations that were reported for them.
    applied: dict[int, list[m.RhsConfiguration]] = dataclasses.field(
        default_factory=lambda: collections.defaultdict(list))
    beam_applied: list[m.RhsConfiguration] = dataclasses.field(default_factory=list)
    feeds: dict[tuple[int, int], list[m.FeedSignals]] = dataclasses.field(
        default_factory=lambda: collections.defaultdict(list))
    signals: list[m.ReceivedSignals] = dataclasses.field(default_factory=list)
    estimates: list[m.PositionEstimate] = dataclasses.field(default_factory=list)
    beams: list[m.Beam] = dataclasses.field(default_factory=list)
    # Kinds of which messages may have been published unheard.
    unheard: set[type[m.Message]] = dataclasses.field(default_factory=set)


class InvariantChecker:
    """Collects what is published, and names the results that should not have been.

    Parameters
    ----------
    scenario
        The scenario.

    Attributes
    ----------
    checked
        How many results were judged.
    unverified
        How many of them lack evidence of a kind that was unheard, and are well otherwise.
    broken
        What was wrong with the others, in words.
    """

    def __init__(self, scenario: Scenario) -> None:
        self._scenario = scenario
        self._codebooks: dict[str, Codebook] = {}
        self._cycles: dict[int, _Evidence] = {}
        self._results: collections.deque[tuple[float, m.PositionEstimate | m.Capacity]] = (
            collections.deque())
        # At first everybody is still being found.
        self._unheard: set[type[m.Message]] = set(RECEIVES)
        self.checked = self.unverified = 0
        self.broken: list[str] = []

    def know(self, codebook: Codebook) -> None:
        """Take a codebook that cycles may use.

        Parameters
        ----------
        codebook
            The codebook.
        """
        self._codebooks[codebook.id] = codebook

    def expect_silence(self, kinds: Iterable[type[m.Message]]) -> None:
        """Tell that a publisher has died: the next one may be found by others earlier than here.

        Parameters
        ----------
        kinds
            What it publishes. That such messages are missing is no fault of a cycle until the
            first of them is heard.
        """
        self._unheard |= set(kinds)

    def add(self, message: m.Message, now_s: float) -> None:
        """Take a message, and judge the results that have waited long enough.

        Parameters
        ----------
        message
            One of `RECEIVES`.
        now_s
            When it was seen [s].
        """
        self._note(message)
        if isinstance(message, m.PositionEstimate | m.Capacity):
            self._results.append((now_s + SETTLE_S, message))
        while self._results and self._results[0][0] <= now_s:
            self._judge(self._results.popleft()[1])

    def _note(self, message: m.Message) -> None:
        cycle = self._cycles.get(message.cycle_id)
        if cycle is None:
            cycle = self._cycles[message.cycle_id] = _Evidence()
            if len(self._cycles) > _MOST_CYCLES:
                del self._cycles[next(iter(self._cycles))]
        cycle.unheard |= self._unheard
        self._unheard.discard(type(message))
        match message:
            case m.Grant():
                cycle.users.add(message.user)
            case m.RhsConfiguration(mode=m.Mode.POSITIONING):
                cycle.applied[message.band].append(message)
            case m.RhsConfiguration():
                cycle.beam_applied.append(message)
            case m.FeedSignals():
                cycle.feeds[message.band, message.frame].append(message)
            case m.ReceivedSignals():
                cycle.signals.append(message)
            case m.PositionEstimate():
                cycle.estimates.append(message)
            case m.Beam():
                cycle.beams.append(message)

    def _judge(self, result: m.PositionEstimate | m.Capacity) -> None:
        self.checked += 1
        cycle = self._cycles.get(result.cycle_id, _Evidence())
        judge = self._faults_of_signals if isinstance(
            result, m.PositionEstimate) else self._faults_of_beam
        found = list(judge(result, cycle))
        if cycle.users != {result.user}:
            absent = None if cycle.users else m.Grant
            found.insert(0, (absent, f'granted to {sorted(cycle.users) or "nobody"}'))
        faults = [text for absent, text in found if absent not in cycle.unheard]
        self.unverified += bool(found) and not faults
        if faults:
            self.broken.append(
                f'{type(result).__name__} of cycle {result.cycle_id}, user {result.user}, '
                f'codebook {result.codebook_id}: {"; ".join(faults)}')

    def _faults_of_signals(
            self, estimate: m.PositionEstimate, cycle: _Evidence) -> Iterator[_Fault]:
        """What is wrong with the signals that an estimate is made of."""
        if not cycle.signals:
            yield m.ReceivedSignals, 'no received signals'
            return
        for signals in cycle.signals:
            if (signals.user, signals.codebook_id) != (estimate.user, estimate.codebook_id):
                yield None, (f'received signals of user {signals.user}, '
                             f'codebook {signals.codebook_id}')
            if not np.array_equal(signals.signals, cycle.signals[0].signals):
                yield None, 'received signals that differ'
        sizes = self._scenario.sizes
        for band in range(sizes['N_B']):
            ids = {report.codebook_id for report in cycle.applied.get(band, ())}
            if ids != {estimate.codebook_id}:
                absent = None if ids else m.RhsConfiguration
                yield absent, f'band {band} taken with {sorted(ids) or "no configuration"}'
        frames = [(band, frame) for band in range(sizes['N_B']) for frame in range(sizes['F'])]
        missing = [key for key in frames if not cycle.feeds.get(key)]
        if missing:
            yield m.FeedSignals, f'incomplete: no signals of (band, frame) {missing}'
        others = {feeds.user for heard in cycle.feeds.values() for feeds in heard}
        if others - {estimate.user}:
            yield None, f'signals of users {sorted(others)}'
        codebook = self._codebooks.get(estimate.codebook_id)
        if codebook is None:
            yield None, 'a codebook that was never offered'
        elif not missing:
            yield from self._faults_of_content(cycle, codebook, frames)

    def _faults_of_content(
            self, cycle: _Evidence, codebook: Codebook, frames: list[tuple[int, int]]
    ) -> Iterator[_Fault]:
        """Whether the received signals are those at the feeds, combined, with noise."""
        for band, reports in cycle.applied.items():
            if any(not np.array_equal(report.analog, codebook.analog[band]) for report in reports):
                yield None, f'band {band} taken with a configuration that is not in the codebook'
        sizes = self._scenario.sizes
        feeds = np.stack([cycle.feeds[key][0].signals for key in frames])
        shape = sizes['N_B'], sizes['F'], *feeds.shape[1:]
        expected = receive_feeds(self._scenario, codebook, feeds.reshape(shape), None)
        noise = np.abs(cycle.signals[0].signals - expected)**2
        allowed = _MOST_NOISE * self._scenario.noise_power_w + 1e-12 * np.abs(expected).max()**2
        if noise.max() > allowed:
            yield None, 'received signals that are not those at the feeds'

    def _faults_of_beam(self, report: m.Capacity, cycle: _Evidence) -> Iterator[_Fault]:
        """What is wrong with the beam that a capacity is reported of."""
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
            yield m.RhsConfiguration, 'a beam that the surface does not hold'
