"""Products with rows, exact and compressed."""

import tracemalloc

import numpy as np
import pytest

from rhs_isac_ros.bounds import compressed_rows, factor, rows
from rhs_isac_ros.bounds.compressed_rows import CompressedRows
from rhs_isac_ros.bounds.rows import ExactRows
from rhs_isac_ros.model import Scenario, measurement
from rhs_isac_ros.model.los import los_derivative, los_gain

N_ITEMS = 60
DIMENSIONS = 144


def complex_array(rng, *shape):
    return rng.normal(size=(*shape, 2)) @ [1, 1j]


@pytest.fixture(scope='module')
def wide():
    """Two bands of 144 dimensions each, of which a near region needs many."""
    return Scenario(
        center_frequencies_hz=(1.2e9, 3.1e9), n_subbands=4, n_frames=3, n_feeds=2,
        elements_per_side=6, subband_width_hz=5e6, frame_duration_s=1e-3, noise_psd_dbm_hz=-130,
        roi_center_m=(2, 0, 0), roi_size_m=(2, 4, 2))


@pytest.fixture(scope='module')
def factors(wide, random_beams):
    return factor(wide, random_beams(wide, np.random.default_rng(0)))


@pytest.fixture(scope='module', params=['derivatives', 'differences'])
def items(request, wide):
    """All rows, complex [N_ITEMS, G, N_B, N_SB, N_E], with three rows an item or one."""
    firsts, seconds = wide.sample_positions(
        2 * N_ITEMS, np.random.default_rng(1)).reshape(2, -1, 3)
    if request.param == 'derivatives':
        return np.stack([los_derivative(wide, firsts, i) for i in range(2)], axis=2)
    return np.stack(
        [(los_gain(wide, firsts, i) - los_gain(wide, seconds, i))[:, None] for i in range(2)],
        axis=2)


def source_of(items):
    return lambda start, stop, band: items[start:stop, :, band].copy()


def make(scenario, items, tolerance=0.0):
    arguments = scenario, source_of(items), len(items), items.shape[1]
    return CompressedRows(*arguments, tolerance) if tolerance else ExactRows(*arguments)


def evaluate(some_rows, factors, n_rows, seed=2):
    """Whitened means of all items, band after band, and what random weights collect."""
    ongoing, rng = some_rows.begin(*factors), np.random.default_rng(seed)
    bands = range(len(factors[0]))
    whitened = [[] for _ in bands]
    for block in rows.blocks(some_rows.n_items):
        weights = rng.normal(size=(block.stop - block.start, n_rows, n_rows))
        for band in bands:
            whitened[band].append(ongoing.whitened(block, band).copy())
        for band in bands:
            ongoing.collect(block, band, weights @ whitened[band][-1])
    return [np.concatenate(parts) for parts in whitened], [*map(ongoing.collected, bands)]


def plain_evaluation(scenario, items, factors, seed=2):
    """The same by the definitions."""
    n_items, n_rows = items.shape[:2]
    weights = np.random.default_rng(seed).normal(size=(n_items, n_rows, n_rows))
    whitened, collected = [], []
    for band, (pattern, whitener) in enumerate(zip(*factors, strict=True)):
        frames = pattern.reshape(scenario.n_subbands, -1, scenario.n_elements)
        means = np.einsum('jqm,ngjm->ngjq', frames, items[:, :, band]).reshape(n_items, n_rows, -1)
        inverse = whitener.conj().T @ whitener
        zeta = np.einsum('ab,ngb->nga', inverse, means)
        w = np.einsum('ngh,nha->nga', weights, zeta)
        by_mean = np.einsum('ngjq,ngjm->jqm', w.reshape(*w.shape[:2], scenario.n_subbands, -1),
                            items[:, :, band].conj())
        whitened.append(np.einsum('ab,ngb->nga', whitener, means))
        collected.append((by_mean.reshape(pattern.shape),
                          np.einsum('nga,ngb->ab', w, zeta.conj())))
    return whitened, collected


def recovered(some_rows, scenario):
    """The rows themselves: what patterns of single elements make of them, not whitened."""
    size = scenario.n_subbands * scenario.n_elements
    patterns = np.tile(np.eye(scenario.n_elements, dtype=complex), (scenario.n_subbands, 1))
    ongoing = some_rows.begin(
        np.stack([patterns] * scenario.n_bands),
        np.stack([np.eye(size, dtype=complex)] * scenario.n_bands))
    blocks = list(rows.blocks(some_rows.n_items))
    bands = [np.concatenate([ongoing.whitened(block, i) for block in blocks])
             for i in range(scenario.n_bands)]
    whole = np.stack(bands, axis=2)
    return whole.reshape(*whole.shape[:3], scenario.n_subbands, scenario.n_elements)


def relative_errors(some_rows, scenario, items):
    """Root mean square, in each band, of the relative errors of the rows that are not zero."""
    norms = np.linalg.norm(items, axis=(3, 4))
    errors = np.linalg.norm(recovered(some_rows, scenario) - items, axis=(3, 4))
    relative = np.where(norms > 0, errors, 0) / np.where(norms > 0, norms, 1)
    return np.sqrt(np.sum(relative**2, axis=(0, 1)) / np.sum(norms > 0, axis=(0, 1)))


def least_ranks(items, tolerance):
    """The fewest dimensions that reach the tolerance, by singular values."""
    ranks = []
    for band in range(items.shape[2]):
        flat = items[:, :, band].reshape(-1, DIMENSIONS)
        unit = flat / np.linalg.norm(flat, axis=1, keepdims=True)
        tails = np.cumsum(np.linalg.svd(unit, compute_uv=False)[::-1]**2)[::-1] / len(unit)
        ranks.append(int(np.sum(tails > tolerance**2)))
    return ranks


def assert_near(actual, expected, tolerance):
    assert actual.shape == expected.shape
    assert np.linalg.norm(actual - expected) <= tolerance * np.linalg.norm(expected)


def assert_same(first, second, tolerance):
    for a, b in zip(first[0], second[0], strict=True):
        assert_near(a, b, tolerance)
    for one, other in zip(first[1], second[1], strict=True):
        for a, b in zip(one, other, strict=True):
            assert_near(a, b, tolerance)


def test_exact_passes_are_the_plain_ones(wide, items, factors, monkeypatch):
    monkeypatch.setattr(rows, '_BLOCK', 16)
    assert_same(evaluate(make(wide, items), factors, items.shape[1]),
                plain_evaluation(wide, items, factors), 1e-12)


@pytest.mark.parametrize('tolerance', [1e-7, 1e-5, 1e-3])
def test_compressed_passes_are_the_exact_ones_to_the_tolerance(
        wide, items, factors, monkeypatch, tolerance):
    monkeypatch.setattr(rows, '_BLOCK', 16)
    compressed = evaluate(make(wide, items, tolerance), factors, items.shape[1])
    assert_same(compressed, plain_evaluation(wide, items, factors), 10 * tolerance)
    assert_same(compressed, evaluate(make(wide, items), factors, items.shape[1]), 10 * tolerance)


def test_means_are_whitened_with_the_covariance(wide, factors):
    """Signals with the columns of L as their means come out as unit vectors."""
    covariances = measurement.covariance(wide, factors.patterns)
    lower = np.linalg.cholesky(covariances)
    items = np.stack([
        (np.linalg.pinv(block_diagonal(wide, pattern)) @ half).T
        for pattern, half in zip(factors.patterns, lower, strict=True)], axis=1)
    items = items.reshape(-1, 1, 2, wide.n_subbands, wide.n_elements)
    for some_rows in (make(wide, items), make(wide, items, 1e-7)):
        for whitened in evaluate(some_rows, factors, 1)[0]:
            np.testing.assert_allclose(
                whitened[:, 0], np.eye(len(whitened)), rtol=0, atol=1e-5)


def block_diagonal(scenario, pattern):
    """What makes means of flat rows, [N_SB F, N_SB N_E]."""
    frames = pattern.reshape(scenario.n_subbands, -1, scenario.n_elements)
    result = np.zeros((*frames.shape[:2], *frames.shape[::2]), complex)
    for j in range(scenario.n_subbands):
        result[j, :, j] = frames[j]
    return result.reshape(len(pattern), -1)


@pytest.mark.parametrize('tolerance', [1e-7, 1e-6, 1e-4, 1e-2, 0.3])
def test_the_tolerance_is_held_with_hardly_more_dimensions_than_needed(
        wide, items, tolerance):
    compressed = make(wide, items, tolerance)
    errors = relative_errors(compressed, wide, items)
    # At the least tolerance rounding shows.
    assert (errors <= 1.01 * tolerance).all()
    assert len(compressed.ranks) == 2
    for rank, least in zip(compressed.ranks, least_ranks(items, tolerance), strict=True):
        assert least <= rank <= least + 1 or (tolerance < 1e-6 and least - 2 <= rank <= least + 3)


def test_a_looser_tolerance_needs_fewer_dimensions(wide, items):
    ranks = [make(wide, items, t).ranks for t in (1e-3, 1e-2, 0.1, 0.5)]
    for tight, loose in zip(ranks, ranks[1:], strict=False):
        assert all(a > b for a, b in zip(tight, loose, strict=True))


def test_rows_of_any_size_count_by_their_direction(wide, items):
    sizes = 10.0**np.random.default_rng(3).uniform(-9, 9, items.shape[:2])
    scaled = items * sizes[:, :, None, None, None]
    compressed = make(wide, scaled, 1e-4)
    assert (relative_errors(compressed, wide, scaled) <= 1e-4).all()
    for rank, least in zip(compressed.ranks, least_ranks(items, 1e-4), strict=True):
        assert least <= rank <= least + 1


@pytest.mark.parametrize('n_items', [1, 2, 7])
def test_few_rows_need_no_more_dimensions_than_they_are(wide, items, factors, n_items):
    few = items[:n_items]
    assert few.shape[0] * few.shape[1] < compressed_rows._SKETCH
    compressed = make(wide, few, 1e-6)
    assert max(compressed.ranks) <= few.shape[0] * few.shape[1]
    assert (relative_errors(compressed, wide, few) <= 1e-6).all()
    assert_same(evaluate(compressed, factors, few.shape[1]),
                plain_evaluation(wide, few, factors), 1e-5)


@pytest.fixture
def sizes(monkeypatch):
    """Columns of the sketches that are made, in their order."""
    original, made = compressed_rows._sketch, []

    def record(*args):
        made.append(args[-1])
        return original(*args)

    monkeypatch.setattr(compressed_rows, '_sketch', record)
    return made


def test_a_sketch_that_is_too_small_grows_until_it_suffices(
        wide, items, factors, monkeypatch, sizes):
    tolerance = 1e-4
    expected = make(wide, items, tolerance)
    assert sizes == [min(128, items.shape[0] * items.shape[1])] * 2
    sizes.clear()
    monkeypatch.setattr(compressed_rows, '_first_sketch', lambda scenario: 2)
    grown = make(wide, items, tolerance)
    firsts = [k for k, size in enumerate(sizes) if size == 2]
    assert len(firsts) == 2
    for made, least in zip((sizes[:firsts[1]], sizes[firsts[1]:]),
                           least_ranks(items, tolerance), strict=True):
        n_total = items.shape[0] * items.shape[1]
        assert made == [min(2 << k, n_total) for k in range(len(made))]
        assert len(made) > 2
        # The last but one could not hold it.
        assert made[-2] < least + 1 <= made[-1] + 1
    assert (relative_errors(grown, wide, items) <= tolerance).all()
    assert_same(evaluate(grown, factors, items.shape[1]),
                evaluate(expected, factors, items.shape[1]), 10 * tolerance)


@pytest.mark.parametrize(('n_items', 'rank'), [(5, 10), (64, 128), (71, 142), (200, DIMENSIONS)])
def test_rows_without_structure_keep_all_their_dimensions(wide, factors, sizes, n_items, rank):
    """As many as there are rows, or as the space has; the sketch ends there, too."""
    items = complex_array(np.random.default_rng(4), n_items, 2, 2, 4, 36)
    compressed = make(wide, items, 1e-6)
    assert compressed.ranks == (rank, rank)
    assert len(sizes) <= 4
    assert (relative_errors(compressed, wide, items) < 1e-12).all()
    assert_same(evaluate(compressed, factors, 2), plain_evaluation(wide, items, factors), 1e-11)


def test_rows_that_are_zero_stay_so_and_do_not_count(wide, items, factors):
    some = items.copy()
    some[::3] = 0
    some[1, 0, 1] = 0
    compressed = make(wide, some, 1e-4)
    assert (relative_errors(compressed, wide, some) <= 1e-4).all()
    np.testing.assert_array_equal(recovered(compressed, wide)[::3], 0)
    assert_same(evaluate(compressed, factors, some.shape[1]),
                plain_evaluation(wide, some, factors), 1e-3)
    others = items[np.arange(N_ITEMS) % 3 > 0]
    for rank, least in zip(compressed.ranks, least_ranks(others, 1e-4), strict=True):
        assert abs(rank - least) <= 1


@pytest.mark.parametrize('n_items', [1, 40, 200])
def test_only_zeros_give_only_zeros(wide, factors, n_items):
    items = np.zeros((n_items, 1, 2, 4, 36), complex)
    for some_rows in (make(wide, items), make(wide, items, 1e-5)):
        whitened, collected = evaluate(some_rows, factors, 1)
        for band in range(2):
            assert whitened[band].shape == (n_items, 1, 12)
            np.testing.assert_array_equal(whitened[band], 0)
            np.testing.assert_array_equal(collected[band].by_mean, np.zeros((12, 36)))
            np.testing.assert_array_equal(collected[band].spread, np.zeros((12, 12)))


@pytest.mark.parametrize('tolerance', [
    0.0, np.nextafter(compressed_rows.MIN_TOLERANCE, 0), 1e-300, -1.0, 1.0, np.inf, -np.inf,
    np.nan])
def test_a_tolerance_that_cannot_be_held_is_an_error(wide, items, tolerance):
    with pytest.raises(ValueError, match='^tolerance: .*, expected 1e-07 to 1, or 0 '):
        CompressedRows(wide, source_of(items), len(items), items.shape[1], tolerance)


@pytest.mark.parametrize('tolerance', [0, 1e-5], ids=['exact', 'compressed'])
def test_the_same_rows_give_the_same_bits_again(wide, items, factors, tolerance):
    first, second = make(wide, items, tolerance), make(wide, items, tolerance)
    outcomes = [evaluate(each, factors, items.shape[1]) for each in (first, second, first)]
    for outcome in outcomes[1:]:
        assert_same(outcome, outcomes[0], 0)


@pytest.mark.parametrize('tolerance', [0, 1e-5], ids=['exact', 'compressed'])
def test_passes_with_other_patterns_do_not_disturb_each_other(
        wide, items, factors, random_beams, tolerance):
    some_rows = make(wide, items, tolerance)
    others = factor(wide, random_beams(wide, np.random.default_rng(5)))
    expected = evaluate(some_rows, factors, items.shape[1])
    first, second = some_rows.begin(*factors), some_rows.begin(*others)
    rng = np.random.default_rng(2)
    for block in rows.blocks(some_rows.n_items):
        weights = rng.normal(size=(block.stop - block.start, *[items.shape[1]] * 2))
        for band in range(2):
            part = first.whitened(block, band).copy()
            other = second.whitened(block, band)
            second.collect(block, band, weights @ other)
            first.collect(block, band, weights @ part)
    for band in range(2):
        for actual, wanted in zip(first.collected(band), expected[1][band], strict=True):
            assert_near(actual, wanted, 1e-13)


@pytest.mark.parametrize('size', [1, 7, 30, 60, 100])
def test_results_do_not_depend_on_the_blocks(wide, items, factors, monkeypatch, size):
    expected = plain_evaluation(wide, items, factors)
    monkeypatch.setattr(rows, '_BLOCK', size)
    for some_rows, tolerance in ((make(wide, items), 1e-12), (make(wide, items, 1e-6), 1e-5)):
        covered = [n for block in rows.blocks(some_rows.n_items) for n in range(N_ITEMS)[block]]
        assert covered == list(range(N_ITEMS))
        lengths = [block.stop - block.start for block in rows.blocks(some_rows.n_items)]
        assert lengths[:-1] == [size] * (len(lengths) - 1)
        assert_same(evaluate(some_rows, factors, items.shape[1]), expected, tolerance)


class Counted:
    def __init__(self, items):
        self.items, self.calls = items, []

    def __call__(self, start, stop, band):
        self.calls.append((start, stop, band))
        return self.items[start:stop, :, band].copy()


@pytest.mark.parametrize(('spare', 'kept'), [(0, True), (-1, False)], ids=['fits', 'too large'])
def test_exact_rows_are_kept_only_within_the_memory_limit(
        wide, items, factors, monkeypatch, spare, kept):
    monkeypatch.setattr(rows, '_CACHE_BYTES', items.nbytes + spare)
    monkeypatch.setattr(rows, '_BLOCK', 25)
    source = Counted(items)
    some_rows = ExactRows(wide, source, N_ITEMS, items.shape[1])
    every = {(start, stop, band) for start, stop in ((0, 25), (25, 50), (50, 60))
             for band in range(2)}
    expected = plain_evaluation(wide, items, factors)
    for evaluation in range(2):
        source.calls.clear()
        assert_same(evaluate(some_rows, factors, items.shape[1]), expected, 1e-12)
        if kept:
            assert sorted(source.calls) == ([] if evaluation else sorted(every))
        else:
            assert set(source.calls) == every


def test_rows_that_are_not_kept_are_given_back(wide, items, factors, monkeypatch):
    """What is held after an evaluation is hardly more than one block of six."""
    monkeypatch.setattr(rows, '_CACHE_BYTES', 0)
    monkeypatch.setattr(rows, '_BLOCK', 10)
    some_rows = make(wide, items)
    evaluate(some_rows, factors, items.shape[1])
    tracemalloc.start()
    try:
        evaluate(some_rows, factors, items.shape[1])
        held, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert held < items.nbytes / 5
    # Some copies of a block, besides what comes out.
    assert most < 0.8 * items.nbytes + 2 * sum(
        part.nbytes for part in evaluate(some_rows, factors, items.shape[1])[0])


def test_compressed_rows_need_their_source_no_more(wide, items, factors):
    source = Counted(items)
    compressed = CompressedRows(wide, source, N_ITEMS, items.shape[1], 1e-5)
    assert source.calls
    source.calls.clear()
    evaluate(compressed, factors, items.shape[1])
    assert not source.calls
