"""Topics of single users."""

import pytest
from geometry_msgs.msg import Point, Vector3

from rhs_isac_ros.ros import endpoints
from rhs_isac_ros.ros.endpoints import UserTopics


@pytest.fixture
def topics(probe, monkeypatch):
    """Topics of at most two users, on a clock that the test sets."""
    monkeypatch.setattr(endpoints, 'MAX_USERS', 2)
    topics = UserTopics(probe, {'users/user_{user}/a': Point, 'users/user_{user}/b': Vector3})
    topics.now_s = 0.0
    monkeypatch.setattr(endpoints.time, 'monotonic', lambda: topics.now_s)
    return topics


def names(publishers):
    return [publisher.topic_name for publisher in publishers]


def test_each_user_has_its_publishers(topics):
    first = topics.publishers(7)
    assert names(first) == ['/users/user_7/a', '/users/user_7/b']
    assert [publisher.msg_type for publisher in first] == [Point, Vector3]
    assert topics.publishers(7) == first


def test_further_users_have_none_and_one_is_logged(topics, capfd):
    topics.publishers(1)
    topics.publishers(2)
    assert topics.publishers(3) == topics.publishers(4) == ()
    assert len(topics.publishers(1)) == 2
    assert capfd.readouterr().err.count('no topics for user') == 1


def test_a_user_that_was_removed_makes_space(topics, probe):
    topics.publishers(1)
    topics.publishers(2)
    topics.remove(1)
    topics.remove(9)
    assert names(topics.publishers(3)) == ['/users/user_3/a', '/users/user_3/b']
    assert not probe.count_publishers('users/user_1/a')


def test_the_user_that_was_idle_for_longest_makes_space_after_a_minute(topics):
    topics.publishers(1)
    topics.now_s = 30.0
    topics.publishers(2)
    topics.now_s = 61.0
    assert topics.publishers(3)
    assert topics.publishers(1) == ()
    topics.now_s = 91.0
    assert topics.publishers(1)
    assert topics.publishers(2) == ()
