#!/usr/bin/env bash
# filterpy 2.0.0: three filters differ from the exact solution of a linear system with Gaussian noise. CubatureKalmanFilter
# predicts measurements with the points from before the process noise, so that its covariance is too large; without
# process noise it is exact. FixedLagSmoother smooths with the covariance after the measurement in place of the one before
# it, so that its squared error is about twice that of the exact smoother. MMAEFilterBank subtracts the first element of
# the mean from the state of the first filter, the second from that of the second, and leaves out the terms of filters
# beyond the number of elements, so that the covariance of three filters with one element is the term of the first one.
#
# Guess before the run: all three are exact, since cubature points are exact for linear functions (Arasaratnam and Haykin,
# 2009), a smoother with a lag has a closed form, and the mean and the covariance of a mixture, too. The mean of
# MMAEFilterBank and IMMEstimator are right. The script fails if the behaviour changes.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/python" -m pip install --quiet --disable-pip-version-check \
  'filterpy==2.0.0' 'numpy==2.3.5' 'scipy==1.17.1'
cat > "$folder/observe.py" <<'PYTHON'
from importlib.metadata import version

import numpy as np
from filterpy.kalman import (
    CubatureKalmanFilter,
    FixedLagSmoother,
    KalmanFilter,
    MMAEFilterBank,
)

F = np.array([[1.0, 0.5], [0.0, 1.0]])
H = np.array([[1.0, 0.0]])
Q = np.array([[0.1, 0.15], [0.15, 0.5]])
R = np.array([[0.5]])
LAG = 4


def started(one, x, p, f, h, q):
    """Return a filter with the matrices of the system."""
    one.x, one.P, one.F, one.H, one.Q, one.R = x.copy(), p.copy(), f, h, q, R
    return one


def kalman(q, x=np.zeros((2, 1)), p=np.eye(2), f=F, h=H):
    """Return the exact filter."""
    return started(KalmanFilter(dim_x=len(x), dim_z=1), x, p, f, h, q)


print('filterpy', version('filterpy'))
rng = np.random.default_rng(1)
for scale in (0.0, 1.0):
    exact = kalman(scale * Q)
    cubature = started(
        CubatureKalmanFilter(2, 1, 1.0, hx=lambda x: H @ x, fx=lambda x, dt: F @ x),
        np.zeros((2, 1)), np.eye(2), F, H, scale * Q)
    for measured in rng.standard_normal(30):
        for one in (exact, cubature):
            one.predict()
            one.update(np.array([[measured]]))
    ratio = np.diag(cubature.P) / np.diag(exact.P)
    print(f'CubatureKalmanFilter, {scale:g} Q: variances over the exact ones', ratio.round(2))

errors = []
for _ in range(400):
    state, states, measured = rng.standard_normal((2, 1)), [], []
    for _ in range(40):
        state = F @ state + np.linalg.cholesky(0.2 * Q) @ rng.standard_normal((2, 1))
        states.append(state)
        measured.append(H @ state + np.sqrt(R) * rng.standard_normal((1, 1)))
    means, covariances, _, _ = kalman(0.2 * Q).batch_filter(measured)
    smoother = started(FixedLagSmoother(2, 1, LAG), np.zeros((2, 1)), np.eye(2), F, H, 0.2 * Q)
    for one in measured:
        smoother.smooth(one)
    inner = range(LAG, len(states) - LAG)
    exact = [kalman(0.2 * Q).rts_smoother(means[:k + LAG + 1], covariances[:k + LAG + 1])[0][k]
             for k in inner]
    errors.append([np.mean((np.asarray(found)[:, 0, 0] - [states[k][0, 0] for k in inner])**2)
                   for found in ([smoother.xSmooth[k] for k in inner], exact)])
found, lowest = np.mean(errors, axis=0)
print(f'FixedLagSmoother: squared error over that of the exact smoother {found / lowest:.1f}')

for names, dimension in (('3 filters, 1 element', 1), ('2 filters, 2 elements', 2)):
    f, h = F[:dimension, :dimension], H[:, :dimension]
    filters = [kalman(scale * Q[:dimension, :dimension], np.full((dimension, 1), start),
                      np.eye(dimension), f, h)
               for scale, start in ((1.0, 0.0), (3.0, 2.0), (9.0, 5.0))[:4 - dimension]]
    bank = MMAEFilterBank(filters, [1 / len(filters)] * len(filters), dim_x=dimension, H=h)
    bank.predict()
    bank.update(np.array([[2.0]]))
    mean = sum(p * one.x for p, one in zip(bank.p, filters))
    exact = sum(p * (one.P + (one.x - mean) @ (one.x - mean).T)
                for p, one in zip(bank.p, filters))
    assert np.allclose(bank.x, mean)
    print(f'MMAEFilterBank, {names}: variances {np.diag(bank.P).round(3)}, exact',
          np.diag(exact).round(3))
PYTHON
found=$(timeout 120 "$folder/venv/bin/python" -W ignore "$folder/observe.py")
echo "$found"
[[ $found == 'filterpy 2.0.0
CubatureKalmanFilter, 0 Q: variances over the exact ones [1. 1.]
CubatureKalmanFilter, 1 Q: variances over the exact ones [1.37 1.18]
FixedLagSmoother: squared error over that of the exact smoother 1.9
MMAEFilterBank, 3 filters, 1 element: variances [0.137], exact [0.474]
MMAEFilterBank, 2 filters, 2 elements: variances [1.109 2.385], exact [0.506 1.963]' ]]
