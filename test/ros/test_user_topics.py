"""Topics of single users."""

import pytest
from geometry_msgs.msg import Point, Vector3

from rhs_isac_ros.ros.endpoints import UserTopics


@pytest.fixture
def topics(probe):
    """Topics of the users up to number 7."""
    return UserTopics(probe, {'users/user_{user}/a': Point, 'users/user_{user}/b': Vector3}, 7)


def names(publishers):
    return [publisher.topic_name for publisher in publishers]


def test_each_user_has_its_publishers(topics):
    first = topics.publishers(7)
    assert names(first) == ['/users/user_7/a', '/users/user_7/b']
    assert [publisher.msg_type for publisher in first] == [Point, Vector3]
    assert topics.publishers(7) == first


def test_users_with_higher_numbers_have_none_and_one_is_logged(topics, capfd):
    for user in range(8, 1008):
        assert topics.publishers(user) == ()
    assert len(topics.publishers(1)) == 2
    assert capfd.readouterr().err.count('no topics for user') == 1


def test_the_topics_of_a_user_that_was_removed_are_created_again(topics, probe):
    topics.publishers(1)
    topics.remove(1)
    topics.remove(9)
    assert not probe.count_publishers('users/user_1/a')
    assert names(topics.publishers(1)) == ['/users/user_1/a', '/users/user_1/b']
