"""Estimates from posteriors, with rclpy, numpy and the messages: ``python3 read_posterior.py``.

``-r posterior:=/front/posterior`` after ``--ros-args`` selects the topic of one surface of a site.
"""

import numpy as np
import rclpy
from rclpy.executors import ExternalShutdownException

from rhs_isac_msgs.msg import Posterior


def array(field):
    """Return a `RealArray` as an array."""
    return np.reshape(field.data, field.shape)


def estimate(posterior):
    """Return mean [3] [m] and covariance [3, 3] [m^2], as in `PositionEstimate` with `bayes`.

    They apply to a user in the region. A track's earlier signals are not in the posterior.
    """
    # Where users move, columns for the velocity follow those for the position.
    weights, means = np.exp(array(posterior.log_weights)), array(posterior.means)[:, :3]
    mean = weights @ means
    offsets = means - mean
    covariances = array(posterior.covariances_m2)[:, :3, :3]
    covariance = np.tensordot(weights, covariances, axes=1)
    covariance += offsets.T @ (weights[:, None] * offsets)
    # The pose of the surface has errors: a shift, and a rotation about the surface.
    surface = posterior.surface_position_m
    x, y, z = mean - [surface.x, surface.y, surface.z]
    moves = np.hstack([np.eye(3), [[0, z, -y], [-z, 0, x], [y, -x, 0]]])
    return mean, covariance + moves @ np.reshape(posterior.surface_uncertainty, (6, 6)) @ moves.T


def show(posterior):
    """Print the estimate, and the mode that contributes most to it."""
    mean, covariance = estimate(posterior)
    likely = np.argmax(array(posterior.log_weights))
    print(f'cycle {posterior.cycle_id}, user {posterior.user}, outside with probability '
          f'{posterior.outside_probability:.3f}, otherwise at {mean.round(3)} m, standard '
          f'deviations {np.sqrt(np.diag(covariance)).round(3)} m, most likely near '
          f'{array(posterior.means)[likely, :3].round(3)} m', flush=True)


if __name__ == '__main__':
    rclpy.init()
    node = rclpy.create_node('read_posterior')
    node.create_subscription(Posterior, 'posterior', show, 10)
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
