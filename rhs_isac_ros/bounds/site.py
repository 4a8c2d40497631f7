"""The Cramer-Rao lower bound of positioning with several surfaces of a site."""

from collections.abc import Iterable

import numpy as np

from rhs_isac_ros.bounds.fisher import inverse_information, joint_information_of, without_nuisance
from rhs_isac_ros.model import MeasurementModel
from rhs_isac_ros.support.threads import one_blas_thread


@one_blas_thread
def site_information(surfaces: Iterable[MeasurementModel], positions: np.ndarray) -> np.ndarray:
    """Add up the Fisher information of the surfaces, float64 [N, 3, 3] [1/m^2].

    Each surface has the pose of its scenario. Takes positions of the user, float64 [N, 3] [m], in
    the frame of the site, in front of every surface. Noise, multipath, nuisance parameters and
    errors of the poses are independent for each surface and cycle. Raises ValueError if a position
    is not in front of a surface.
    """
    total = np.zeros((len(positions), 3, 3))
    for model in surfaces:
        pose = model.scenario.pose
        joint = joint_information_of(model, pose.to_surface(positions))
        information = pose.covariances_to_site(
            without_nuisance(joint, model.scenario).information)
        # The errors of the pose add their covariance to the inverse of the information.
        widened = np.eye(3) + np.matmul(information, pose.spread(positions))
        total += np.linalg.solve(widened, information)
    return (total + np.swapaxes(total, 1, 2)) / 2


def site_crlb(surfaces: Iterable[MeasurementModel], positions: np.ndarray) -> np.ndarray:
    """Compute the bound on the mean squared positioning error, float64 [N] [m^2].

    Takes the arguments of `site_information`. The bound is infinite where the information is
    singular.
    """
    information = site_information(surfaces, positions)
    return np.trace(inverse_information(information), axis1=1, axis2=2)
