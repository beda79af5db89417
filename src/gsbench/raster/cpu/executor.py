"""The compiled CPU rasterizer: runs the stages of both passes on several threads."""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsbench.gaussians.model import Gaussians
from gsbench.raster.base import CONSTANTS, CameraNumbers, Footprint, view_depths
from gsbench.raster.cpu import layout as at
from gsbench.raster.cpu.binning import (
    BUCKETS,
    PASSES,
    balance_tiles,
    fill_shards,
    pair_shards,
    place_rows,
    sort_by_depth,
    start_tiles,
)
from gsbench.raster.cpu.composite import (
    LOG2_ALPHA_MIN,
    composite_backward_tiles,
    composite_tiles,
    cover_tiles,
)
from gsbench.raster.cpu.projection import BAD_VALUE, VISIBLE, backproject_shards, project_shards
from gsbench.raster.cpu.shuffle import REST
from gsbench.raster.cpu.workspace import HEADROOM, Arena, ArenaPool, ShardRunner, TensorPool
from gsbench.raster.splitting import SPLITTING_MATRIX
from gsbench.raster.staged import (
    Gradients,
    Lifetime,
    RenderRequest,
    StagedRasterizer,
    raise_for_values,
)
from gsbench.system.resources import available_cores

# Fixed numbers, so that results have the same bits for any number of threads. Each shard of tiles
# sums gradients in its own rows; other numbers of shards would change the order of additions.
GAUSSIAN_SHARDS = 16
TILE_SHARDS = 8


@dataclass
class ForwardPass:
    """Results of the forward pass for the backward pass; the memory belongs to an arena."""

    frame: at.CpuFrame
    visible: NDArray[np.int64]  # [GAUSSIAN_SHARDS] number of records of each shard


class CpuRasterizer(StagedRasterizer[ForwardPass]):
    """A rasterizer in float32 on the CPU, compiled by numba at first use.

    Results have the same bits on every run and for any number of ``threads``. Each render keeps its
    intermediate results until its graph is freed; then their memory is reused. Several threads may
    call it at once.
    """

    name = "cpu"
    extras = SPLITTING_MATRIX

    def __init__(self, threads: int | None = None) -> None:
        if threads is not None and threads < 1:
            raise ValueError(f"threads: must be at least 1, got {threads}")
        if CONSTANTS.tile != at.TILE:
            raise ValueError(
                f"the compiled rasterizer has tiles of {at.TILE} px, the contract {CONSTANTS.tile}"
            )
        self.threads = threads or available_cores()
        self._runner = ShardRunner(self.threads)
        self._tensors = TensorPool()
        self._frames = ArenaPool()
        self._scratch = ArenaPool()
        self._pairs_of_shard = 0  # room for pairs of tile and record that has sufficed so far

    def check(self, gaussians: Gaussians) -> None:
        """Raise ValueError if tensors are not float32 on the CPU."""
        means = gaussians.means
        if means.dtype != torch.float32 or means.device.type != "cpu":
            raise ValueError(
                f"means: raster=cpu needs float32 on the cpu, got {means.dtype} on {means.device}"
            )

    def forward(
        self, gaussians: Gaussians, request: RenderRequest
    ) -> tuple[Tensor, Tensor, Tensor, ForwardPass]:
        """Project, sort, bin, composite; see `StagedRasterizer`."""
        count, view = len(gaussians), CameraNumbers.of(request.camera)
        image = self._tensors.empty((view.height, view.width, 3))
        alpha = self._tensors.empty((view.height, view.width))
        radii = torch.empty(count, dtype=torch.int32)
        arena = self._frames.lease(request.lifetime)
        records = arena.take("records", (count * at.RECORD,), np.float32)
        record_ints = records.view(np.int32)
        keys = arena.take("keys", (count,), np.uint64)
        flags = np.zeros((GAUSSIAN_SHARDS, 2), np.int64)
        edges, arrays = _edges(count), parameter_arrays(gaussians)
        inputs = edges, arrays, request.degree, view
        outputs = records, record_ints, keys, radii.numpy(), flags
        memory = at.kernel_memory(GAUSSIAN_SHARDS)
        self._runner.run(GAUSSIAN_SHARDS, project_shards, memory, *inputs, *outputs)
        # The kernels only notice that some value is bad; this search names it.
        if flags[:, BAD_VALUE].any():
            raise_for_values(gaussians)
        # Only now is it known how many Gaussians are visible.
        visible = flags[:, VISIBLE].copy()
        order = arena.take("order", (int(visible.sum()),), np.uint64)
        spare = arena.take("spare", order.shape, np.uint64)
        digits = np.empty((PASSES, BUCKETS), np.int64)
        sort_by_depth(edges[:-1], visible, keys, order, spare, digits)
        starts, entries = self._list_tiles(arena, view, order, records)
        tiles, total = view.tiles_x * view.tiles_y, len(entries)
        frame = at.CpuFrame(
            view,
            request.background.numpy(),
            records,
            record_ints,
            starts,
            entries,
            arena.take("masks", (total,), np.uint16),
            arena.take("processed", (tiles,), np.int64),
            arena.take("transmittance", (tiles * at.TILE_PIXELS,), np.float32),
            arena.take("last", (tiles * at.TILE_PIXELS,), np.float32),
            np.empty(TILE_SHARDS + 1, np.int64),
            arena.take("tile_shard", (tiles,), np.uint8),
        )
        balance_tiles(starts, TILE_SHARDS, frame.bounds, frame.tile_shard)
        pixels = image.numpy().reshape(-1), alpha.numpy().reshape(-1)
        memory = at.kernel_memory(TILE_SHARDS)
        self._runner.run(TILE_SHARDS, composite_tiles, memory, frame, *pixels)
        return image, alpha, radii, ForwardPass(frame, visible)

    def _list_tiles(
        self,
        arena: Arena,
        view: CameraNumbers,
        order: NDArray[np.uint64],
        records: NDArray[np.float32],
    ) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
        """Return the starts of the tiles' lists, [tiles + 1], and the records in the lists."""
        tiles = view.tiles_x * view.tiles_y
        counts = arena.take("counts", (GAUSSIAN_SHARDS, tiles), np.int64)
        starts = arena.take("starts", (tiles + 1,), np.int64)
        made = np.zeros(GAUSSIAN_SHARDS, np.int64)  # number of pairs of tile and record
        in_order = _edges(len(order)), order, records, records.view(np.int32), view.tiles_x

        def pair(room: int) -> NDArray[np.uint64]:
            pairs = arena.take("pairs", (GAUSSIAN_SHARDS, room), np.uint64)
            outputs = counts, pairs, made
            self._runner.run(GAUSSIAN_SHARDS, pair_shards, *in_order, LOG2_ALPHA_MIN, *outputs)
            return pairs

        # The number of pairs is known only when all are made. So they are made with the room
        # that has sufficed so far; a second pass is needed only if the scene has grown.
        pairs = pair(self._pairs_of_shard)
        if made.max() > self._pairs_of_shard:  # rare: as the scene grows
            self._pairs_of_shard = int(made.max() * HEADROOM)
            pairs = pair(self._pairs_of_shard)
        start_tiles(counts, starts)
        entries = arena.take("entries", (int(starts[tiles]),), np.int32)
        self._runner.run(GAUSSIAN_SHARDS, fill_shards, made, pairs, counts, entries)
        return starts, entries

    def backward(
        self,
        passed: ForwardPass,
        gaussians: Gaussians,
        request: RenderRequest,
        g_image: Tensor,
        g_alpha: Tensor | None,
    ) -> Gradients:
        """See `StagedRasterizer`."""
        gradients = gaussians.map(lambda tensor: self._tensors.empty(tuple(tensor.shape)))
        g_screen, g_extra = self._backward(
            passed, gaussians, request, (g_image, g_alpha), gradients, at.NO_STEP
        )
        return Gradients(list(gradients.tensors().values()), g_screen, g_extra)

    def backward_and_step(
        self,
        passed: ForwardPass,
        gaussians: Gaussians,
        request: RenderRequest,
        g_image: Tensor,
        adam: at.AdamStep,
    ) -> Tensor:
        """Apply Adam in place of writing the gradients; return those by the screen points [N, 2].

        Parameters and moments get the same bits as by `backward` and `train.adam_cpu`.
        """
        g_screen, _ = self._backward(passed, gaussians, request, (g_image, None), None, adam)
        return g_screen

    def _backward(
        self,
        passed: ForwardPass,
        gaussians: Gaussians,
        request: RenderRequest,
        g_pixels: tuple[Tensor, Tensor | None],
        gradients: Gaussians | None,
        adam: at.AdamStep,
    ) -> tuple[Tensor, Tensor | None]:
        """Fill ``gradients``, or step by ``adam``; return the screen gradient and the extra output.

        ``g_pixels`` are the gradients by the image and by alpha. ``request.absolute`` is filled.
        """
        lifetime = Lifetime()
        arena = self._scratch.lease(lifetime)
        count, take = len(gaussians), self._tensors.empty
        edges, frame = _edges(count), passed.frame
        placing = frame.record_ints, frame.tile_shard, frame.camera.tiles_x
        number = place_rows(edges[:-1], passed.visible, *placing)
        rows = arena.take("rows", (number * at.ROW,), np.float32, zero=True)
        g_image, g_alpha = (
            np.empty(0, np.float32) if given is None else given.numpy().reshape(-1)
            for given in g_pixels
        )
        want_absolute = None if request.absolute is None else True
        composited = frame, g_image, g_alpha, rows, want_absolute
        g_screen = take((count, 2))
        shape = self.extras[request.extra] if request.extra else ()
        g_extra = take((count, *shape)) if shape else None
        of_pixels = (
            g_screen.numpy(),
            _rows_or_none(request.absolute, 2),
            _rows_or_none(g_extra, math.prod(shape)),
        )
        inputs = (
            edges,
            passed.visible,
            parameter_arrays(gaussians),
            request.degree,
            frame,
        )
        own = (
            at.new_parameters(GAUSSIAN_SHARDS * at.CHUNK)
            if gradients is None
            else parameter_arrays(gradients)
        )
        outputs = rows, (own, *of_pixels), adam
        try:
            memory = at.kernel_memory(TILE_SHARDS)
            self._runner.run(TILE_SHARDS, composite_backward_tiles, memory, *composited)
            memory = at.kernel_memory(GAUSSIAN_SHARDS)
            self._runner.run(GAUSSIAN_SHARDS, backproject_shards, memory, *inputs, *outputs)
        except BaseException:
            # The kernels need rows of zeros and clear them after use; an interrupt may have left
            # sums in them.
            arena.drop("rows")
            raise
        return g_screen, g_extra

    def footprint(
        self,
        passed: ForwardPass,
        gaussians: Gaussians,
        request: RenderRequest,
        values: Tensor | None = None,
    ) -> Footprint:
        """See ``raster.base.RenderOutput``."""
        count = len(gaussians)
        covered = np.zeros((TILE_SHARDS, count), np.int32)
        sums, distances = np.zeros((2, TILE_SHARDS, count), np.float32)
        given = (
            np.empty(0, np.float32)
            if values is None
            else values.detach().float().contiguous().numpy().reshape(-1)
        )
        outputs = covered, sums, distances
        memory = at.kernel_memory(TILE_SHARDS)
        self._runner.run(TILE_SHARDS, cover_tiles, memory, passed.frame, given, *outputs)
        # The shards are added in one order, whatever the number of threads.
        totals = (torch.from_numpy(shards.sum(0, dtype=shards.dtype)) for shards in outputs)
        return Footprint(next(totals), view_depths(gaussians, request.camera), *totals)


@lru_cache(maxsize=8)
def _edges(count: int) -> NDArray[np.int64]:
    """The starts of the shards of ``count`` Gaussians or records, and the end of the last shard.

    The array is shared: do not write to it.
    """
    return np.arange(GAUSSIAN_SHARDS + 1) * count // GAUSSIAN_SHARDS


def _rows_or_none(tensor: Tensor | None, columns: int) -> NDArray[np.float32]:
    """``tensor`` as rows of ``columns`` numbers; for None, which kernels cannot take, no rows."""
    if tensor is None:
        return np.empty((0, columns), np.float32)
    return tensor.numpy().reshape(-1, columns)


def parameter_arrays(gaussians: Gaussians) -> at.Parameters:
    """The tensors of ``gaussians`` as kernels take them."""
    means, log_scales, quaternions, logits, sh_dc, sh_rest = (
        t.detach().numpy() for t in gaussians.tensors().values()
    )
    return at.Parameters(
        means, log_scales, quaternions, logits.reshape(-1, 1), sh_dc, sh_rest.reshape(-1, REST)
    )
