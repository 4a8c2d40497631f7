"""Tables, lists and numbers of things."""

import pytest

from rhs_isac_ros.support.texts import counted, listed, markdown_table, text_table


def test_a_text_table_has_heads_of_several_lines():
    table = text_table(['user', 'error\n[m]'], [['1', '0.25'], ['12', '']], '<>')
    assert table.splitlines() == ['user  error', '        [m]', '1      0.25', '12']


def test_a_table_is_aligned_markdown():
    table = markdown_table(['method', 'm²'], [['direct', '1.5'], ['ga', '12.25']])
    assert table.splitlines() == [
        '| method |    m² |', '| ------ | ----: |', '| direct |   1.5 |', '| ga     | 12.25 |']


def test_one_thing_is_singular():
    assert [counted(number, 'user') for number in (0, 1, 2)] == ['0 users', '1 user', '2 users']


@pytest.mark.parametrize(('users', 'text'), [
    ([4, 9], '4, 9'), (range(1, 9), '1, 2, 3, 4, 5, 6, 7, 8'),
    (range(1, 10), '1, 2, 3, 4, 5, 6, 7, 8 and 1 other'),
    (range(1, 21), '1, 2, 3, 4, 5, 6, 7, 8 and 12 others')])
def test_a_list_names_few_users_and_counts_the_others(users, text):
    assert listed(users) == text
