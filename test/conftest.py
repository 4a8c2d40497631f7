"""Fixtures that all tests share, and the paper's equations written out index by index."""

import contextlib
import gc
import importlib.util
import resource
import signal
import subprocess
import sys
import sysconfig
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

import hypothesis
import numpy as np
import pytest

from rhs_isac_ros.codebook import Codebook
from rhs_isac_ros.model import Scenario

# Fixtures that several folders share. Processes and nodes need ROS; the pure layers do not.
pytest_plugins = ['in_memory_network']
if importlib.util.find_spec('rclpy'):
    pytest_plugins += ['node_bench', 'node_processes']
HERE = Path(__file__).resolve().parent
# A session without a terminal may ignore it, and the processes of the tests would inherit this.
signal.signal(signal.SIGHUP, signal.SIG_DFL)
LIBRARIES = ('numpy', 'scipy', 'scikit-learn', 'matplotlib', 'pyyaml', 'joblib', 'dask', 'rich')

# The profile quick uses the same examples in every run; thorough uses many more, which differ from
# run to run.
hypothesis.settings.register_profile(
    'quick', max_examples=75, derandomize=True, database=None, deadline=None)
hypothesis.settings.register_profile(
    'thorough', max_examples=5000, database=None, deadline=None, print_blob=True,
    suppress_health_check=[hypothesis.HealthCheck.too_slow])


def pytest_addoption(parser):
    parser.addoption('--thorough', action='store_true',
                     help='test each property on 5000 random examples instead of 75 fixed ones')
    parser.addoption('--first-cases', action='store_true',
                     help='run the first case of each test that has several')


def pytest_configure(config):
    thorough = config.getoption('thorough')
    hypothesis.settings.load_profile('thorough' if thorough else 'quick')


# After the options that select tests.
@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config, items):
    if config.getoption('first_cases'):
        first: dict[str, pytest.Item] = {}
        for item in items:
            first.setdefault(item.nodeid.partition('[')[0], item)
        items[:] = first.values()


def pytest_collection():
    # Modules and tests remain: a search for garbage among them finds none.
    gc.disable()


def pytest_collection_finish():
    # Later searches then ignore them, so they are fast.
    gc.collect()
    gc.freeze()
    gc.enable()


def pytest_report_header():
    """Return the versions of the libraries that the package imports."""
    found = []
    for name in LIBRARIES:
        with contextlib.suppress(metadata.PackageNotFoundError):
            found.append(f'{name} {metadata.version(name)}')
    return f'libraries: {", ".join(found)}'


class Case(NamedTuple):
    """A scenario with reference values that were computed independently."""

    scenario: Scenario
    codebook: Codebook
    vectors: dict[str, np.ndarray]


def load_case(name: str) -> Case:
    with np.load(HERE / 'data' / f'{name}.npz') as archive:
        vectors = dict(archive)
    case = {key.removeprefix('case_'): vectors[key] for key in vectors if key.startswith('case_')}
    bands = np.arange(case['n_bands'])
    scenario = Scenario(
        center_frequencies_hz=case['first_center_hz'] + bands * case['band_spacing_hz'],
        n_subbands=int(case['n_subbands']), subband_width_hz=case['subband_hz'],
        n_frames=int(case['n_frames']), frame_duration_s=case['frame_s'],
        elements_per_side=int(case['side']),
        element_interval_wavelengths=case['spacing_wavelengths'], n_feeds=int(case['n_feeds']),
        refractive_index=case['n_r'], delay_spread_s=case['delay_spread_s'],
        max_user_speed_mps=case['vmax_mps'], angular_spread_deg=case['spread_deg'],
        noise_psd_dbm_hz=case['noise_dbm_hz'], max_power_w=case['power_w'],
        roi_center_m=case['roi_center'], roi_size_m=case['roi_size'])
    return Case(scenario, Codebook(vectors['analog'], vectors['digital']), vectors)


@pytest.fixture(scope='session')
def table1() -> Case:
    return load_case('table1')


@pytest.fixture(scope='session', autouse=True)
def own_cache(tmp_path_factory):
    """Set the cache folder of nodes and child processes to a temporary directory."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv('XDG_CACHE_HOME', str(tmp_path_factory.mktemp('cache')))
        yield


@pytest.fixture(scope='session', autouse=True)
def right_hand_sides():
    """Refuse those that NumPy 1.26 and 2 read differently, as vectors of a stack or a matrix."""
    solve = np.linalg.solve

    def checked(a, b):
        assert (np.ndim(b) == 1) == (np.ndim(b) == np.ndim(a) - 1), (np.shape(a), np.shape(b))
        return solve(a, b)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(np.linalg, 'solve', checked)
        yield


@pytest.fixture(scope='session')
def built_scripts():
    """Skip the test if the scripts have no build, as in a colcon workspace.

    Under ``scripts/test``, they have one.
    """
    done = subprocess.run(['bash', '-c', '. scripts/env.sh'], cwd=HERE.parent,
                          capture_output=True, text=True, timeout=240, check=False)
    if done.returncode:
        pytest.skip(f'a test of the scripts: {done.stderr.strip()}')


@pytest.fixture(autouse=True)
def signal_handlers():
    """Restore the signal handlers after the test, because an executable changes them."""
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = {number: signal.getsignal(number) for number in numbers}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture(scope='session')
def small() -> Case:
    return load_case('small')


@pytest.fixture(scope='session', params=['small', 'table1'])
def case(request) -> Case:
    return request.getfixturevalue(request.param)


@pytest.fixture(scope='session')
def shipped() -> Codebook:
    """The codebook that the package ships."""
    return Codebook.load(HERE.parent / 'config' / 'codebook.yaml')


@pytest.fixture(scope='session')
def random_beams():
    """Function that returns a codebook with random phases and amplitudes for a scenario."""
    def make(scenario: Scenario, rng: np.random.Generator) -> Codebook:
        sizes = scenario.sizes
        digital = rng.normal(size=(*(sizes[s] for s in ('N_B', 'N_SB', 'F', 'K')), 2)) @ [1, 1j]
        power = np.sum(np.abs(digital)**2, axis=(1, 3), keepdims=True)
        digital *= np.sqrt(scenario.max_power_w / power)
        analog = rng.uniform(size=(sizes['N_B'], sizes['F'], sizes['N_E']))
        return Codebook(analog, digital)
    return make


class Plain:
    """The model in the notation of the paper, one index at a time; indices count from 0.

    Uses only the fields of the scenario, none of its methods. Positions may have leading axes.
    """

    light = 299_792_458.0

    def __init__(self, scenario, analog=None, digital=None):
        self.scenario, self.analog, self.digital = scenario, analog, digital
        self.rows = [(j, q) for j in range(scenario.n_subbands) for q in range(scenario.n_frames)]
        wavelengths = [self.light / f for f in scenario.center_frequencies_hz]
        self.patterns = {}
        # Along y and z.
        self.intervals = sum(wavelengths) / len(wavelengths) * np.array(
            scenario.element_interval_wavelengths) * np.ones(2)

    def frequency(self, i, j):
        s = self.scenario
        return s.center_frequencies_hz[i] + (j + 1 - (s.n_subbands + 1) / 2) * s.subband_width_hz

    def element(self, m):
        columns, rows = self.scenario.n_columns, self.scenario.n_rows
        y, z = m % columns - (columns - 1) / 2, m // columns - (rows - 1) / 2
        return np.array([0, y * self.intervals[0], z * self.intervals[1]])

    def feed(self, k):
        s = self.scenario
        if s.feed_positions_m is not None:
            return np.array(s.feed_positions_m[k])
        board = s.n_columns * self.intervals[0]
        return np.array([0, ((k + 0.5) / s.n_feeds - 0.5) * board, 0])

    def los(self, position, i, j, m):
        s, f = self.scenario, self.frequency(i, j)
        distance = np.sqrt(np.sum((position - self.element(m))**2, axis=-1))
        return (self.light * s.element_gain * s.user_gain / (4 * np.pi * f * distance)
                * np.exp(-2j * np.pi * f / self.light * distance))

    def los_slope(self, position, i, j, m):
        """Derivative of `los` with respect to the coordinates, on a new last axis."""
        offset = position - self.element(m)
        distance = np.sqrt(np.sum(offset**2, axis=-1))
        rate = -2j * np.pi * self.frequency(i, j) / self.light - 1 / distance
        return (self.los(position, i, j, m) * rate / distance)[..., None] * offset

    def kappa(self, f, source, sink):
        path = np.sqrt(sum((a - b)**2 for a, b in zip(sink, source, strict=True)))
        return np.exp(-2j * np.pi * self.scenario.refractive_index * f / self.light * path)

    def onboard(self, i, j, k, m):
        return self.kappa(self.frequency(i, j), self.element(m), self.feed(k))

    def weight(self, i, j, q, m):
        """Entry of T_i: element m in sub-band j and frame q."""
        feeds = range(self.scenario.n_feeds)
        return self.analog[i, q, m] * sum(
            self.digital[i, j, q, k] * self.onboard(i, j, k, m) for k in feeds)

    def pattern(self, i):
        if i not in self.patterns:
            elements = range(self.scenario.n_elements)
            self.patterns[i] = np.array(
                [[self.weight(i, j, q, m) for m in elements] for j, q in self.rows])
        return self.patterns[i]

    def mean(self, position, i):
        """Mean signals of a band, [..., N_SB F]."""
        pattern, elements = self.pattern(i), range(self.scenario.n_elements)
        gains = {(j, m): self.los(position, i, j, m)
                 for j in range(self.scenario.n_subbands) for m in elements}
        return np.stack([sum(pattern[r, m] * gains[j, m] for m in elements)
                         for r, (j, _) in enumerate(self.rows)], axis=-1)

    def mean_slope(self, position, i):
        """Derivative of `mean` with respect to the coordinates, [..., N_SB F, 3]."""
        pattern, elements = self.pattern(i), range(self.scenario.n_elements)
        slopes = {(j, m): self.los_slope(position, i, j, m)
                  for j in range(self.scenario.n_subbands) for m in elements}
        return np.stack([sum(pattern[r, m] * slopes[j, m] for m in elements)
                         for r, (j, _) in enumerate(self.rows)], axis=-2)

    def rho_f(self, i, j1, j2):
        s = self.scenario
        difference = self.frequency(i, j1) - self.frequency(i, j2)
        return 1 / (1 + 2j * np.pi * s.delay_spread_s * difference)

    def rho_t(self, i, q1, q2):
        """J_0 by Bessel's integral; the mean over equidistant points is exact up to rounding."""
        s = self.scenario
        doppler = s.max_user_speed_mps * s.center_frequencies_hz[i] / self.light
        argument = 2 * np.pi * doppler * (q1 - q2) * s.frame_duration_s
        turns = (np.arange(4000) + 0.5) / 4000 * np.pi
        return np.mean(np.cos(argument * np.sin(turns)))

    def covariance(self, i, spatial):
        """Covariance of a band's signals, given V_i."""
        s, pattern = self.scenario, self.pattern(i)
        noise = 10**(s.noise_psd_dbm_hz / 10) / 1000 * s.subband_width_hz
        size = len(self.rows)
        result = np.zeros((size, size), complex)
        for a, (j1, q1) in enumerate(self.rows):
            for b, (j2, q2) in enumerate(self.rows):
                scattered = pattern[a] @ spatial @ pattern[b].conj()
                result[a, b] = self.rho_f(i, j1, j2) * self.rho_t(i, q1, q2) * scattered
            result[a, a] += noise
        return result

    def information(self, position, spatial):
        """Fisher information at one position [3], given V of every band."""
        result = np.zeros((3, 3))
        for i in range(self.scenario.n_bands):
            slope = self.mean_slope(position, i)
            inverse = np.linalg.inv(self.covariance(i, spatial[i]))
            for u in range(3):
                for v in range(3):
                    result[u, v] += 2 * (slope[:, u].conj() @ inverse @ slope[:, v]).real
        return result

    def crlb(self, positions, spatial):
        return np.array([np.trace(np.linalg.inv(self.information(p, spatial))) for p in positions])


@pytest.fixture(scope='session')
def plain() -> type[Plain]:
    return Plain


@pytest.fixture(scope='session')
def table1_estimator(shipped):
    """The default estimator for Table I and the shipped codebook."""
    from rhs_isac_ros.positioning import make_estimator
    return make_estimator('bayes', Scenario(), shipped)


@pytest.fixture(autouse=True, scope='session')
def without_installed_plugins():
    """Hide plug-ins that are installed in the environment, which are not part of the tests."""
    find, home = metadata.entry_points, Path(sysconfig.get_path('purelib'))

    def entry_points(**chosen):
        found = find(**chosen)
        if not chosen.get('group', '').startswith('rhs_isac_ros.'):
            return found
        return type(found)(
            point for point in found if Path(point.dist.locate_file('')) != home)
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr(metadata, 'entry_points', entry_points)
        yield


@pytest.fixture
def install(tmp_path, monkeypatch):
    """Function that installs a package with one module, and the metadata that pip would write."""
    def install(package: str, code: str, points: dict[str, dict[str, str]]) -> Path:
        """Take code and objects of the module by group and name; return its folder."""
        folder = tmp_path / 'site'
        info = folder / f'{package}-1.0.dist-info'
        info.mkdir(parents=True)
        (folder / f'{package}.py').write_text(code, encoding='utf-8')
        (info / 'METADATA').write_text(
            f'Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n', encoding='utf-8')
        (info / 'entry_points.txt').write_text(''.join(
            f'[{group}]\n' + ''.join(f'{name} = {package}:{what}\n'
                                     for name, what in names.items())
            for group, names in points.items()), encoding='utf-8')
        monkeypatch.syspath_prepend(folder)
        monkeypatch.delitem(sys.modules, package, raising=False)
        return folder
    return install


@contextlib.contextmanager
def file_sizes(n_bytes):
    """Limit the files that this process and its children write, as a full disk does."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (n_bytes, before[1]))
    try:
        yield
    finally:
        # Otherwise, pytest cannot print its report to a file.
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.fixture
def two_folds(monkeypatch):
    """Two instead of five groups of pilots are left out: each is a survey, which takes long."""
    monkeypatch.setattr('rhs_isac_ros.experiments.pilots._N_FOLDS', 2)


@pytest.fixture
def full_disk():
    """Context manager in which files can have only a number of bytes."""
    return file_sizes
