"""Lists of users in texts."""

import pytest

from rhs_isac_ros.protocol.base_station_memory import join_users


@pytest.mark.parametrize(('users', 'text'), [
    ([], ''), ([4], '4'), ([4, 9], '4, 9'), (range(1, 9), '1, 2, 3, 4, 5, 6, 7, 8'),
    (range(1, 10), '1, 2, 3, 4, 5, 6, 7, 8 and 1 other'),
    (range(1, 21), '1, 2, 3, 4, 5, 6, 7, 8 and 12 others')])
def test_a_list_names_few_users_and_counts_the_others(users, text):
    assert join_users(users) == text
