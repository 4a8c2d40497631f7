"""Impairments of the signals: what all have in common, the built-in ones, plug-ins, and draws."""

import dataclasses

import numpy as np
import pytest
from impairment_checks import CHECKS

from rhs_isac_ros.model import (
    Impairment,
    Linear,
    MeasurementModel,
    Scenario,
    Scope,
    simulate_received,
)
from rhs_isac_ros.model.impairments import (
    BUILT_IN,
    NO_INFORMATION,
    Nuisance,
    draw_factors,
    draw_impairments,
    impairments_of,
    nuisance_of,
    wrapped_precision,
)
from rhs_isac_ros.support.plugins import IMPAIRMENTS, PluginError

N_PHASES = 1500


@pytest.fixture(scope='module')
def uncertain(small) -> Scenario:
    """All impairments but the gain, which would change the covariance with the user."""
    return dataclasses.replace(
        small.scenario, band_phase_std_rad=7.0, timing_std_s=1e-6, carrier_offset_std_hz=1e4,
        element_error_rms=0.3, failed_element_share=0.2)


def simulate(scenario, codebook, positions, seed):
    return simulate_received(scenario, codebook, positions, np.random.default_rng(seed))


def sample(scenario, codebook, positions, seed):
    return MeasurementModel(scenario, codebook).sample(positions, np.random.default_rng(seed))


def test_built_in_impairments_have_field_scope_std_and_patterns():
    fields = {'user_gain_std_db': 2.0, 'carrier_offset_std_hz': 700.0, 'phase_std_rad': 0.4,
              'timing_std_s': 30e-9, 'band_phase_std_rad': 0.7}
    scenario = Scenario(**fields)
    assert [(one.field, one.scope, one.needs_search, len(one.patterns(scenario)))
            for one in BUILT_IN] == [
        ('user_gain_std_db', Scope.USER, False, 1), ('carrier_offset_std_hz', Scope.USER, True, 1),
        ('phase_std_rad', Scope.CYCLE, False, 1), ('timing_std_s', Scope.CYCLE, True, 1),
        ('band_phase_std_rad', Scope.CYCLE, False, 2)]
    # Gains are in nepers, all other values in the unit of the field.
    assert [one.std(scenario) for one in BUILT_IN] == pytest.approx(
        [2 * np.log(10) / 20, 700.0, 0.4, 30e-9, 0.7])
    assert impairments_of(scenario) == BUILT_IN
    assert impairments_of(Scenario(timing_std_s=1e-8)) == (BUILT_IN[3],)
    assert impairments_of(Scenario()) == ()
    nuisance = nuisance_of(scenario)
    stds = np.array([2 * np.log(10) / 20, 700.0, 0.4, 30e-9, 0.7, 0.7])
    np.testing.assert_allclose(
        nuisance.scaled_patterns, stds[:, None, None] * nuisance.patterns, rtol=1e-12)


def test_factors_written_out_for_one_measurement():
    scenario = Scenario(**{one.field: 1.0 for one in BUILT_IN})
    values = np.array([0.1, 500.0, 0.3, 2e-8, -0.2, 0.6])
    factor = nuisance_of(scenario).factors(values).reshape(2, 8, 4)
    offset_hz = (6 - 3.5) * scenario.subband_width_hz
    expected = np.exp(0.1 + 1j * (
        2 * np.pi * 500.0 * 3 * scenario.frame_duration_s + 0.3
        - 2 * np.pi * offset_hz * 2e-8 + 0.6))
    assert factor[1, 6, 3] == pytest.approx(expected, rel=1e-12)


def test_a_phase_with_the_deviation_of_a_turn_is_uniform():
    rng = np.random.default_rng(3)
    factors = draw_factors(Scenario(phase_std_rad=2 * np.pi), 20_000, rng, rng)[:, 0, 0]
    assert abs(factors.mean()) < 4 / np.sqrt(20_000)
    assert abs((factors**2).mean()) < 4 / np.sqrt(20_000)


@pytest.mark.parametrize('std', [0.1, 0.24, 0.26, 1.0, 2.0, 4.0])
def test_the_prior_of_a_phase_has_the_information_of_the_wrapped_density(std):
    """By finite differences of the density, as a sum over turns."""
    angle = np.linspace(-np.pi, np.pi, 4001)[:-1]
    turns = 2 * np.pi * np.arange(-9, 10)[:, None]
    density = np.exp(-(angle + turns)**2 / (2 * std**2)).sum(axis=0)
    density /= density.sum()
    slope = (np.roll(density, -1) - np.roll(density, 1)) / (2 * np.pi / 2000)
    information = np.sum(slope**2 / np.maximum(density, 1e-300))
    assert wrapped_precision(std) == pytest.approx(std**2 * information, rel=1e-3)


def test_the_information_of_a_wrapped_phase_has_the_known_limits():
    assert wrapped_precision(1e-300) == 1
    assert wrapped_precision(5.0) / 25 == pytest.approx(2 * np.exp(-25), rel=1e-6)
    nuisance = nuisance_of(Scenario(band_phase_std_rad=3.0, user_gain_std_db=60.0))
    np.testing.assert_allclose(nuisance.precision, [1, *[wrapped_precision(3.0)] * 2])


def test_offsets_are_wrapped_like_phases():
    scenario = Scenario(timing_std_s=3e-6, carrier_offset_std_hz=4e4)
    steps = 2 * np.pi * np.array([4e4 * scenario.frame_duration_s,
                                  3e-6 * scenario.subband_width_hz / 2])
    nuisance = nuisance_of(scenario)
    np.testing.assert_allclose(nuisance.period, 2 * np.pi / steps)
    np.testing.assert_allclose(nuisance.precision, [wrapped_precision(step) for step in steps])


def test_unknown_values_have_no_prior_and_are_uniform_over_a_period():
    scenario = Scenario(**{one.field: 'unknown' for one in BUILT_IN})
    nuisance = nuisance_of(scenario)
    # The common phase follows from those of the bands.
    assert len(nuisance) == 5
    assert (nuisance.precision == NO_INFORMATION).all()
    rng = np.random.default_rng(3)
    factors = draw_factors(scenario, 10_000, rng, rng)
    np.testing.assert_allclose(np.abs(factors), 1)
    first = factors[:, 0].reshape(-1, 8, 4)
    origin = first[:, 0, 0]
    for uniform in (origin, first[:, 1, 0] / origin, first[:, 0, 1] / origin):
        assert abs(uniform.mean()) < 4 / np.sqrt(10_000)
        assert abs((uniform**2).mean()) < 4 / np.sqrt(10_000)
    # A single measurement does not depend on offsets.
    single = Scenario(
        n_subbands=1, n_frames=1, timing_std_s='unknown', carrier_offset_std_hz='unknown')
    assert len(nuisance_of(single)) == 0


def test_a_seed_draws_the_same_values_whatever_is_declared():
    """One row of standard normal numbers of users, and one of cycles, for each draw."""
    scenario = Scenario(timing_std_s=30e-9, user_gain_std_db=2.0)
    drawn = draw_factors(scenario, 4, np.random.default_rng(4), np.random.default_rng(5))
    gain = np.random.default_rng(4).standard_normal((4, 2))[:, 0] * 2 * np.log(10) / 20
    timing = np.random.default_rng(5).standard_normal((4, 4))[:, 1] * 30e-9
    offsets = np.repeat((np.arange(8) - 3.5) * scenario.subband_width_hz, 4)
    expected = np.exp(gain[:, None] - 2j * np.pi * timing[:, None] * offsets)
    np.testing.assert_allclose(drawn, np.stack([expected] * 2, axis=1), rtol=1e-9)


def test_a_plugin_that_returns_something_else_is_an_error(install):
    install('no_impairment', 'def make(strength): return strength',
            {IMPAIRMENTS: {'no_impairment': 'make'}})
    scenario = Scenario(impairments={'no_impairment': 0.5})
    with pytest.raises(PluginError, match='no_impairment.*: returned 0.5, .* of Impairment'):
        impairments_of(scenario)


def _tilted(patterns, root):
    """Return a class of a fixed name, as a cell of a notebook defines it again and again."""
    class Tilted(Impairment):
        def __init__(self, strength): ...

        def linear(self, scenario):
            return Linear(patterns, root)
    return Tilted


def test_a_class_that_is_defined_again_replaces_the_previous_one():
    drawn = []
    for phase in (0.0, 1.0):
        scenario = Scenario(impairments={
            _tilted(np.full((1, 2, 32), 1j), phase * np.eye(1)): 0.5})
        rng = np.random.default_rng(0)
        drawn.append(draw_factors(scenario, 3, rng, rng))
    assert (drawn[0] == 1).all()
    assert (drawn[1] != 1).all()


@pytest.mark.parametrize(('patterns', 'root', 'text'), [
    (np.ones((1, 2, 3)), np.eye(1), 'patterns: shape (1, 2, 3), expected [q, 2, 32]'),
    (1j * np.ones((1, 2, 32)), 0.3, 'root: shape (), expected [1, 1]'),
    (np.full((1, 2, 32), np.nan), np.eye(1), 'patterns: not finite')])
def test_exponents_of_a_wrong_shape_are_errors_that_name_the_impairment(patterns, root, text):
    scenario, rng = Scenario(impairments={_tilted(patterns, root): 0.5}), np.random.default_rng(0)
    for work in (lambda: nuisance_of(scenario), lambda: draw_factors(scenario, 2, rng, rng)):
        with pytest.raises(PluginError) as caught:
            work()
        assert f'Tilted: {text}' in str(caught.value)


def test_multipath_and_noise_do_not_depend_on_impairments(small, uncertain):
    positions = small.scenario.sample_positions(3, np.random.default_rng(5))
    plain = simulate(small.scenario, small.codebook, positions, 6)
    phases = dataclasses.replace(small.scenario, phase_std_rad=1e-9)
    np.testing.assert_allclose(
        simulate(phases, small.codebook, positions, 6), plain, rtol=1e-6)
    assert not np.allclose(simulate(uncertain, small.codebook, positions, 6), plain, rtol=0.01)


@pytest.mark.parametrize('draw', [simulate, sample])
def test_signals_have_the_declared_distribution(small, uncertain, draw):
    """Deviations from the mean of the drawn surface, with the factors of the drawn users, are
    white after whitening."""
    positions = np.tile(small.vectors['positions'][2], (N_PHASES, 1))
    received = draw(uncertain, small.codebook, positions, 7)
    surface, factors = draw_impairments(uncertain, N_PHASES, np.random.default_rng(7))
    model = MeasurementModel(uncertain, small.codebook, surface)
    white = model.whiten(received / factors - model.mean(positions[:1])).reshape(N_PHASES, -1)
    limit = 5.0 / np.sqrt(N_PHASES)
    assert np.abs(white.T @ white.conj() / N_PHASES - np.eye(white.shape[1])).max() < limit
    assert np.abs(white.mean(axis=0)).max() < limit


@pytest.mark.parametrize('draw', [simulate, sample])
def test_gain_acts_on_the_multipath_but_not_on_the_noise(small, draw):
    scenario = dataclasses.replace(small.scenario, user_gain_std_db=6.0, noise_psd_dbm_hz=-90.0)
    positions = np.tile(small.vectors['positions'][2], (N_PHASES, 1))
    received = draw(scenario, small.codebook, positions, 8)
    _, factors = draw_impairments(scenario, N_PHASES, np.random.default_rng(8))
    model = MeasurementModel(scenario, small.codebook)
    deviation = (received - factors * model.mean(positions[:1]))[:, 0]
    noise = scenario.noise_power_w * np.eye(6)
    scattered = model.covariance()[0] - noise
    expected = np.mean(np.abs(factors[:, 0, 0])**2) * scattered + noise
    found = deviation.T @ deviation.conj() / N_PHASES
    assert np.abs(found - expected).max() < 0.25 * np.abs(expected).max()


# A new impairment needs a strength here, but no test of its own.
BUILT_IN_STRENGTHS = {
    'user_gain_std_db': 2.0, 'carrier_offset_std_hz': 700.0, 'phase_std_rad': 0.4,
    'timing_std_s': 30e-9, 'band_phase_std_rad': 0.4}
# Phases of the frames that follow a random walk, whose prior covariance is a full matrix.
WALK = '''
import numpy as np
from rhs_isac_ros.model import Impairment, Linear

class Walk(Impairment):
    def __init__(self, strength):
        self.strength = strength

    def linear(self, scenario):
        n = scenario.n_frames
        frames = 1j * np.tile(np.eye(n), scenario.n_subbands)[:, None]
        return Linear(np.repeat(frames, scenario.n_bands, axis=1),
                      self.strength * np.tri(n))
'''


@pytest.fixture(scope='module')
def every() -> Scenario:
    return Scenario(**BUILT_IN_STRENGTHS)


@pytest.mark.parametrize('check', CHECKS, ids=lambda check: check.__name__)
@pytest.mark.parametrize('field', [one.field for one in BUILT_IN])
def test_every_built_in_impairment(field, check):
    check({field: BUILT_IN_STRENGTHS[field]})


@pytest.mark.parametrize('check', CHECKS, ids=lambda check: check.__name__)
def test_an_impairment_of_another_package(install, check):
    install('random_walk', WALK, {'rhs_isac_ros.impairments': {'random_walk': 'Walk'}})
    check({'impairments': {'random_walk': 0.1}})


def test_table_1_has_no_nuisance_parameters(table1):
    nuisance = nuisance_of(table1.scenario)
    assert len(nuisance) == 0
    assert nuisance.patterns.shape == nuisance.scaled_patterns.shape == (0, 2, 32)
    assert nuisance.phases.shape == nuisance.scaled_phases[0].shape == (2, 0)
    np.testing.assert_array_equal(nuisance.factors(np.zeros((3, 0))), np.ones((3, 2, 32)))
    rng = np.random.default_rng(0)
    assert draw_factors(table1.scenario, 5, rng, rng) is None


def test_impairments_are_independent_of_each_other(table1):
    patterns = np.random.default_rng(0).normal(size=(3, 2, 32)) * 1j
    roots = np.array([[2.0, 0.0], [1.0, 3.0]]), np.array([[0.5]])
    nuisance = Nuisance(table1.scenario, [
        Linear(patterns[:2], roots[0], needs_search=True), Linear(patterns[2:], roots[1])])
    assert len(nuisance) == 3
    np.testing.assert_array_equal(nuisance.needs_search, [True, True, False])
    np.testing.assert_allclose(nuisance.scaled_patterns, np.stack(
        [2 * patterns[0] + patterns[1], 3 * patterns[1], 0.5 * patterns[2]]))
    white = np.random.default_rng(1).normal(size=3)
    values = np.concatenate([roots[0] @ white[:2], roots[1] @ white[2:]])
    np.testing.assert_allclose(
        nuisance.factors(values), np.exp(np.tensordot(white, nuisance.scaled_patterns, axes=1)))


def test_parameters_that_move_the_multipath_change_measurements_of_a_band(every):
    np.testing.assert_array_equal(
        nuisance_of(every).moves_multipath, [False, True, False, True, False, False])


def test_only_parameters_that_turn_whole_bands_have_phases(every):
    np.testing.assert_array_equal(
        nuisance_of(every).phases, [[0, 0, 0.4, 0, 0.4, 0], [0, 0, 0.4, 0, 0, 0.4]])
    np.testing.assert_array_equal(
        nuisance_of(every).scaled_phases[0], [[0.4, 0.4, 0], [0.4, 0, 0.4]])


def test_moves_and_phases_refer_to_standard_normal_numbers(install):
    """The first change of a random walk turns all frames alike, and each later one only some."""
    install('walk_of_phases', WALK, {'rhs_isac_ros.impairments': {'walk_of_phases': 'Walk'}})
    nuisance = nuisance_of(Scenario(impairments={'walk_of_phases': 0.1}))
    np.testing.assert_array_equal(nuisance.moves_multipath, [False, True, True, True])
    np.testing.assert_allclose(nuisance.phases, 0.1 * np.array([[1, 0, 0, 0]] * 2))
