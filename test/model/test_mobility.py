"""Movement of the users."""

import numpy as np
import pytest

from rhs_isac_ros.model import PathChannel, Scenario, mobility

SQUARE = [(6.0, 0.0, 0.0), (8.0, 0.0, 0.0), (8.0, 3.0, 0.0), (6.0, 3.0, 0.0)]
START_S = 1234.5


def track(moves, times):
    """Positions and velocities at times, each [N, 3]."""
    return tuple(np.array(part) for part in zip(*(moves.state(t) for t in times), strict=True))


def test_a_traced_user_is_at_the_nearest_traced_position():
    users = np.array([[6.0, 0, 0], [7.0, 0, 0], [8.0, 0, 0]])
    paths = PathChannel(users, np.full((3, 1), 1e-4 + 0j), users[:, None],
                        np.zeros((3, 1), int), 2.75e9)
    moves = mobility.Traced(mobility.Waypoints(SQUARE[:2], 1.0), paths)
    positions, velocities = track(moves, [0.0, 0.4, 0.6, 1.4, 1.8])
    np.testing.assert_array_equal(positions, users[[0, 0, 1, 1, 2]])
    np.testing.assert_array_equal(velocities, [[1, 0, 0]] * 5)


def test_a_walk_between_equal_positions_stands():
    users = np.array([[6.0, 0, 0]])
    paths = PathChannel(users, np.full((1, 1), 1e-4 + 0j), users[:, None],
                        np.zeros((1, 1), int), 2.75e9)
    walk = mobility.RandomWalk(Scenario(channel=paths), 1.0, np.random.default_rng(0))
    positions, velocities = track(walk, [0.0, 0.4, 5.0])
    np.testing.assert_array_equal(positions, users[[0, 0, 0]])
    np.testing.assert_array_equal(velocities, np.zeros((3, 3)))


@pytest.mark.parametrize('make', [
    lambda: mobility.Static((7, -1, 0)),
    lambda: mobility.Waypoints(SQUARE, 0.0), lambda: mobility.Waypoints(SQUARE[:1], 2.0),
    lambda: mobility.RandomWalk(Scenario(), 0.0, np.random.default_rng(0)),
], ids=['static', 'waypoints', 'one waypoint', 'random_walk'])
def test_users_without_speed_do_not_move(make):
    moves = make()
    positions, velocities = track(moves, [0.0, 5.0, 50.0])
    assert (positions == positions[0]).all()
    assert (velocities == 0).all()


def test_waypoints_form_a_closed_polygon():
    moves = mobility.Waypoints(SQUARE, 0.5)
    seconds = np.array([0, 2, 4, 7, 10, 12, 14, 17, 20, 24])
    positions, velocities = track(moves, START_S + seconds)
    np.testing.assert_allclose(positions, [
        (6, 0, 0), (7, 0, 0), (8, 0, 0), (8, 1.5, 0), (8, 3, 0), (7, 3, 0), (6, 3, 0),
        (6, 1.5, 0), (6, 0, 0), (8, 0, 0)], atol=1e-9)
    along = {'+x': (0.5, 0, 0), '+y': (0, 0.5, 0), '-x': (-0.5, 0, 0), '-y': (0, -0.5, 0)}
    names = ['+x', '+x', '+y', '+y', '-x', '-x', '-y', '-y', '+x', '+y']
    np.testing.assert_allclose(velocities, [along[name] for name in names], atol=1e-12)


def moving_users():
    yield 'waypoints', lambda: mobility.Waypoints(SQUARE, 1.5)
    for seed in range(3):
        yield f'walk {seed}', lambda seed=seed: mobility.RandomWalk(
            Scenario(), 1.5, np.random.default_rng(seed))


@pytest.mark.parametrize(
    'make', [m for _, m in moving_users()], ids=[name for name, _ in moving_users()])
def test_speed_is_constant_and_paths_are_continuous(make):
    step_s = 0.05
    positions, velocities = track(make(), START_S + np.arange(4000) * step_s)
    np.testing.assert_allclose(np.linalg.norm(velocities, axis=1), 1.5)
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    assert steps.max() <= 1.5 * step_s * (1 + 1e-6)
    # Steps are shorter only at corners.
    full = np.isclose(steps, 1.5 * step_s, rtol=1e-6)
    assert full.mean() > 0.95
    assert not full.all()
    straight = (velocities[1:] == velocities[:-1]).all(axis=1)
    np.testing.assert_allclose(
        np.diff(positions, axis=0)[straight], velocities[1:][straight] * step_s, atol=1e-8)


@pytest.mark.parametrize('seed', range(2))
def test_a_walk_stays_in_the_region_and_crosses_it(seed):
    scenario = Scenario(roi_center_m=(4, 1, -2), roi_size_m=(2, 6, 1))
    walk = mobility.RandomWalk(scenario, 2.0, np.random.default_rng(seed))
    positions, _ = track(walk, np.arange(0, 2000, 0.5))
    low, high = scenario.roi_bounds_m
    assert (positions >= low - 1e-9).all()
    assert (positions <= high + 1e-9).all()
    assert (np.ptp(positions, axis=0) > 0.8 * (high - low)).all()


def test_a_walk_begins_at_the_given_position():
    walk = mobility.RandomWalk(Scenario(), 1.0, np.random.default_rng(0), (6.0, 2.0, 0.1))
    np.testing.assert_array_equal(walk.state(START_S)[0], (6, 2, 0.1))
    assert np.linalg.norm(walk.state(START_S + 1.0)[0] - (6, 2, 0.1)) > 0.1


def test_a_walk_does_not_depend_on_the_times_of_the_calls():
    scenario = Scenario()
    often = mobility.RandomWalk(scenario, 1.5, np.random.default_rng(3))
    rarely = mobility.RandomWalk(scenario, 1.5, np.random.default_rng(3))
    often_at = track(often, np.arange(0, 300, 0.5))[0][::200]
    rarely_at = track(rarely, np.arange(0, 300, 100.0))[0]
    np.testing.assert_allclose(often_at, rarely_at, atol=1e-9)


def test_a_walk_continues_after_a_jump_of_the_clock():
    scenario = Scenario()
    walk = mobility.RandomWalk(scenario, 1.0, np.random.default_rng(0))
    positions, velocities = track(walk, [0.0, 1.8e9, 1.8e9 + 1])
    low, high = scenario.roi_bounds_m
    assert ((positions >= low) & (positions <= high)).all()
    np.testing.assert_allclose(np.linalg.norm(velocities, axis=1), 1.0)


def test_a_crowd_has_the_states_of_its_users():
    """Walkers, who begin legs at different times, and users of other kinds in between."""
    def users():
        walks = [mobility.RandomWalk(Scenario(), speed, np.random.default_rng(n))
                 for n, speed in enumerate((0.0, 0.8, 3.0, 50.0))]
        return [*walks, mobility.Static((7, -1, 0)), mobility.Waypoints(SQUARE, 2.0), Jump(),
                Steps()]

    class Jump:
        """The mobility of another package."""

        def state(self, now_s):
            return np.array([8.0, np.floor(now_s), 0.0]), np.zeros(3)

    class Steps(Jump):
        """The mobility of another package, which returns its legs as plain tuples."""

        def leg(self, now_s):
            return *self.state(now_s), np.floor(now_s), np.floor(now_s) + 1

    alone, crowd = users(), mobility.Crowd(users())
    for now_s in np.random.default_rng(1).exponential(0.7, 60).cumsum():
        position, velocity = crowd.states(now_s)
        expected = [user.state(now_s) for user in alone]
        np.testing.assert_array_equal(position, [state[0] for state in expected])
        np.testing.assert_array_equal(velocity, [state[1] for state in expected])
        position += 1
        velocity += 1


def test_states_of_a_crowd_and_of_its_users_may_alternate():
    users = [mobility.RandomWalk(Scenario(), 40.0, np.random.default_rng(n)) for n in range(5)]
    crowd = mobility.Crowd(users)
    for now_s in np.arange(0, 3, 0.05):
        single = users[2].state(now_s)
        for part, one in zip(crowd.states(now_s), single, strict=True):
            np.testing.assert_array_equal(part[2], one)


@pytest.mark.parametrize('bad_s', [np.nan, np.inf, -np.inf, 1j])
@pytest.mark.parametrize('make', [
    lambda: mobility.Static(SQUARE[0]), lambda: mobility.Waypoints(SQUARE, 1.0),
    lambda: mobility.RandomWalk(Scenario(), 1.0, np.random.default_rng(0)),
    lambda: mobility.Crowd([mobility.RandomWalk(Scenario(), 1.0, np.random.default_rng(0))])])
def test_a_time_that_is_not_finite_is_an_error_and_changes_nothing(make, bad_s):
    moves, others = make(), make()
    state, expected = (getattr(one, 'states', None) or one.state for one in (moves, others))
    for time_s in (0.0, 1.0, 40.0):
        with pytest.raises(ValueError, match='^now_s: .*expected'):
            state(bad_s)
        np.testing.assert_array_equal(state(time_s), expected(time_s))


@pytest.mark.parametrize('speed_mps', [np.inf, -1.0])
@pytest.mark.parametrize('make', [
    lambda speed: mobility.Waypoints(SQUARE, speed),
    lambda speed: mobility.RandomWalk(Scenario(), speed, np.random.default_rng(0))])
def test_an_invalid_speed_is_an_error(make, speed_mps):
    with pytest.raises(ValueError, match='^speed_mps: .*, expected'):
        make(speed_mps)
