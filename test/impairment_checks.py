"""Properties that every impairment of the signals has; a plug-in is checked in three lines::

    @pytest.mark.parametrize('check', CHECKS)
    def test_oscillator(check):
        check({'impairments': {'oscillator': 0.05}})

The argument is the field of the scenario that declares the impairment. Its strength is so small
that no phase reaches half a turn.
"""

import numpy as np

from rhs_isac_ros.model import Impairment, Scenario, Scope
from rhs_isac_ros.model.impairments import draw_factors, impairments_of, nuisance_of

N_DRAWS = 20_000
# Sizes that all differ.
SIZES = {'center_frequencies_hz': (1.2e9, 2e9, 3.1e9), 'n_subbands': 2, 'n_frames': 4}
# Impairments of both scopes, each of which is omitted if it is the one under test.
OTHERS = {'user_gain_std_db': 0.5, 'carrier_offset_std_hz': 90.0, 'phase_std_rad': 0.1,
          'timing_std_s': 2e-8, 'band_phase_std_rad': 0.1, 'element_error_rms': 0.1}


def only(declared: dict) -> tuple[Scenario, Impairment]:
    """Return a scenario with one impairment, and the impairment."""
    scenario = Scenario(**SIZES, **declared)
    (impairment,) = impairments_of(scenario)
    return scenario, impairment


def draw(scenario: Scenario, n: int = 3, user: int = 1, cycle: int = 2) -> np.ndarray:
    """Draw factors from the seeds of the users and of the cycles."""
    return draw_factors(scenario, n, np.random.default_rng(user), np.random.default_rng(cycle))


def has_a_prior_and_a_pattern_for_each_value(declared: dict) -> None:
    scenario, impairment = only(declared)
    linear = impairment.linear(scenario)
    size = len(linear.root)
    assert size > 0
    assert linear.patterns.shape == (size, 3, 8)
    assert linear.patterns.any(axis=(1, 2)).all()
    assert linear.root.shape == (size, size)
    assert np.linalg.cond(linear.root) < 1e6


def values_have_the_declared_covariance(declared: dict) -> None:
    scenario, impairment = only(declared)
    root = impairment.linear(scenario).root
    white = np.random.default_rng(0).standard_normal((N_DRAWS, len(root)))
    scaled = np.linalg.solve(root, impairment.values(scenario, white).T)
    limit = 6 / np.sqrt(N_DRAWS)
    np.testing.assert_allclose(scaled.mean(axis=1), 0, atol=limit)
    np.testing.assert_allclose(scaled @ scaled.T / N_DRAWS, np.eye(len(root)), atol=limit)


def drawn_factors_have_the_covariance_of_the_exponents(declared: dict) -> None:
    scenario, impairment = only(declared)
    linear = impairment.linear(scenario)
    exponents = np.einsum('pq,pir->qir', linear.root, linear.patterns)
    parts = exponents.reshape(len(exponents), -1).view(float)
    drawn = np.log(draw(scenario, N_DRAWS)).reshape(N_DRAWS, -1).view(float)
    expected = parts.T @ parts
    np.testing.assert_allclose(
        drawn.T @ drawn / N_DRAWS, expected, atol=8 / np.sqrt(N_DRAWS) * expected.max())


def factors_are_exponentials_of_the_patterns(declared: dict) -> None:
    scenario, impairment = only(declared)
    nuisance, linear = nuisance_of(scenario), impairment.linear(scenario)
    values = np.random.default_rng(1).standard_normal((5, len(linear.root))) @ linear.root.T
    expected = np.ones((5, 3, 8), complex)
    for value, pattern in zip(values.T, linear.patterns, strict=True):
        expected *= np.exp(np.multiply.outer(value, pattern))
    np.testing.assert_allclose(nuisance.factors(values), expected, rtol=1e-12)


def patterns_are_the_slopes_of_the_factors(declared: dict) -> None:
    scenario, impairment = only(declared)
    nuisance, linear = nuisance_of(scenario), impairment.linear(scenario)
    for index, pattern in enumerate(linear.patterns):
        step = np.zeros(len(linear.root))
        step[index] = 1e-4 / np.abs(pattern).max()
        slope = (nuisance.factors(step) - nuisance.factors(-step)) / (2 * step[index])
        np.testing.assert_allclose(slope, pattern, atol=1e-6 * np.abs(pattern).max())


def values_last_as_long_as_the_scope(declared: dict) -> None:
    scenario, impairment = only(declared)
    first = draw(scenario)
    for scope, other in ((Scope.USER, draw(scenario, user=3)),
                         (Scope.CYCLE, draw(scenario, cycle=3))):
        assert np.array_equal(first, other) is (impairment.scope is not scope)
    np.testing.assert_array_equal(first, draw(scenario))


def values_do_not_depend_on_other_impairments(declared: dict) -> None:
    others = {name: value for name, value in OTHERS.items() if name not in declared}
    alone, without, both = (
        draw(Scenario(**SIZES, **fields)) for fields in (declared, others, others | declared))
    np.testing.assert_allclose(both, alone * without, rtol=1e-12)
    assert not np.allclose(both, without, rtol=1e-6)


CHECKS = (
    has_a_prior_and_a_pattern_for_each_value, values_have_the_declared_covariance,
    drawn_factors_have_the_covariance_of_the_exponents, factors_are_exponentials_of_the_patterns,
    patterns_are_the_slopes_of_the_factors, values_last_as_long_as_the_scope,
    values_do_not_depend_on_other_impairments)
