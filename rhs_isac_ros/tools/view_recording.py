"""The entries of a view of a recording."""

from collections.abc import Iterator
from pathlib import Path

from rhs_isac_ros.codebook import CodebookError
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.monitoring.entities import Entry
from rhs_isac_ros.monitoring.network_view import RECEIVES, NetworkView, TrackPoint
from rhs_isac_ros.positioning import Estimate, TrackEstimate
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros import convert, diagnostics, topics
from rhs_isac_ros.ros.recording import RecordingError, read
from rhs_isac_ros.tools.republish import topic_prefix
from rhs_isac_ros.tools.view_posteriors import Posteriors


def entries(
        path: Path, namespace: str, scenario: Scenario, posteriors: Posteriors,
        track_speed_mps: float | None = None, max_cycles: int = 0) -> Iterator[Entry]:
    """Yield the entries of a recording.

    Parameters
    ----------
    namespace
        Namespace of the network.
    posteriors
        Receives the recorded codebooks.
    track_speed_mps
        Typical speed of the users [m/s], to track them; None: no tracks.
    max_cycles
        Number of cycles after which to end; 0: read all.

    Raises
    ------
    RecordingError
        If the file is not a recording, has no messages in the namespace, or contains a message
        that is malformed or does not fit the scenario.
    """
    prefix = topic_prefix(namespace)
    view = NetworkView(scenario)
    for topic, found, _ in read(path, [f'{prefix}{topics.CODEBOOK}']):
        try:
            codebook = convert.codebook_from_ros(found)
            if codebook.id in posteriors.codebooks:
                continue
            posteriors.add(codebook)
        except (m.MessageError, CodebookError) as error:
            raise RecordingError(f'{path}: {topic}: {error}') from None
        view.set_bound(codebook.id, posteriors.bound_m2(codebook))
    yield from view.begin()
    kinds = {f'{prefix}{topics.NAMES[kind]}': kind for kind in RECEIVES}
    reports = f'{prefix}{topics.DIAGNOSTICS}'
    for topic, found, time_s in read(path, [*kinds, reports]):
        if topic == reports:
            for node, report in diagnostics.from_ros(found):
                yield from view.add_report(node, report)
            continue
        try:
            message = convert.from_ros(kinds[topic], found)
            _check_scenario(message, scenario)
            m.check(message, scenario.sizes)
        except m.MessageError as error:
            raise RecordingError(f'{path}: {topic}: {error}') from None
        yield from view.add(message, time_s)
        if isinstance(message, m.ReceivedSignals):
            yield from view.add_modes(message, posteriors.modes(message))
            if track_speed_mps is not None:
                yield from _track(view, message, posteriors.track(
                    message, time_s, track_speed_mps))
        if max_cycles and view.n_ended >= max_cycles:
            break
    if not view.n_cycles:
        raise RecordingError(f'{path}: no cycle in the namespace {namespace}')


def _check_scenario(message: m.Message, scenario: Scenario) -> None:
    if message.scenario_id not in ('', scenario.id):
        raise m.MessageError(
            f'recorded with scenario {message.scenario_id}, expected {scenario.id}')


def _track(
        view: NetworkView, received: m.ReceivedSignals,
        estimate: Estimate | None) -> list[Entry]:
    if not isinstance(estimate, TrackEstimate) or not estimate.fix:
        return []
    return view.add_track(received.cycle_id, TrackPoint(
        received.user, estimate.mean, estimate.covariance, estimate.velocity))
