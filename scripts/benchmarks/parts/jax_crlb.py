"""The average bound in JAX, with automatic differentiation."""

from collections.abc import Callable

import numpy as np

from rhs_isac_ros.model import Scenario
from rhs_isac_ros.model.los import los_and_derivative
from rhs_isac_ros.model.multipath import measurement_correlation, multipath_covariance
from rhs_isac_ros.model.surface import onboard_matrix


class JaxAverageCrlb:
    """Average bound at fixed positions with its gradient, compiled, in double precision.

    Parameters
    ----------
    positions
        Float64 [N, 3] [m].
    """

    def __init__(self, scenario: Scenario, positions: np.ndarray) -> None:
        import jax
        import jax.numpy as jnp

        jax.config.update('jax_enable_x64', True)
        self._block = jax.block_until_ready
        n, n_bands, n_subbands = len(positions), scenario.n_bands, scenario.n_subbands
        n_rows = n_subbands * scenario.n_frames
        # With the sub-bands first, the products read contiguous memory.
        derivatives = np.stack([
            np.moveaxis(los_and_derivative(scenario, positions, band)[1], 2, 0).reshape(
                n_subbands, 3 * n, scenario.n_elements) for band in range(n_bands)])
        self._constants = [jnp.asarray(array) for array in (
            derivatives, onboard_matrix(scenario), multipath_covariance(scenario),
            measurement_correlation(scenario))]
        noise = scenario.noise_power_w * jnp.eye(n_rows)
        self._shapes = ((n_bands, scenario.n_frames, scenario.n_elements),
                        (n_bands, n_subbands, scenario.n_frames, scenario.n_feeds))
        root_power = np.sqrt(scenario.max_power_w)

        def bound(analog, real, imag, derivatives, onboard, spatial, correlation):
            raw = real + 1j * imag
            norm = jnp.sqrt(jnp.sum(real**2 + imag**2, axis=(1, 3), keepdims=True))
            patterns = analog[:, None] * jnp.matmul(raw * (root_power / norm), onboard)
            means = jnp.matmul(derivatives, jnp.swapaxes(patterns, 2, 3))
            means = jnp.transpose(means, (0, 1, 3, 2)).reshape(n_bands, n_rows, 3 * n)
            rows = patterns.reshape(n_bands, n_rows, -1)
            scattered = rows @ spatial @ jnp.conj(jnp.swapaxes(rows, 1, 2))
            factor = jnp.linalg.cholesky(correlation * scattered + noise)
            whitened = jax.scipy.linalg.solve_triangular(factor, means, lower=True)
            whitened = whitened.reshape(n_bands, n_rows, n, 3)
            information = 2 * jnp.real(
                jnp.einsum('iknu,iknv->nuv', jnp.conj(whitened), whitened))
            return jnp.mean(jnp.trace(jnp.linalg.inv(information), axis1=1, axis2=2))

        self._function: Callable = jax.jit(jax.value_and_grad(bound, argnums=(0, 1, 2)))

    def __call__(self, variables: np.ndarray) -> tuple[float, np.ndarray]:
        """Return value [m^2] and gradient, float64 [n], at variables in the order of `Problem`."""
        analog_shape, digital_shape = self._shapes
        analog = variables[:np.prod(analog_shape)].reshape(analog_shape)
        real, imag = variables[analog.size:].reshape(2, *digital_shape)
        value, gradients = self._block(self._function(analog, real, imag, *self._constants))
        return float(value), np.concatenate([np.asarray(g).ravel() for g in gradients])
