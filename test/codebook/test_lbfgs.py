"""The quasi-Newton method, on functions whose minimum is known."""

import numpy as np

from rhs_isac_ros.codebook.lbfgs import minimize_lbfgs


def run(max_steps):
    """Minimise a quadratic with a box for the first half; return the points and the steps."""
    rng = np.random.default_rng(0)
    center, weights = rng.normal(size=20) * 2, rng.uniform(1, 50, 20)
    points, steps = [], []

    def function(x):
        points.append(np.array(x))
        return float(np.sum(weights * (x - center)**2)), 2 * weights * (x - center)

    bounds = [(0.0, 1.0)] * 10 + [(None, None)] * 10
    reason = minimize_lbfgs(
        function, np.full(20, 0.5), bounds, max_steps, lambda: steps.append(len(points)))
    best = np.where(np.arange(20) < 10, np.clip(center, 0, 1), center)
    return points, steps, best, reason


def test_finds_the_minimum_and_reports_every_step():
    points, steps, best, reason = run(200)
    np.testing.assert_allclose(points[-1], best, atol=1e-3)
    assert all((0 <= x[:10]).all() and (x[:10] <= 1).all() for x in points)
    assert 2 < len(steps) < 200
    assert steps == sorted(steps)
    assert 'CONVERGENCE' in reason.upper()


def test_stops_at_the_limit_of_steps():
    points, steps, _, reason = run(3)
    assert len(steps) == 3
    assert len(points) <= 60
    assert 'LIMIT' in reason.upper()
