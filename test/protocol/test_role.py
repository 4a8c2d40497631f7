"""What all roles have in common, and their bounded memory."""

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
    Outcome,
    Send,
    Timeout,
)
from rhs_isac_ros.protocol.role import CodebookCache, NewestDict, Role


@pytest.mark.parametrize('bad', [math.nan, math.inf])
def test_a_time_that_is_not_finite_is_an_error(bad):
    with pytest.raises(ValueError, match=f'now_s: {bad}, expected finite'):
        Role().handle(Timeout(), bad)


def test_counting_nothing_adds_no_counter():
    role = Role()
    role.count(Outcome.USER_LOST, 0)
    assert 'user_lost' not in role.counters
    role.count(Outcome.USER_LOST, 2)
    assert role.counters == {'user_lost': 2}


@pytest.mark.parametrize('seed', range(2))
@pytest.mark.parametrize('name', [
    name for name, role in ROLES.items() if not hasattr(role, 'TABLE')])
def test_no_sequence_of_messages_raises_an_error(
        network, name, scenario, codebooks, example, seed):
    """Those of the other roles are in `test_tables.py`."""
    role, rng = network()[name], np.random.default_rng(seed)
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
        if name != 'channel' and rng.random() < 0.05:
            events.insert(0, CodebookOffered(codebooks[rng.integers(3)]))
        for event in events:
            for action in role.handle(event, float(n)):
                if isinstance(action, BuildEstimator):
                    built = EstimatorBuilt(action.codebook, Fixed('fixed'), 0.0)
                    events.append(built)
                    continue
                if isinstance(action, ApplyPatterns):
                    events.append(
                        apply_patterns(emulated_front_end(scenario), action)
                        if rng.random() < 0.9 else
                        FrontEndFailed(action.key, 'surface_silence', 'no answer'))
                    continue
                assert isinstance(action, Send | LogMessage)
                if isinstance(action, Send):
                    assert type(action.message) in role.SENDS
                    m.check(action.message, scenario)
                    sent += 1
    assert sent
    assert all(n > 0 for n in role.counters.values())


# Bounded memory


def test_the_oldest_entries_are_discarded_and_counted():
    newest = NewestDict(2)
    assert [newest.put(key, key * 10) for key in (1, 2, 3, 4)] == [0, 0, 1, 1]
    assert newest == {3: 30, 4: 40}


def test_an_entry_stored_again_is_the_newest():
    newest = NewestDict(2)
    for key in (1, 2, 1, 3):
        newest.put(key, None)
    assert list(newest) == [1, 3]


def test_an_empty_cache_has_nothing_in_use():
    assert CodebookCache().in_use == ''


def test_the_codebook_taken_last_is_kept_until_another_is_taken():
    cache = CodebookCache()
    for name in 'abc':
        cache.put(name, name.upper())
    assert cache.take('a') == 'A'
    assert cache.in_use == 'a'
    for name in 'defg':
        cache.put(name, name.upper())
    assert sorted(cache) == ['a', 'e', 'f', 'g']
    assert cache.take('g') == 'G'
    cache.put('h', 'H')
    assert sorted(cache) == ['a', 'f', 'g', 'h']
    with pytest.raises(KeyError):
        cache.take('e')
    assert cache.in_use == 'g'
