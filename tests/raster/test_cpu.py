"""What the compiled CPU rasterizer promises beyond the contract.

Results have the same bits on every run, their memory is not overwritten, and any CPU will do.
"""

import math
import os
import sys
import threading
import time
from inspect import signature

import numba
import numpy as np
import pytest
import torch
from numba import types
from numpy.testing import assert_allclose, assert_array_equal

from gsbench.bench.measure import UNUSED_FOLDER, Setting, Stepper
from gsbench.raster.contract import Case, render_with_gradients
from gsbench.raster.cpu import (
    CpuRasterizer,
    binning,
    composite,
    executor,
    layout,
    simd,
    workspace,
)
from gsbench.raster.cpu.workspace import Arena, ShardRunner, TensorPool
from gsbench.raster.reference import project, tile_rectangles
from tests.conftest import ROOT
from tests.helpers import table
from tests.processes import completed
from tests.raster.promises import BLACK, PROMISES, Subject, bits_of

CASE = Case(97, 65, 250, sh_degree=3, principal=(7.3, -5.1))
MANY = Case(150, 110, 4000, sh_degree=3, log_scale=-3.0)
SUBJECT = Subject(lambda: CpuRasterizer(threads=1), CASE, MANY, 2e-5)


def rendered(case):
    gaussians = case.gaussians().map(torch.Tensor.float)
    return CpuRasterizer(threads=1).render(gaussians, case.camera(), 0, BLACK)


@pytest.mark.parametrize("promise", PROMISES)
def test_it_keeps_the_promise_that(promise):
    PROMISES[promise](SUBJECT)


def test_the_same_bits_on_every_run_and_for_any_number_of_threads():
    one = CpuRasterizer(threads=1)
    expected = bits_of(one, MANY)
    assert bits_of(one, MANY) == expected  # memory that was used before
    for threads in (2, 4):
        rasterizer = CpuRasterizer(threads=threads)
        for _ in range(3):
            assert bits_of(rasterizer, MANY) == expected


def test_depths_are_sorted_as_numpy_sorts_them():
    generator = np.random.default_rng(0)
    depths = np.exp(generator.uniform(-1.6, 20, 500)).astype(np.float32)
    depths[generator.integers(0, 500, 60)] = depths[7]
    keys = (depths.view(np.uint32).astype(np.uint64) << np.uint64(32)) | np.arange(
        500, dtype=np.uint64
    )
    begins, visible = np.array([0, 200, 320]), np.array([150, 0, 180])
    order, spare = np.empty((2, 330), np.uint64)
    digits = np.empty((binning.PASSES, binning.BUCKETS), np.int64)
    binning.sort_by_depth(begins, visible, keys, order, spare, digits)
    assert_array_equal(order, np.sort(np.concatenate([keys[:150], keys[320:]])))


@pytest.mark.parametrize(
    "lengths, shards, bounds",
    table(__file__, "shares of tiles"),
)
def test_tiles_are_divided_by_their_work(lengths, shards, bounds):
    starts = np.concatenate([[0], np.cumsum(lengths)])
    found, of_tile = np.full(shards + 1, -1), np.full(len(lengths), 99, np.uint8)
    binning.balance_tiles(starts, shards, found, of_tile)
    assert found.tolist() == bounds
    assert of_tile.tolist() == np.repeat(np.arange(shards), np.diff(bounds)).tolist()


def highest(records, low_x, low_y, size):
    """The largest log2(alpha) of records [R, 16] in squares of side ``size``, [R, squares].

    It is at the mean if the square contains it, or else on an edge.
    """
    mean_x, mean_y, u_x, u_y, v_y, top = (records[:, k, None].astype(np.float64) for k in range(6))

    def at(dx, dy):
        return top - (u_x * dx + u_y * dy) ** 2 - (v_y * dy) ** 2

    left, upper = low_x - mean_x, low_y - mean_y  # [R, S]
    right, lower = left + size, upper + size
    best = at(np.clip(0, left, right), np.clip(0, upper, lower))
    slope = -u_x * u_y / (u_y**2 + v_y**2)
    for dx in (left, right):
        best = np.maximum(best, at(dx, np.clip(slope * dx, upper, lower)))
    for dy in (upper, lower):
        best = np.maximum(best, at(np.clip(-u_y / u_x * dy, left, right), dy))
    return best


def test_a_record_is_listed_only_in_the_tiles_and_blocks_that_its_contour_reaches():
    """There, alpha is at least 1/255; a margin for rounding is allowed.

    In others, it would be composited in vain; one that is missing departs from the contract.
    """
    case = Case(96, 64, 150, sh_degree=0, log_scale=-2.5, logit=-3.0)  # faint: no pixel stops
    passed = rendered(case).footprint.args[0]
    frame, edges = passed.frame, executor._edges(case.count)
    assert (frame.last == composite.NEVER_STOPPED).all()
    shards = zip(edges[:-1], passed.visible, strict=True)
    numbers = np.concatenate([np.arange(edge, edge + seen) for edge, seen in shards])
    records = frame.records.reshape(-1, 16)[numbers]
    integers = frame.record_ints.reshape(-1, 16)[numbers]
    place = {number: k for k, number in enumerate(numbers.tolist())}
    listed, masks = np.zeros((len(numbers), 24), bool), np.zeros((len(numbers), 24), int)
    for tile in range(24):
        for entry in range(frame.starts[tile], frame.starts[tile + 1]):
            k = place[int(frame.entries[entry])]
            assert not listed[k, tile]
            listed[k, tile], masks[k, tile] = True, frame.masks[entry]

    projected = project(case.gaussians(), case.camera())
    first, past = tile_rectangles(projected, case.camera())
    rows = {int(index): row for row, index in enumerate(projected.index)}
    own = [rows[int(index)] for index in integers[:, layout.INDEX]]
    first, past = first[own].numpy(), past[own].numpy()  # [R, 2]
    y, x = np.divmod(np.arange(24), 6)
    in_square = (x >= first[:, :1]) & (x < past[:, :1]) & (y >= first[:, 1:]) & (y < past[:, 1:])

    least = math.log2(1 / 255)
    allowed = in_square & (highest(records, 16 * x - 0.1, 16 * y - 0.1, 15.2) >= least - 0.1)
    spans = integers[:, [layout.TILES_X, layout.TILES_Y]]
    low, high = spans & 0xFFFF, spans >> 16
    in_span = (x >= low[:, :1]) & (x < high[:, :1]) & (y >= low[:, 1:]) & (y < high[:, 1:])
    narrow = high[:, :1] - low[:, :1] == 1  # one column: all its tiles are listed
    assert (listed <= np.where(narrow, in_span, allowed)).all()
    assert (listed >= (narrow & in_span)).all()
    assert 0.3 < listed.sum() / in_square.sum() < 0.6

    bits = (masks[..., None] >> np.arange(16) & 1).astype(bool)
    for k in range(16):
        near = highest(records, 16 * x + k % 4 * 4, 16 * y + k // 4 * 4, 3.0) >= least - 0.02
        assert (bits[..., k] <= near).all()

    whole = ((low > 0) & (high < (6, 4))).all(1)  # the contour lies within the image
    for k in np.flatnonzero(whole):
        for axis, tiles in ((0, x), (1, y)):
            assert tiles[allowed[k]].min() - 1 <= low[k, axis] <= tiles[listed[k]].min()
            assert tiles[listed[k]].max() < high[k, axis] <= tiles[allowed[k]].max() + 2
    assert whole.sum() > 10
    assert (high - low < past - first).any()


def test_a_batch_fits_into_the_scratch_memory_of_a_call():
    assert 3 * layout.TILE_PIXELS + composite.BATCH * composite.COPY <= layout.SCRATCH


def test_the_default_dtype_of_torch_changes_nothing():
    """Also not in a step without autograd."""
    expected, gradients = render_with_gradients(CpuRasterizer(threads=1), CASE, torch.float32)
    steppers = [Stepper("cpu", Setting("trained", 40, 30, 200)) for _ in range(2)]
    steppers[0].trainer.iterate(UNUSED_FOLDER)
    torch.set_default_dtype(torch.float64)
    try:
        output, others = render_with_gradients(CpuRasterizer(threads=1), CASE, torch.float32)
        steppers[1].trainer.iterate(UNUSED_FOLDER)
    finally:
        torch.set_default_dtype(torch.float32)
    assert torch.equal(output.image, expected.image)
    assert all(torch.equal(others[name], gradients[name]) for name in gradients)
    first, second = (stepper.trainer.gaussians.values.means for stepper in steppers)
    assert torch.equal(first, second)


def test_the_backward_pass_skips_entries_behind_the_one_that_stopped_a_block():
    case = Case(40, 40, 300, sh_degree=0, log_scale=-1.5, logit=3.0)
    frame = rendered(case).footprint.args[0].frame
    skipped = 0
    for tile in range(9):
        begin, end = frame.starts[tile], frame.processed[tile]
        last = frame.last[256 * tile :][:256].reshape(16, 16).max(1)
        assert end - begin <= frame.starts[tile + 1] - begin
        for block in np.flatnonzero(last < end - begin):
            behind = frame.masks[begin + int(last[block]) + 1 : end] >> block & 1
            assert not behind.any()
            skipped += len(behind)
    assert skipped > 100


def test_an_interrupted_backward_pass_does_not_change_later_gradients(monkeypatch):
    for threads in (1, 2):
        rasterizer = CpuRasterizer(threads=threads)
        _, expected = render_with_gradients(rasterizer, CASE, torch.float32)
        with monkeypatch.context() as patch:
            patch.setattr(executor, "backproject_shards", _interrupt)
            with pytest.raises(KeyboardInterrupt):
                render_with_gradients(rasterizer, CASE, torch.float32)
        _, gradients = render_with_gradients(rasterizer, CASE, torch.float32)
        assert torch.equal(gradients["means"], expected["means"])


def _interrupt(*_):
    raise KeyboardInterrupt


def test_zero_threads_are_refused():
    with pytest.raises(ValueError, match="threads"):
        CpuRasterizer(threads=0)


@pytest.mark.slow
def test_hosts_without_wide_vectors_match_the_reference(tmp_path):
    """A separate process compiles for the simplest CPU of this architecture (SSE2 on x86)."""
    script = """
import sys, torch
from gsbench.raster.cpu import CpuRasterizer
from gsbench.raster.reference import ReferenceRasterizer, project, tile_rectangles
from gsbench.raster.contract import Case, render_with_gradients
case = Case(33, 49, 50, sh_degree=3)
output, gradients = render_with_gradients(CpuRasterizer(threads=2), case, torch.float32)
expected, references = render_with_gradients(ReferenceRasterizer(), case, torch.float64)
worst = max(float((gradients[n] - r).abs().max() / r.abs().max()) for n, r in references.items())
print(float((output.image.double() - expected.image).abs().max()), worst)
"""
    environment = os.environ | {
        "NUMBA_CPU_NAME": "generic",
        "NUMBA_CPU_FEATURES": "",
        "NUMBA_CACHE_DIR": str(tmp_path),
        "PYTHONPATH": os.pathsep.join(path for path in sys.path if path),
    }
    run = completed([sys.executable, "-c", script], env=environment, cwd=ROOT)
    value_error, gradient_error = map(float, run.stdout.split())
    assert value_error < 1e-4
    assert gradient_error < 1e-3
    assert "compiling kernels for this processor" in run.stderr
    assert any(tmp_path.rglob("*.nbc"))


@numba.njit
def _vector_functions(a, b, out):
    x, y = simd.load(a, 0), simd.load(b, 0)
    simd.store(out, 0, simd.fma(x, y, 2) - x / y)
    mask = (x < y) & ~(x > 0)
    simd.store(out, 32, simd.select(mask, x, 7))
    simd.store(out, 48, simd.minimum(x, y) + simd.maximum(x, 0) * simd.absolute(y))
    simd.store(out, 64, simd.lane_sums((x, y, x * y, x - y, -x)))
    simd.store(out, 80, simd.select(simd.mask_from_bits(np.uint64(0b1010)), x, y))
    return simd.mask_bits(mask), simd.lowest_bit(np.uint64(0b101000))


def test_vector_functions_match_numpy():
    a, b = np.random.default_rng(0).normal(size=(2, 16)).astype(np.float32)
    out = np.full(96, np.nan, np.float32)
    bits, lowest = _vector_functions(a, b, out)
    mask = (a < b) & ~(a > 0)
    assert bits == sum(1 << k for k in range(16) if mask[k])
    assert 0 < mask.sum() < 16
    assert lowest == 3
    assert_allclose(out[:16], a * b + 2 - a / b, rtol=1e-5, atol=1e-6)
    assert_array_equal(out[32:48], np.where(mask, a, np.float32(7)))
    assert_allclose(out[48:64], np.minimum(a, b) + np.maximum(a, 0) * np.abs(b), rtol=1e-6)
    for k, values in enumerate((a, b, a * b, a - b, -a)):
        assert out[64 + simd.SUM_LANES[k]] == pytest.approx(values.sum(), abs=1e-5)
    assert np.count_nonzero(out[64:80]) == 5
    assert_array_equal(out[80:96], np.where(0b1010 >> np.arange(16) & 1, a, b))


@numba.njit
def _powers(x, exponents, out):
    for i in range(0, len(x), simd.LANES):
        value = simd.load(x, i)
        simd.store(out[0], i, simd.log2(value))
        simd.store(out[1], i, simd.square_root(value) + simd.floor(value) - simd.ceil(value))
        simd.store(out[2], i, simd.exp2(simd.load(exponents, i)))


@pytest.mark.parametrize(
    "kind", [types.Array(types.float64, 1, "C"), types.Array(types.float32, 1, "A"), types.intp]
)
@pytest.mark.parametrize("name", ["load", "store", "gather_vectors", "scatter"])
def test_only_contiguous_float32_arrays_are_accepted(name, kind):
    define = getattr(simd, name)._defn
    others = [types.intp] * (len(signature(define).parameters) - 2)
    define(None, types.Array(types.float32, 2, "C"), *others)
    with pytest.raises(TypeError, match="a contiguous float32 array is needed"):
        define(None, kind, *others)


def test_powers_logarithms_and_roots_are_accurate_over_their_range():
    x = np.exp2(np.linspace(-126, 100, 16 * 4096)).astype(np.float32)
    exponents = np.linspace(-126, 127, len(x)).astype(np.float32)
    out = np.empty((3, len(x)), np.float32)
    _powers(x, exponents, out)
    exact = np.log2(x.astype(np.float64))
    assert (np.abs(out[0] - exact) / np.maximum(np.abs(exact), 1)).max() < 2e-7
    assert_allclose(out[1], np.sqrt(x) + np.floor(x) - np.ceil(x), rtol=1e-6)
    assert_allclose(out[2], np.exp2(exponents.astype(np.float64)), rtol=2.5e-7)


def test_memory_is_reused_when_nothing_refers_to_it():
    pool = TensorPool()
    first = pool.empty((100, 3))
    address = first.data_ptr()
    assert address % 64 == 0
    view = first[1:]
    del first
    second = pool.empty((100, 3))
    assert second.data_ptr() != address  # a view still holds the memory
    del view
    assert pool.empty((110, 3)).data_ptr() == address

    arena = Arena()
    block = arena.take("a", (10,), np.float32, zero=True)
    assert not block.any()
    block[:] = 1
    assert arena.take("a", (4,), np.float32).all()
    assert not arena.take("a", (1000,), np.float32, zero=True).any()


def test_unused_memory_is_freed(monkeypatch):
    pool = TensorPool()
    del (large := [pool.empty((100_000,))])[:]
    assert not large
    pool.empty((3,))  # the large block would be mostly empty
    assert [block.size for block in pool._free] == [int(12 * workspace.HEADROOM)]

    arena, allocate = Arena(), workspace.aligned_bytes
    arena.take("a", (10,), np.float32)
    monkeypatch.setattr(
        workspace, "aligned_bytes", lambda size: allocate(size) if not arena._blocks else None
    )
    assert arena.take("a", (100,), np.float32).shape == (100,)  # the old block was dropped before
    assert allocate(10).size == 10


def test_the_calling_thread_is_one_of_a_runner():
    threads, both = {}, threading.Barrier(2)

    def note(first, past):
        threads[first, past] = threading.get_ident()
        if past < 3:  # each of the first two of three ranges waits for the other
            both.wait(10)

    ShardRunner(1).run(8, note)
    assert threads == {(0, 8): threading.get_ident()}
    threads.clear()
    ShardRunner(2).run(3, note)
    assert sorted(threads) == [(0, 1), (1, 2), (2, 3)]
    assert len(set(threads.values())) == 2
    assert threading.get_ident() in threads.values()


def test_no_shard_runs_after_an_error_was_raised():
    second_began, done = threading.Event(), []

    def work(first, past):
        if first == 0:
            second_began.wait(10)
            raise ZeroDivisionError
        second_began.set()
        time.sleep(0.05)
        done.append(first)

    with pytest.raises(ZeroDivisionError):
        ShardRunner(2).run(12, work)
    finished = list(done)
    assert 3 in finished  # the runner waited for the second of four ranges
    assert len(finished) < 11  # the runner cancelled the others
    time.sleep(0.1)
    assert done == finished
    with pytest.raises(ZeroDivisionError):
        ShardRunner(1).run(12, work)
