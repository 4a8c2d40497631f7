"""``scripts/param`` on a network in another process."""

import yaml

from rhs_isac_ros.tools.param import main


def test_get_tells_the_type(hear):
    assert hear(main, 'get', '/optimizer', 'codebook.shape') == (
        'Integer values are: [2, 4, 3, 2, 36]\n')
    assert hear(main, 'get', 'bs', 'policy') == 'String value is: round_robin\n'
    assert hear(main, 'get', 'bs', 'receiver_noise', '--hide-type') == 'True\n'


def test_on_its_own(call_script):
    assert call_script('scripts/param get /user_2 user_id') == 'Integer value is: 2\n'


def test_list_of_a_node_and_of_all(hear):
    assert hear(main, 'list', '/transmission', '--filter', 'b') == '  band\n'
    assert '  rest_s (type: double)\n' in hear(main, 'list', 'bs', '--param-type')
    codebook = hear(main, 'list', 'optimizer', '--param-prefixes', 'codebook').split()
    assert codebook[0] == 'codebook.analog' and len(codebook) == 7
    lines = hear(main, 'list').splitlines()
    nodes = [line for line in lines if line.startswith('/')]
    assert nodes == sorted(nodes)
    assert {'/bs:', '/user_1:', '/user_2:'} <= set(nodes)
    assert not any('_rhs_isac_cli' in line for line in nodes)


def test_dump_is_a_parameter_file(hear):
    content = yaml.safe_load(hear(main, 'dump', 'optimizer'))
    codebook = content['/optimizer']['ros__parameters']['codebook']
    assert codebook['shape'] == [2, 4, 3, 2, 36]
    assert len(codebook['analog']) == 216


def test_set_asks_the_node(hear, say):
    out, err, code = say(main, 'set', 'optimizer', 'codebook.provenance', 'by hand')
    assert (out, err, code) == ('Set parameter successful\n', '', 0)
    assert hear(main, 'get', 'optimizer', 'codebook.provenance') == 'String value is: by hand\n'
    out, err, code = say(main, 'set', 'bs', 'seed', '1')
    assert (out, code) == ('', 1)
    assert err.startswith('Setting parameter failed: ')
    assert 'read-only' in err
    assert hear(main, 'set', '/bs', 'policy', 'random') == 'Set parameter successful\n'
    assert hear(main, 'get', '/bs', 'policy') == 'String value is: random\n'
    out, err, code = say(main, 'set', '/bs', 'policy', 'nonsense')
    assert (out, code) == ('', 1)
    assert err == ("Setting parameter failed: policy: 'nonsense', expected one of round_robin, "
                   'first, random\n')
    assert hear(main, 'get', '/bs', 'policy') == 'String value is: random\n'


def test_what_is_not_there(say):
    assert say(main, 'get', 'bs', 'nothing') == ('', 'Parameter not set\n', 1)
    for verb in (['get', 'nobody', 'seed'], ['list', 'nobody'], ['dump', 'nobody'],
                 ['set', 'nobody', 'seed', '1']):
        assert say(main, *verb, '--timeout', '0.1') == ('', 'Node not found\n', 1)
