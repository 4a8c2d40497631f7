"""Sources of results: code and values, from files and without."""

import functools
import importlib
import linecache
import sys
import types

import numpy as np
import pytest

from rhs_isac_ros.support.sources import code_of, sources_of


def test_a_function_without_a_module_in_a_file_is_a_source():
    module = types.ModuleType('__main__')
    texts = [f'def work():\n    return {number}\n' for number in (1, 2, 1)]
    digests = []
    for number, text in enumerate(texts):
        linecache.cache[f'<cell {number}>'] = len(text), None, text.splitlines(True), ''
        exec(compile(text, f'<cell {number}>', 'exec'), vars(module))
        with pytest.MonkeyPatch.context() as patch:
            patch.setitem(sys.modules, '__main__', module)
            digests.append(sources_of(module.work))
    assert digests[0] == digests[2] != digests[1]


@pytest.mark.parametrize('cells', [
    ('k = 1', 'k = 2'), ('k = [1, {"a": 2}]', 'k = [1, {"a": 3}]'),
    ('import numpy as np\nk = np.zeros(3000)', 'k[1500] = 1'),
    ('def k(): return 1', 'def k(): return 2'),
    ('k = lambda: helper()\nhelper = 1', 'helper = 2'),
    ('class k:\n    def f(self): return 1', 'class k:\n    def f(self): return 2'),
    ('class B:\n    f = property(lambda self: 1)\nclass k(B): pass\nk = k()',
     'class B:\n    f = property(lambda self: 2)\nclass k(B): pass\nk = k()')])
def test_what_a_function_without_a_file_uses_is_a_source(cells):
    module = types.ModuleType('__main__')
    digests = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, '__main__', module)
        work = 'def work():\n    return {"all": [k for _ in range(2)]}'
        for cell in (work, *cells, 'other = 1'):
            exec(compile(cell, '<string>', 'exec'), vars(module))
            digests.append(sources_of(module.work))
    assert len({*digests}) == 3
    assert digests[2] == digests[3]


def test_values_bound_to_a_function_are_sources():
    def of(value):
        def work():
            return {'value': value}
        return work

    class Work:
        def __init__(self, value):
            self.value = value

        def __call__(self):
            return {'value': self.value}

    def of_two(value):
        def work():
            return {'value': value, 'other': not_yet}
        if False:
            not_yet = 1
        return work
    for wrap in (of, lambda value: functools.partial(print, end=value), Work, of_two,
                 lambda value: Work(value).__call__):
        one, other, same = (sources_of(wrap(value)) for value in (
            np.arange(2000), np.arange(1, 2001), np.arange(2000)))
        assert one == same != other


def test_what_a_module_counts_or_collects_does_not_change_its_code(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, 'dont_write_bytecode', True)
    (tmp_path / 'counting_lab.py').write_text(
        'LIMIT = 3\nn_calls = 0\nfound = {}\n'
        'def work():\n    global n_calls\n    n_calls += 1\n    found[n_calls] = LIMIT\n')
    module = importlib.import_module('counting_lab')
    before = code_of(module)
    module.work()
    assert module.found == {1: 3} and code_of(module) == before
    module.LIMIT = 4
    assert code_of(module) != before
