"""The tables and figures of the trials."""

import math

from rhs_isac_ros.model import Scenario
from rhs_isac_ros.monitoring.invariants import InvariantChecker
from system.chaos import report
from system.chaos.crashes import Cell
from system.chaos.fuzzing import Fuzzed
from system.chaos.soaking import Soaked


def cell(recovered_s=1.0, survivors=True, told=('bs: user 1 given up: rhs_silent',), **fields):
    return Cell('rhs_controller', 'positioning', 1e-3, recovered_s, survivors, told,
                ('bs',), **{'broken': (), **fields})


def figures_of(*cells, broken=()):
    promises = InvariantChecker(Scenario())
    promises.broken = list(broken)
    return report.crash_figures(cells, promises)


def test_all_well():
    figures = figures_of(cell(), cell(2.5))
    assert figures['passed']
    assert (figures['cells'], figures['cells_recovered'], figures['cells_told']) == (2, 2, 2)
    assert (figures['worst_recovery_s'], figures['wrong_publications']) == (2.5, 0)
    assert '2 of 2 recovered' in report.crash_summary(figures)
    assert report.crash_line(cell()).split() == [
        'rhs_controller', 'positioning', '1.00', 's', 'alive', 'bs;', 'bs']


def test_late_dead_silent_repeated_and_wrong_are_no_success():
    for bad in (cell(3.01), cell(math.inf), cell(survivors=False), cell(told=()),
                cell(told=('bs: gone', 'bs: gone'))):
        assert not figures_of(cell(), bad)['passed']
        assert report.crash_line(bad).isprintable()
    assert not figures_of(cell(), broken=['PositionEstimate of cycle 3'])['passed']
    assert figures_of(cell(math.inf))['worst_recovery_s'] is None
    assert 'NOT IN TIME' in report.crash_line(cell(3.01))
    assert 'NOT TOLD ONCE' in report.crash_line(cell(told=()))
    assert '  WRONG: x' in report.crash_line(cell(broken=('x',)))


def soaked(**fields):
    given = {'minutes': 10.0, 'outcomes': {'served': 995, 'user_gone': 5}, 'estimates': 996,
             'retries': {'retry_band': 40}, 'air': {'loss': 80},
             'memory_bytes': {'bs': (100, 104)}, 'ended': ()}
    return Soaked(**given | fields)


def test_a_long_run_passes_within_its_limits():
    good = soaked()
    assert (good.cycles, good.share) == (1000, 0.996)
    assert good.passed
    assert not soaked(estimates=989).passed
    assert not soaked(memory_bytes={'bs': (100, 106)}).passed
    assert not soaked(ended=('bs',)).passed
    figures = report.soak_figures(good, InvariantChecker(Scenario()))
    assert figures['passed']
    assert '99.60 %' in report.soak_text(good, figures)


def test_lies_pass_if_all_that_is_malformed_was_counted():
    given = {'sent': {'beacon': 5}, 'malformed': {'bs': 3}, 'counted': {'bs': 3},
             'dropped': {'malformed': 3}, 'ended': (), 'traces': (), 'serves_again_s': 0.5}
    assert Fuzzed(**given).passed
    for bad in ({'counted': {'bs': 2}}, {'ended': ('bs',)}, {'traces': ('bs: Traceback',)}):
        assert not Fuzzed(**given | bad).passed
    assert '5 lies on 1 topics' in report.fuzz_text(Fuzzed(**given))
    assert report.fuzz_figures(Fuzzed(**given))['passed']
