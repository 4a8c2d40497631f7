"""The Cramer-Rao lower bound of a site with several surfaces."""

import dataclasses

import numpy as np
import pytest

from rhs_isac_ros.bounds import crlb_of, fisher_information, site_crlb, site_information
from rhs_isac_ros.codebook import random_codebook
from rhs_isac_ros.model import MeasurementModel, Pose, Scenario

FRONT = Pose(uncertainty=(0.0, 0.0))
SIDE = Pose((10.0, -10.0, 0.0), (0.0, 0.0, 1.0, 1.0), (0.0, 0.0))
PLACES = np.array([[8.0, 1.0, 0.2], [14.0, -4.0, -0.9]])


@pytest.fixture(scope='module')
def model():
    scenario = Scenario(n_frames=2, elements_per_side=6)
    return MeasurementModel(scenario, random_codebook(scenario, np.random.default_rng(1)))


def at(model, pose):
    """Return the model with another pose of its surface."""
    return MeasurementModel(dataclasses.replace(model.scenario, pose=pose), model.beams)


def test_one_surface_at_the_origin_has_its_own_bound(model):
    np.testing.assert_allclose(site_crlb([at(model, FRONT)], PLACES), crlb_of(model, PLACES))


def test_the_bound_of_one_surface_does_not_depend_on_its_pose(model):
    np.testing.assert_allclose(
        site_crlb([at(model, SIDE)], PLACES), crlb_of(model, SIDE.to_surface(PLACES)))


def test_information_adds_up_in_the_frame_of_the_site(model):
    side = fisher_information(model, SIDE.to_surface(PLACES))
    # A turn by 90 degrees: x of the site is -y of the surface, and y of the site is its x.
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    np.testing.assert_allclose(
        site_information([at(model, FRONT), at(model, SIDE)], PLACES),
        fisher_information(model, PLACES) + turn @ side @ turn.T)


def test_a_second_surface_improves_the_bound(model):
    one, two = (site_crlb([at(model, pose) for pose in poses], PLACES)
                for poses in ([FRONT], [FRONT, SIDE]))
    assert (two < 0.7 * one).all()


def test_the_error_of_a_pose_adds_its_covariance(model):
    uncertain = dataclasses.replace(SIDE, uncertainty=(0.1, 1.0))
    exact, found = (np.linalg.inv(site_information([at(model, pose)], PLACES))
                    for pose in (SIDE, uncertain))
    np.testing.assert_allclose(found, exact + uncertain.spread(PLACES))


def test_a_surface_in_an_unknown_place_adds_nothing(model):
    lost = dataclasses.replace(SIDE, uncertainty=(1e6, 0.0))
    np.testing.assert_allclose(site_crlb([at(model, FRONT), at(model, lost)], PLACES),
                               site_crlb([at(model, FRONT)], PLACES), rtol=1e-6)


def test_a_user_behind_a_surface_is_refused(model):
    with pytest.raises(ValueError, match='in front of the surface'):
        site_crlb([at(model, SIDE)], np.array([[10.0, -11.0, 0.0]]))
