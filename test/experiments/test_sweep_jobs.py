"""The jobs of a sweep: codebooks, and quantities at blocks of positions."""

import json
import sys

import numpy as np
import pytest

from rhs_isac_ros.bounds import crlb
from rhs_isac_ros.codebook import Codebook, random_codebook
from rhs_isac_ros.experiments import sweep as sweep_jobs
from rhs_isac_ros.experiments.sweep import (
    Sweep,
    design,
    evaluate,
    families,
    run_sweep,
    with_power,
)
from rhs_isac_ros.experiments.sweep_settings import parse_axis, settings_of
from rhs_isac_ros.link import capacity_report, choose_beam
from rhs_isac_ros.model import PathChannel, Scenario
from rhs_isac_ros.model.elementwise import Paper
from rhs_isac_ros.positioning import Estimate, make_estimator
from rhs_isac_ros.system import System

SMALL = {'elements_per_side': 4, 'n_subbands': 2, 'n_feeds': 2, 'n_frames': 2}
WORLD = Scenario(**SMALL)


@pytest.fixture(scope='module')
def codebook():
    return random_codebook(WORLD, np.random.default_rng(3))


@pytest.fixture
def case(codebook):
    return {'scenario': SMALL, 'codebook': codebook.to_parameters(), 'seed': 5}


@pytest.mark.parametrize(('quantities', 'expected'), [
    (['crlb_m2', 'bound_m2'], ['crlb', 'bound']),
    (['squared_error_m2', 'inside'], ['error']),
    (['capacity_bps', 'squared_error_m2'], ['capacity']),
    (['crlb_m2', 'capacity_bps', 'loss_bps'], ['crlb', 'loss'])])
def test_one_job_computes_all_quantities_of_the_estimates(quantities, expected):
    assert families(quantities) == expected


def test_results_are_those_of_the_library(case, codebook):
    positions, received = System(WORLD, codebook).pairs(6, 5, 10)
    found = make_estimator('bayes', WORLD, codebook).estimate(received)
    result = evaluate('loss', **case, first=10, n=6, estimator='bayes')
    assert result['squared_error_m2'] == pytest.approx(
        np.sum((found.mean - positions)**2, axis=1))
    beam = choose_beam(WORLD, found.mean[2], found.covariance[2]).beam
    report = capacity_report(WORLD, beam, positions[2])
    assert [result[name][2] for name in ('capacity_bps', 'perfect_bps', 'loss_bps')] == (
        pytest.approx([report.actual_bps, report.perfect_bps, report.loss_bps]))
    assert result['fix'] == [1.0] * 6
    assert evaluate('crlb', **case, first=10, n=6)['crlb_m2'] == pytest.approx(
        crlb(WORLD, codebook, positions))
    short = evaluate('capacity', **case, first=10, n=6, estimator='bayes')
    assert short == {name: result[name] for name in short}
    json.dumps(result)


def test_a_position_without_fix_counts_with_the_region(case, monkeypatch):
    class Nothing:
        name = 'nothing'

        def estimate(self, received):
            n = len(received)
            return Estimate(np.full((n, 3), np.nan), np.full((n, 3, 3), np.nan), ('weak',) * n)

    monkeypatch.setattr(sweep_jobs, 'make_estimator', lambda *_: Nothing())
    positions, _ = System(WORLD, Codebook.from_parameters(case['codebook'])).pairs(3, 5)
    result = evaluate('capacity', **case, first=0, n=3, estimator='nothing')
    assert result['fix'] == result['inside'] == [0.0] * 3
    assert result['squared_error_m2'] == pytest.approx(
        np.sum((np.array(WORLD.roi_center_m) - positions)**2, axis=1))
    assert min(result['capacity_bps']) > 0


@pytest.mark.slow
def test_the_global_bound_of_a_coarse_lattice_is_missing(case):
    found = evaluate('bound', **case, first=0, n=4)['bound_m2']
    assert len(found) == 4
    assert np.isfinite(found).all()
    assert found != evaluate('bound', **case, first=250, n=4)['bound_m2']
    assert len(evaluate('bound', **case, first=250, n=1)['bound_m2']) == 1
    coarse = evaluate('bound', **case, first=0, n=4, max_coarseness=0.5)['bound_m2']
    assert np.isnan(coarse).all()


def test_codebooks_of_every_kind_fit_their_scenario():
    arguments = {'optimize': {'objective': 'crlb', 'steps': 2}}
    books = {}
    for kind in sweep_jobs.KINDS:
        made = design(SMALL, kind, 1, **arguments.get(kind, {}))
        books[kind] = Codebook.from_parameters(json.loads(json.dumps(made)))
        books[kind].check(WORLD)
    assert len({book.id for book in books.values()}) == 3
    assert design(SMALL, 'random', 2)['codebook.id'] != books['random'].id


def test_an_interrupted_optimisation_is_no_result(monkeypatch):
    def stop(*_, **__):
        raise KeyboardInterrupt

    # The package has a function of the same name.
    module = sys.modules['rhs_isac_ros.codebook.optimize']
    monkeypatch.setitem(module.METHODS, 'lbfgs', module.Method(stop))
    with pytest.raises(KeyboardInterrupt):
        design(SMALL, 'optimize', 1, 'crlb', 2)


def test_the_power_of_a_codebook_can_be_changed(codebook):
    louder = Scenario(**SMALL, max_power_w=0.5)
    with_power(codebook, 0.5).check(louder)
    # Rounding of the power does not change a codebook.
    optimised = Codebook(codebook.analog, codebook.digital * (1 + 1e-12))
    assert with_power(optimised, WORLD.max_power_w).id == optimised.id


def test_objects_of_a_scenario_reach_other_processes(tmp_path):
    """A board, a gain pattern and a channel that have no names."""
    class Own(Paper):
        kind = 'own'
    users = WORLD.sample_positions(50, np.random.default_rng(0))
    paths = PathChannel(users, 1e-3 / np.linalg.norm(users, axis=1)[:, None] + 0j,
                        users[:, None], np.zeros((50, 1), int), 2.75e9)
    base = Scenario(**SMALL, board=Own, channel=paths,
                    element_gain=lambda angles: 2 * np.maximum(np.cos(angles), 0))
    sweep = Sweep(base, settings_of(base, [parse_axis('n_frames=1,2')], 'random', 'bayes'),
                  ['crlb', 'rmse'], n_positions=4)
    here, there = (run_sweep(sweep, tmp_path / str(n), n_jobs=n) for n in (1, 2))
    assert here == there


def test_an_estimator_that_is_defined_again_takes_its_name(tmp_path):
    def define(bound, member, attribute):
        class Own:
            name, shift = 'own', member

            def __init__(self, scenario, codebook):
                self.centre = np.array(scenario.roi_center_m)

            def estimate(self, received):
                mean = self.centre + bound + self.shift + attribute
                return Estimate(np.tile(mean, (len(received), 1)),
                                np.tile(np.eye(3), (len(received), 1, 1)))

        class Maker:
            def __init__(self, attribute):
                self.attribute = attribute

            def __call__(self, scenario, codebook):
                return Own(scenario, codebook)
        return Maker(attribute) if attribute else Own
    base, values = Scenario(**SMALL), []
    for shifts in ((0, 0, 0), (1, 0, 0), (0, 2, 0), (0, 0, 3), (0, 0, 4)):
        settings = settings_of(base, [parse_axis('n_frames=1')], 'random', define(*shifts))
        (point,) = run_sweep(Sweep(base, settings, ['rmse'], n_positions=4), tmp_path, n_jobs=1)
        values.append(point.interval[0])
    assert len({*values}) == 5
