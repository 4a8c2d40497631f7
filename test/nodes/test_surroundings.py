"""A user outside of the region, and signals that deviate from the scenario."""

import numpy as np
import pytest
import yaml
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from scipy.stats import poisson

from rhs_isac_ros.codebook import random_codebook
from rhs_isac_ros.model import Scenario
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.ros import topics
from rhs_isac_ros.ros.endpoints import EXCHANGE

NAMESPACE = '/surroundings'
# A small region and enough measurements for a clear decision.
FIELDS = {'center_frequencies_hz': [2.5e9, 2.7e9, 3.3e9], 'n_subbands': 4, 'n_frames': 4,
          'n_feeds': 2, 'elements_per_side': 6, 'angular_spread_deg': 5.0,
          'roi_center_m': [4.0, 0.0, 0.0], 'roi_size_m': [2.0, 2.0, 1.0]}
INSIDE, OUTSIDE = 1, 2
REASON = 'position outside of the region: probability '


@pytest.fixture
def network(processes, make_watch, tmp_path):
    """A network of a user inside and one outside of the region; and the observer."""
    (tmp_path / 'scenario.yaml').write_text(yaml.safe_dump(FIELDS), encoding='utf-8')
    scenario = Scenario(**FIELDS)
    random_codebook(scenario, np.random.default_rng(0)).save(tmp_path / 'codebook.yaml')
    common = {'namespace': NAMESPACE, 'scenario_file': tmp_path / 'scenario.yaml'}
    watch = make_watch(NAMESPACE)
    network = processes.start(
        'network', users=1, rest_s=0.02,
        codebook_file=tmp_path / 'codebook.yaml', position_m='[4.0, 0.3, 0.1]', **common)
    watch.until_served(2, INSIDE, [network])
    outside = processes.start(
        'user', name=f'user_{OUTSIDE}', user_id=OUTSIDE, position_m='[4.0, 4.0, 0.0]', **common)
    return watch, [network, outside]


def test_users_outside_get_no_fix_and_deviations_cause_a_warning(network):
    watch, processes = network
    reported = []

    def store(message):
        reported.extend(status for status in message.status if status.name.endswith('positioner'))
    watch.node.create_subscription(DiagnosticArray, topics.DIAGNOSTICS, store, EXCHANGE)

    def reasons():
        return [one.reason for one in watch.received[m.NoFix] if one.user == OUTSIDE]
    watch.until(lambda: len(reasons()) >= 20, 'answers without a fix', processes)
    assert sum(reason.startswith(REASON) for reason in reasons()) > len(reasons()) / 2
    # The line of an event follows its message.
    watch.until(lambda: f'no fix of user {OUTSIDE}: ' in processes[0].log, 'the line of the log',
                processes)
    log = processes[0].log
    # The other user is not affected, and users outside cause no warning of the residuals. The
    # estimator excludes a user inside with a probability of at most 1 %.
    fixes, rejected = ([message for message in watch.received[kind] if message.user == INSIDE]
                       for kind in (m.PositionEstimate, m.NoFix))
    # At a rate of 1 %, chance exceeds this number once in ten thousand runs.
    assert len(rejected) <= poisson.ppf(1 - 1e-4, 0.01 * len(fixes))
    assert 'do not match the scenario' not in log

    assert watch.set_parameters('channel', {'element_error_rms': 0.1}, processes).successful
    (status,) = watch.until(
        lambda: [status for status in reported
                 if 'warning.residual' in {pair.key for pair in status.values}][:1],
        'the warning', processes)
    values = {pair.key: pair.value for pair in status.values}
    assert status.level == DiagnosticStatus.WARN
    assert status.message == values['warning.residual']
    assert status.message.startswith('the signals do not match the scenario: ')
    assert float(values['residual.ratio']) > 1
    assert int(values['residual.fixes']) >= 10
    assert processes[0].log.count('do not match the scenario') == 1
