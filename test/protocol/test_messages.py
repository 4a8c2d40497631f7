"""Messages and events as data, and the check of malformed messages."""

import dataclasses
import inspect
import math

import numpy as np
import pytest

from rhs_isac_ros.model import Pose
from rhs_isac_ros.protocol import messages as m

KINDS = [kind for _, kind in inspect.getmembers(m, inspect.isclass)
         if issubclass(kind, m.Message) and kind is not m.Message]


def name_of(value):
    return getattr(value, '__name__', None)


@pytest.fixture
def error_of(example, scenario):
    """Function that returns the error of a message, without its class; '' if it is valid.

    A field is given by its value, or by a function that changes the array of an example.
    """
    def find(kind, **fields):
        message = example(kind, **{
            name: value for name, value in fields.items() if not callable(value)})
        for name, change in fields.items():
            if callable(change):
                change(getattr(message, name))
        try:
            m.check(message, scenario)
        except m.MessageError as error:
            prefix, text = str(error).split('.', 1)
            assert prefix == kind.__name__
            return text
        return ''
    return find


def sets(first, others=None):
    """Return a function that sets the first element of an array, and the others if given."""
    def change(array):
        array.flat[0] = first
        if others is not None:
            array.flat[1:] = others
    return change


@pytest.mark.parametrize('kind', KINDS, ids=name_of)
def test_an_example_of_every_message_is_valid(example, scenario, kind):
    for rng in (None, np.random.default_rng(0)):
        m.check(example(kind, rng), scenario)


def test_messages_are_the_same_if_all_fields_are_equal(example):
    one = example(m.Beam, cycle_id=3, user=1)
    assert m.same(one, example(m.Beam, cycle_id=3, user=1))
    for changes in ({'cycle_id': 4}, {'user': 2}, {'analog': one.analog + 0.5}):
        assert not m.same(one, dataclasses.replace(one, **changes))
    assert not m.same(m.Ack(cycle_id=1, user=2), m.Grant(cycle_id=1, user=2))
    unknown = example(m.PositionEstimate, crlb_m2=np.nan)
    assert m.same(unknown, dataclasses.replace(unknown))
    assert not m.same(unknown, dataclasses.replace(unknown, crlb_m2=0.5))


def test_a_message_takes_the_fields_of_its_cycle_from_another():
    request = m.PilotRequest(cycle_id=3, user=2, user_instance=5, band=1, last_band=1, n_frames=2,
                             sender=9, scenario_id='sc', stamp_ns=7)
    pilot = m.derive(m.Pilot, request, symbols=np.ones(2, complex))
    assert (pilot.cycle_id, pilot.user, pilot.band) == (3, 2, 1)
    assert (pilot.sender, pilot.scenario_id, pilot.stamp_ns) == (0, '', 0)
    assert m.derive(m.Pilot, request, band=0, symbols=pilot.symbols).band == 0


@pytest.mark.parametrize('frames', [0, 1, 2, 7])
@pytest.mark.parametrize(('mode', 'right'), [(m.Mode.POSITIONING, 2), (m.Mode.TRANSMISSION, 1)])
def test_a_surface_reports_all_frames_or_the_one_of_the_beam(error_of, mode, right, frames):
    error = error_of(m.RhsConfiguration, mode=mode, analog=np.zeros((frames, 16)))
    assert ('expected [FRAMES = ' in error) == bool(error) == (frames != right)


def fields_of(predicate):
    """Parameters for all fields of all messages that have a property."""
    return pytest.mark.parametrize(('kind', 'field'), [
        (kind, field) for kind in KINDS for field in dataclasses.fields(kind)
        if predicate(field)], ids=name_of)


@fields_of(lambda field: 'dims' in field.metadata)
def test_a_wrong_shape_is_named(error_of, kind, field):
    shape = (1,) * (len(field.metadata['dims']) + 1)
    assert error_of(kind, **{field.name: np.zeros(shape)}).startswith(
        f'{field.name}: shape {list(shape)}, expected [')


@fields_of(lambda field: 'dims' in field.metadata and field.metadata['declared'].kind is not int)
def test_an_array_with_a_value_that_is_not_finite_is_named(error_of, kind, field):
    bad = [math.nan, math.inf, -math.inf]
    bad += [complex(0, math.nan)] * (field.metadata['declared'].kind is complex)
    for value in bad:
        unknown = field.metadata['nan_allowed'] and np.isnan(value)
        assert error_of(kind, **{field.name: sets(value)}) == (
            '' if unknown else f'{field.name}: not finite, expected finite numbers')


@fields_of(lambda field: field.type is float and 'dims' not in field.metadata)
def test_a_number_must_be_finite_unless_it_may_be_unknown(error_of, kind, field):
    unknown = {'crlb_m2', 'actual_bps', 'perfect_bps', 'loss_bps', 'loss_percent',
               'outside_log_ratio', 'blocked_log_ratio', 'misfit_log_ratio'}
    for bad in (math.nan, math.inf):
        assert error_of(kind, **{field.name: bad}) == (
            '' if field.name in unknown else f'{field.name}: {bad}, expected a finite number')


@fields_of(lambda field: field.name in ('band', 'last_band'))
def test_bands_are_indices(error_of, kind, field):
    assert [error_of(kind, **{field.name: value}) for value in (0, 1)] == ['', '']
    for value in (-1, 2, 4_000_000_000):
        assert error_of(kind, **{field.name: value}) == (
            f'{field.name}: {value}, expected 0 to 1 (N_B = 2)')


@fields_of(lambda field: 'declared' in field.metadata and 'dims' not in field.metadata)
def test_a_number_out_of_range_is_named(error_of, kind, field):
    declared = field.metadata['declared']
    for good in (declared.low, declared.high):
        # The value alone is in range; with others, a largest range of 0 is a contradiction.
        assert declared.range not in error_of(kind, **{field.name: field.type(good)})
    for bad in (field.type(declared.low - 1), field.type(declared.high + 1)):
        assert error_of(kind, **{field.name: bad}) == (
            f'{field.name}: {bad}, expected {declared.range}')


def skewed(matrices):
    """Add 1 above the diagonal of the first of several matrices."""
    matrices[0, 0, 1] += 1.0


SYMBOLS = {size: np.array([1, size * 1j]) for size in (0.0, 0.98, 0.99, 1.0, 1.01, 1.02)}
VALID = [(m.Pilot, {'symbols': SYMBOLS[size]}) for size in (0.99, 1.0, 1.01)]
VALID += [(kind, {'position': np.array([1e6, -1e6, 0])})
          for kind in (m.PositionEstimate, m.GroundTruth)]
VALID += [(m.Posterior, {'means': np.ones((2, 6)), 'covariances_m2': np.stack([np.eye(6)] * 2)}),
          (m.Posterior, {'outside_log_weights': np.zeros(0), 'outside_means': np.zeros((0, 3)),
                         'outside_covariances_m2': np.zeros((0, 3, 3))})]
VALID += [(kind, {'analog': sets(1.0, 0.0)}) for kind in (m.RhsConfiguration, m.Beam)]
MALFORMED = [
    (m.FeedSignals, {'signals': np.zeros((3, 3, 2))},
     'shape [3, 3, 2], expected [F = 2, N_SB = 3, K = 2]'),
    (m.PositionEstimate, {'covariance_m2': np.zeros((3, 2))}, 'expected [3, 3]'),
    *((m.PilotRequest, {'n_frames': n}, f'n_frames: {n}, expected F = 2')
      for n in (0, 2**31)),
    *((m.Pilot, {'symbols': SYMBOLS[size]}, 'expected 0.99 to 1.01')
      for size in (0.0, 0.98, 1.02)),
    *((kind, {'analog': sets(low, high)}, f'analog: {text}, expected 0 to 1')
      for kind in (m.RhsConfiguration, m.Beam)
      for low, high, text in ((-1e-9, 0.5, '-1e-09 to 0.5'), (0.0, 1.25, '0 to 1.25'),
                              (-2.0, 3.0, '-2 to 3'))),
    *((kind, {'position': sets(x_m)}, 'expected x > 0')
      for kind in (m.PositionEstimate, m.GroundTruth, m.GroundTruths) for x_m in (0.0, -8.0)),
    *((kind, {'position': np.array([1.1e6, 0, 0])}, 'position: 0 to 1.1e+06')
      for kind in (m.PositionEstimate, m.GroundTruth)),
    (m.Posterior, {'covariances_m2': np.stack([np.eye(3), np.diag([1.0, 1.0, 0.0])])},
     'eigenvalue 0, asymmetry 0, expected symmetric matrices with positive eigenvalues'),
    *((m.Posterior, {name: sets(value)}, f'{name}: eigenvalue {reason}') for name in (
        'covariances_m2', 'sheet_covariances', 'outside_covariances_m2')
      for value, reason in ((-1.0, '-1, asymmetry 0, expected'), (0.0, '0, asymmetry 0'))),
    *((m.Posterior, {name: skewed}, 'asymmetry 1, expected symmetric matrices') for name in (
        'covariances_m2', 'sheet_covariances', 'outside_covariances_m2')),
    *((m.Posterior, {name: sets(-1.0)}, f'{name}: x = -1 m, expected x > 0') for name in (
        'means', 'outside_means')),
    (m.Posterior, {'means': np.zeros((3, 3))}, 'expected [COMPONENTS = 2, D = 3]'),
    (m.Posterior, {'covariances_m2': np.stack([np.eye(6)] * 2)},
     'expected [COMPONENTS = 2, D = 3, D = 3]'),
    (m.Posterior, {'outside_range_m': 0.0}, 'outside_range_m: 0, expected the largest range'),
    (m.Posterior, {'surface_quaternion': np.zeros(4)}, 'a length other than 0'),
    (m.Posterior, {'surface_uncertainty': -np.eye(6)}, 'without negative eigenvalues'),
    *((m.Posterior, {f'{part}log_weights': np.zeros(n), f'{part}means': np.ones((n, 3)),
                     f'{part}{covariances}': np.tile(np.eye(3), (n, 1, 1))},
       f'{n} components, expected {fewest} to 256')
      for part, covariances, n, fewest in (
          ('', 'covariances_m2', 0, 1), ('', 'covariances_m2', 257, 1),
          ('sheet_', 'covariances', 257, 0), ('outside_', 'covariances_m2', 257, 0))),
    # The position of a later frame would be beyond all that the model computes.
    *((kind, {'velocity': sets(-3e8)}, 'velocity: -3e+08') for kind in (
        m.GroundTruth, m.GroundTruths)),
    (m.PositionEstimate, {'covariance_m2': np.eye(3) * 1e13}, 'covariance_m2: 0 to 1e+13'),
    *((m.Posterior, {name: np.full((1, 3), 1e7)}, f'{name}: 1e+07 to 1e+07') for name in (
        'sheet_means', 'outside_means')),
    # Squares of large numbers would overflow.
    *((m.Beam, {'digital': sets(size)}, f'power {power} W, expected at most max_power_w = 0.001 W')
      for size, power in ((0.1, 0.01), (1e300, '1e+18'))),
    (m.GroundTruth, {'position': np.array([5.0, 1j, 0.0])}, 'expected real numbers'),
    (m.GroundTruth, {'position': np.ma.array([5.0, 1.0, 0.0], mask=[0, 1, 0])},
     'expected real numbers'),
]


@pytest.mark.parametrize(('kind', 'fields'), VALID)
def test_the_ends_of_the_ranges_are_valid(error_of, kind, fields):
    assert error_of(kind, **fields) == ''


@pytest.mark.parametrize(('kind', 'fields', 'expected'), MALFORMED)
def test_a_value_with_another_meaning_than_declared_is_named(error_of, kind, fields, expected):
    error = error_of(kind, **fields)
    assert error.startswith(f'{[*fields][0]}: ')
    assert expected in error


@pytest.mark.parametrize(
    'kind', [kind for kind in m.POSITIONS if kind is not m.Posterior], ids=name_of)
def test_in_front_depends_on_the_pose_of_the_surface(example, scenario, kind):
    # The surface faces along -y.
    turned = dataclasses.replace(
        scenario, pose=Pose((0.0, 10.0, 0.0), (0.0, 0.0, -1.0, 1.0)))
    message = example(kind)
    message.position[...] = -5.0, 9.0, 0.0
    m.check(message, turned)
    message.position[...] = 5.0, 11.0, 0.0
    m.check(message, scenario)
    with pytest.raises(m.MessageError, match=r'\.position: x = -1 m, expected x > 0'):
        m.check(message, turned)
