"""What all roles have in common."""

import math

import numpy as np
import pytest
from in_memory_network import ROLES, Fixed, emulated_front_end

from rhs_isac_ros.protocol import messages as m
from rhs_isac_ros.protocol.channel import apply_patterns
from rhs_isac_ros.protocol.events import (
    ApplyPatterns,
    BuildEstimator,
    CodebookOffered,
    EstimatorBuilt,
    FrontEndFailed,
    LogMessage,
    Reply,
    Send,
    Timeout,
)

pytestmark = pytest.mark.usefixtures('plain_beams')

each_role = pytest.mark.parametrize('name', ROLES)


@pytest.fixture
def role(network, name):
    """A role that has just begun in a network of all roles."""
    return network()[{'user': 'user1'}.get(name, name)]


@each_role
def test_roles_without_states_have_no_deadline_at_first(role):
    assert role.next_deadline() is None or role.state is not None


@each_role
def test_a_time_that_is_not_finite_is_an_error(role):
    for bad in (math.nan, math.inf):
        with pytest.raises(ValueError, match=f'now_s: {bad}, expected finite'):
            role.handle(Timeout(), bad)


@each_role
@pytest.mark.parametrize('seed', range(2))
def test_no_sequence_of_messages_raises_an_error(role, name, scenario, codebooks, example, seed):
    rng = np.random.default_rng(seed)
    sent = 0
    for n in range(500):
        kind = role.RECEIVES[rng.integers(len(role.RECEIVES))]
        fields = kind.__dataclass_fields__
        given = {'cycle_id': int(rng.integers(0, 3))}
        if 'codebook_id' in fields:
            given['codebook_id'] = codebooks[rng.integers(3)].id
        if 'user' in fields:
            given['user'] = int(rng.integers(1, 3))
        if 'position' in fields:
            given['position'] = scenario.sample_positions(1, rng)[0]
        events = [example(kind, rng, **given)]
        if name not in ('channel', 'user') and rng.random() < 0.05:
            events.insert(0, CodebookOffered(codebooks[rng.integers(3)]))
        for event in events:
            for action in role.handle(event, float(n)):
                if isinstance(action, BuildEstimator):
                    built = EstimatorBuilt(action.codebook, Fixed(action.codebook), 0.0)
                    events.append(built)
                    continue
                if isinstance(action, ApplyPatterns):
                    events.append(
                        apply_patterns(emulated_front_end(scenario), action)
                        if rng.random() < 0.9 else
                        FrontEndFailed(action.key, 'surface_silence', 'no answer'))
                    continue
                assert isinstance(action, Send | LogMessage | Reply)
                if isinstance(action, Send):
                    assert type(action.message) in role.SENDS
                    m.check(action.message, scenario)
                    sent += 1
    assert sent or role.state is not None and role.counters
    assert all(n > 0 for n in role.counters.values())
