"""The roles without states: channel, positioner and transmission."""

import numpy as np
import pytest

from rhs_isac_ros.positioning import Estimate
from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.channel import Channel
from rhs_isac_ros.protocol.events import (
    BuildEstimator,
    CodebookOffered,
    EstimatorBuilt,
    Send,
)
from rhs_isac_ros.protocol.positioner import Positioner
from rhs_isac_ros.protocol.transmission import Transmission

PLACE = np.array([8.0, -2.0, 0.5])


def test_plain_roles_have_no_deadlines(scenario):
    for role in (Channel(scenario, 0), Transmission(scenario),
                 Positioner(scenario, None)):
        assert role.next_deadline() is None


class Fixed:
    """An estimator with a fixed result that holds its codebook."""

    def __init__(self, codebook):
        self.name = f'fixed {codebook.id}'

    def estimate(self, received):
        return Estimate(PLACE, 4 * np.eye(3))


@pytest.mark.parametrize('seed', range(2))
@pytest.mark.parametrize('name', ['channel', 'positioner', 'transmission'])
def test_no_sequence_of_messages_raises_an_error(
        scenario, codebooks, subscriptions, example, name, seed):
    role = {'channel': lambda: Channel(scenario, 0),
            'positioner': lambda: Positioner(scenario, lambda: 0.0),
            'transmission': lambda: Transmission(scenario)}[name]()
    rng = np.random.default_rng(seed)
    kinds = subscriptions[name]
    sent = 0
    for n in range(500):
        kind = kinds[rng.integers(len(kinds))]
        fields = kind.__dataclass_fields__
        given = {'cycle_id': int(rng.integers(0, 3))}
        if 'codebook_id' in fields:
            given['codebook_id'] = codebooks[rng.integers(3)].id
        if 'user' in fields:
            given['user'] = int(rng.integers(1, 3))
        if 'position' in fields:
            given['position'] = scenario.sample_positions(1, rng)[0]
        if name != 'channel' and rng.random() < 0.05:
            offered = CodebookOffered(codebooks[rng.integers(3)])
            requested = [action for action in role.handle(offered, float(n))
                         if isinstance(action, BuildEstimator)]
            for action in requested:
                role.handle(EstimatorBuilt(action.codebook, Fixed(action.codebook), 0.0), float(n))
        for action in role.handle(example(kind, rng, **given), float(n)):
            assert isinstance(action, Send)
            m.check(action.message, scenario.sizes)
            sent += 1
    assert sent
    assert all(n > 0 for n in role.counters.values())
