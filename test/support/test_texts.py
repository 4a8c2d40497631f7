"""Tables and numbers of things."""

from rhs_isac_ros.support.texts import counted, markdown_table, text_table


def test_a_text_table_has_heads_of_several_lines():
    table = text_table(['user', 'error\n[m]'], [['1', '0.25'], ['12', '']], '<>')
    assert table.splitlines() == ['user  error', '        [m]', '1      0.25', '12']


def test_a_table_is_aligned_markdown():
    table = markdown_table(['method', 'm²'], [['direct', '1.5'], ['ga', '12.25']])
    assert table.splitlines() == [
        '| method |    m² |', '| ------ | ----: |', '| direct |   1.5 |', '| ga     | 12.25 |']


def test_one_thing_is_singular():
    assert [counted(number, 'user') for number in (0, 1, 2)] == ['0 users', '1 user', '2 users']
