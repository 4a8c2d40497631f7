"""Products with rows, exact and compressed."""

import tracemalloc
from types import SimpleNamespace

import numpy as np
import pytest

from rhs_isac_ros.bounds import AverageCrlb, rows
from rhs_isac_ros.bounds.rows import CompressedRows, Evaluation, ExactRows, RowSource, rows_within
from rhs_isac_ros.codebook import random_codebook
from rhs_isac_ros.model import MeasurementModel, Scenario
from rhs_isac_ros.model.los import los_and_derivative, los_gain

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
def model(wide, random_beams):
    return MeasurementModel(wide, random_beams(wide, np.random.default_rng(0)))


@pytest.fixture(scope='module', params=['derivatives', 'differences'])
def items(request, wide):
    """All rows, complex [N_ITEMS, G, N_B, N_SB, N_E], with three rows an item or one."""
    firsts, seconds = wide.sample_positions(
        2 * N_ITEMS, np.random.default_rng(1)).reshape(2, -1, 3)
    if request.param == 'derivatives':
        return np.stack(
            [los_and_derivative(wide, firsts, i)[1] for i in range(2)], axis=2)
    return np.stack(
        [(los_gain(wide, firsts, i) - los_gain(wide, seconds, i))[:, None] for i in range(2)],
        axis=2)


def source_of(items):
    return lambda block, band: items[block, :, band].copy()


def make(scenario, items, tolerance=0.0, block=16):
    source = RowSource(scenario, source_of(items), len(items), items.shape[1], block=block)
    return CompressedRows(source, tolerance) if tolerance else ExactRows(source)


def evaluate(some_rows, model, n_rows, seed=2):
    """Whitened means of all items and the sums for random weights, by band."""
    evaluation, rng = Evaluation(some_rows, model), np.random.default_rng(seed)
    bands = range(len(model.radiation))
    whitened = [[] for _ in bands]
    for block in some_rows.blocks():
        weights = rng.normal(size=(block.stop - block.start, n_rows, n_rows))
        for band in bands:
            whitened[band].append(evaluation.whitened(block, band).copy())
        for band in bands:
            evaluation.accumulate(block, band, weights @ whitened[band][-1])
    return [np.concatenate(parts) for parts in whitened], [*map(evaluation.sums, bands)]


def plain_evaluation(scenario, items, model, seed=2):
    """The same as `evaluate`, by the definitions."""
    n_items, n_rows = items.shape[:2]
    weights = np.random.default_rng(seed).normal(size=(n_items, n_rows, n_rows))
    whitened, sums = [], []
    for band, (radiation, whitener) in enumerate(
            zip(model.radiation, model.whitener, strict=True)):
        frames = radiation.reshape(scenario.n_subbands, -1, scenario.n_elements)
        means = np.einsum('jqm,ngjm->ngjq', frames, items[:, :, band]).reshape(n_items, n_rows, -1)
        inverse = whitener.conj().T @ whitener
        zeta = np.einsum('ab,ngb->nga', inverse, means)
        w = np.einsum('ngh,nha->nga', weights, zeta)
        mean_term = np.einsum(
            'ngjq,ngjm->jqm', w.reshape(*w.shape[:2], scenario.n_subbands, -1),
            items[:, :, band].conj())
        whitened.append(np.einsum('ab,ngb->nga', whitener, means))
        sums.append((mean_term.reshape(radiation.shape),
                     np.einsum('nga,ngb->ab', w, zeta.conj())))
    return whitened, sums


def recovered(some_rows, scenario):
    """The rows themselves: their means if each measurement observes one element, not whitened."""
    size = scenario.n_subbands * scenario.n_elements
    elements = np.tile(np.eye(scenario.n_elements, dtype=complex), (scenario.n_subbands, 1))
    evaluation = Evaluation(some_rows, SimpleNamespace(
        radiation=np.stack([elements] * scenario.n_bands),
        whitener=np.stack([np.eye(size, dtype=complex)] * scenario.n_bands)))
    blocks = some_rows.blocks()
    bands = [np.concatenate([evaluation.whitened(block, i) for block in blocks])
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


def test_exact_evaluations_match_the_definition(wide, items, model):
    assert_same(evaluate(make(wide, items), model, items.shape[1]),
                plain_evaluation(wide, items, model), 1e-12)


@pytest.mark.parametrize('tolerance', [1e-7, 1e-5, 1e-3])
def test_compressed_evaluations_match_exact_ones_to_the_tolerance(
        wide, items, model, tolerance):
    compressed = evaluate(make(wide, items, tolerance), model, items.shape[1])
    assert_same(compressed, plain_evaluation(wide, items, model), 10 * tolerance)
    assert_same(compressed, evaluate(make(wide, items), model, items.shape[1]), 10 * tolerance)


@pytest.mark.parametrize('tolerance', [1e-7, 1e-6, 1e-4, 1e-2, 0.3])
def test_the_tolerance_is_met_with_the_minimum_rank_or_one_more(wide, items, tolerance):
    compressed = make(wide, items, tolerance)
    errors = relative_errors(compressed, wide, items)
    # At the smallest tolerance, rounding is visible.
    assert (errors <= 1.01 * tolerance).all()
    assert len(compressed.ranks) == 2
    for rank, least in zip(compressed.ranks, least_ranks(items, tolerance), strict=True):
        assert least <= rank <= least + 1 or (tolerance < 1e-6 and least - 2 <= rank <= least + 3)


def test_errors_are_relative_to_the_norm_of_each_row(wide, items):
    sizes = 10.0**np.random.default_rng(3).uniform(-9, 9, items.shape[:2])
    scaled = items * sizes[:, :, None, None, None]
    compressed = make(wide, scaled, 1e-4)
    assert (relative_errors(compressed, wide, scaled) <= 1e-4).all()
    for rank, least in zip(compressed.ranks, least_ranks(items, 1e-4), strict=True):
        assert least <= rank <= least + 1


@pytest.mark.parametrize(('n_items', 'rank'), [(5, 10), (64, 128), (71, 142), (200, DIMENSIONS)])
def test_rows_without_structure_have_full_rank(wide, model, n_items, rank):
    """The rank is the number of rows or of dimensions, which also limits the sketch."""
    items = complex_array(np.random.default_rng(4), n_items, 2, 2, 4, 36)
    compressed = make(wide, items, 1e-6)
    assert compressed.ranks == (rank, rank)
    assert (relative_errors(compressed, wide, items) < 1e-12).all()
    assert_same(evaluate(compressed, model, 2), plain_evaluation(wide, items, model), 1e-11)


def test_zero_rows_stay_zero_and_do_not_affect_the_rank(wide, items, model):
    some = items.copy()
    some[::3] = 0
    some[1, 0, 1] = 0
    compressed = make(wide, some, 1e-4)
    assert (relative_errors(compressed, wide, some) <= 1e-4).all()
    np.testing.assert_array_equal(recovered(compressed, wide)[::3], 0)
    assert_same(evaluate(compressed, model, some.shape[1]),
                plain_evaluation(wide, some, model), 1e-3)
    others = items[np.arange(N_ITEMS) % 3 > 0]
    for rank, least in zip(compressed.ranks, least_ranks(others, 1e-4), strict=True):
        assert abs(rank - least) <= 1


@pytest.mark.parametrize('tolerance', [
    0.0, np.nextafter(rows.MIN_TOLERANCE, 0), 1e-300, -1.0, 1.0, np.inf, -np.inf,
    np.nan])
def test_a_tolerance_out_of_range_is_an_error(wide, items, tolerance):
    with pytest.raises(ValueError, match='^tolerance: .*, expected 1e-07 to 1, or 0 '):
        CompressedRows(
            RowSource(wide, source_of(items), len(items), items.shape[1]), tolerance)


@pytest.mark.parametrize('size', [1, 7, 30, 60, 100])
def test_results_do_not_depend_on_the_blocks(wide, items, model, size):
    expected = plain_evaluation(wide, items, model)
    for tolerance, error in ((0.0, 1e-12), (1e-6, 1e-5)):
        some_rows = make(wide, items, tolerance, size)
        blocks = [range(N_ITEMS)[block] for block in some_rows.blocks()]
        assert [n for block in blocks for n in block] == list(range(N_ITEMS))
        lengths = [len(block) for block in blocks]
        assert lengths[:-1] == [size * max(3 // items.shape[1], 1)] * (len(lengths) - 1)
        assert_same(evaluate(some_rows, model, items.shape[1]), expected, error)


class RecordingSource:
    def __init__(self, items):
        self.items, self.calls = items, []

    def __call__(self, block, band):
        self.calls.append((block.start, block.stop, band))
        return self.items[block, :, band].copy()


@pytest.mark.parametrize(('spare', 'kept'), [(0, True), (-1, False)], ids=['fits', 'too large'])
def test_exact_rows_are_kept_only_within_the_memory_limit(
        wide, items, model, spare, kept, monkeypatch):
    source = RecordingSource(items)
    monkeypatch.setattr('rhs_isac_ros.bounds.rows._CACHE_BYTES', items.nbytes + spare)
    some_rows = ExactRows(RowSource(wide, source, N_ITEMS, items.shape[1], block=8))
    every = {(block.start, block.stop, band) for block in some_rows.blocks() for band in range(2)}
    assert len(every) > 4
    expected = plain_evaluation(wide, items, model)
    for evaluation in range(2):
        source.calls.clear()
        assert_same(evaluate(some_rows, model, items.shape[1]), expected, 1e-12)
        if kept:
            assert sorted(source.calls) == ([] if evaluation else sorted(every))
        else:
            assert set(source.calls) == every


@pytest.mark.parametrize('rank', [20, 400])
def test_few_rows_that_need_a_large_basis_are_kept_in_single_precision(rank):
    scenario = Scenario(n_subbands=40, n_frames=2, n_feeds=2, elements_per_side=6)
    rng = np.random.default_rng(6)
    items = (complex_array(rng, 400, rank) @ complex_array(rng, rank, 2 * 40 * 36)).reshape(
        400, 1, 2, 40, 36)
    found = rows_within(RowSource(scenario, source_of(items), 400, 1), 1e-5)
    assert isinstance(found, CompressedRows if rank == 20 else ExactRows)
    exact = rows_within(RowSource(scenario, source_of(items), 400, 1), 0.0)
    assert isinstance(exact, ExactRows)
    beams = SimpleNamespace(
        radiation=complex_array(rng, 2, 80, 36),
        whitener=np.stack([np.eye(80) + 0j] * 2))
    own, expected = (evaluate(one, beams, 1) for one in (found, exact))
    assert_same(own, expected, 1e-5)
    if rank == 400:
        assert max(one.dtype.itemsize for one in found._kept.values()) == 8
        assert_same(own, expected, 1e-6)


def test_the_rows_of_a_wide_surface_need_little_memory():
    """64 sub-bands of 256 elements and 768 rows of 16384 numbers each, 200 MB in full."""
    scenario = Scenario(center_frequencies_hz=(28e9,), n_subbands=64, subband_width_hz=6.25e6,
                        elements_per_side=16)
    positions = scenario.sample_positions(256, np.random.default_rng(0))
    model = MeasurementModel(scenario, random_codebook(scenario, np.random.default_rng(0)))
    model.prepare()
    tracemalloc.start()
    try:
        average = AverageCrlb(scenario, positions, 3e-5)
        average(model.beams)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 5e8
