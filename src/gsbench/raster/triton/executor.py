"""The Triton rasterizer: the stages of the forward and the backward pass, and the footprint."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gsbench.gaussians.model import Gaussians
from gsbench.raster.base import CONSTANTS, CameraNumbers, Footprint, view_depths
from gsbench.raster.executors import load_driver
from gsbench.raster.splitting import SPLITTING_MATRIX
from gsbench.raster.staged import (
    Gradients,
    Lifetime,
    Readback,
    RenderRequest,
    StagedRasterizer,
    raise_for_values,
    upload,
)
from gsbench.raster.triton.composite import composite, composite_backward
from gsbench.raster.triton.footprint import cover, sum_cover
from gsbench.raster.triton.launch import Allocate, Workspace, WorkspacePool, launch, launch_grid
from gsbench.raster.triton.layout import (
    BLOCK_PIXELS,
    BORDER,
    COLOR_SLOPES,
    RECORD,
    ROW,
    STEPS,
    TILE,
    count_borders,
)
from gsbench.raster.triton.lists import (
    UNITS_AT_FIRST,
    Blocks,
    Lists,
    Parameters,
    Pixels,
    Projected,
    Room,
    Started,
    Units,
    check_pairs,
    make_lists,
    sort_by_depth,
)
from gsbench.raster.triton.projection import backproject, project, store_splitting, sum_units
from gsbench.scene.types import Camera

EXTRA_KERNELS = {"splitting_matrix": store_splitting}  # each writes an extra output
# Blocks, those with the longest lists, that may have four programs each: on a GPU of about 130
# multiprocessors so many programs run at once. 0: each block has one program.
SPLIT_BLOCKS = 1024


@dataclass
class TritonFrame:
    """Results of the forward pass for the backward pass; the memory belongs to a workspace."""

    blocks_x: int
    blocks: int  # number of blocks
    view: Tensor  # [24] float32, the numbers of the camera
    projected: Projected
    units: Units
    lists: Lists
    transmittance: Tensor  # [blocks * BLOCK_PIXELS]
    last: Tensor  # [blocks * BLOCK_PIXELS] int32
    borders: Tensor  # [count_borders(pairs) * BORDER]; see `composite` for these three

    def size(self, request: RenderRequest) -> dict[str, int]:
        camera = request.camera
        return {"width": camera.width, "height": camera.height, "blocks_x": self.blocks_x}

    @property
    def of_blocks(self) -> Blocks:
        lists = self.lists
        return Blocks(lists.starts, lists.entries, self.projected.records, self.last)

    def of_pixels(self, request: RenderRequest) -> Pixels:
        return Pixels(self.lists.order, request.background, self.transmittance, self.borders)


class TritonRasterizer(StagedRasterizer[TritonFrame]):
    """A rasterizer in float32 on a GPU, compiled by Triton at first use.

    Results have the same bits on every run on one GPU. Each render keeps its intermediate results
    until its graph is freed; then their memory is reused. ``render`` waits for the device once, for
    the sizes of the lists. `gsbench.train.direct` calls ``start``, ``finish`` and
    ``differentiate`` itself, with room for lists that is known before, and so does not wait.
    """

    name = "triton"
    extras = SPLITTING_MATRIX

    def __init__(self) -> None:
        self.direct_steps = True  # whether trainings may use `gsbench.train.direct`
        if CONSTANTS.tile != TILE.value:
            raise ValueError(
                f"the Triton rasterizer has tiles of {TILE.value} px, the contract {CONSTANTS.tile}"
            )
        self._frames = WorkspacePool()
        self._scratch = WorkspacePool()

    def check(self, gaussians: Gaussians) -> None:
        """Raise ValueError unless tensors are float32; InputError if Triton cannot use the GPU."""
        if gaussians.means.dtype != torch.float32:
            raise ValueError(f"means: raster=triton needs float32, got {gaussians.means.dtype}")
        if gaussians.means.device.type == "cuda":
            load_driver()

    def forward(
        self, gaussians: Gaussians, request: RenderRequest
    ) -> tuple[Tensor, Tensor, Tensor, TritonFrame]:
        """Project, sort, bin, composite; see `StagedRasterizer`.

        Raises ValueError for bad values and for too many pairs.
        """
        device = gaussians.means.device
        call_lifetime = Lifetime()  # freed when this call returns
        with torch.cuda.device_of(gaussians.means):
            memory = self._frames.lease(request.lifetime, device)
            scratch = self._scratch.lease(call_lifetime, device)
            capacity = max(memory.capacity("unit_widths"), UNITS_AT_FIRST * len(gaussians), 1)
            view = camera_numbers(request.camera, device)
            started = self.start(
                gaussians, request, view, memory, scratch, capacity, fresh_on(device)
            )
            while True:
                # the only wait for the device
                units, pairs, bad = Readback(started.units.status).values().tolist()
                if bad:
                    raise_for_values(gaussians, request.background)
                if units <= capacity:
                    break
                capacity = 2 * units
                started.find_units(capacity)
            check_pairs(pairs)
            return self.finish(started, Room(units, pairs))

    def start(
        self,
        gaussians: Gaussians,
        request: RenderRequest,
        view: Tensor,
        memory: Workspace,
        scratch: Workspace,
        capacity: int,
        allocate: Allocate,
    ) -> Started:
        """Project all Gaussians, sort them by depth, and find up to ``capacity`` units."""
        count = len(gaussians)
        radii = allocate("radii", (count,), torch.int32)
        flags = scratch.take("flags", 1, torch.int32).zero_()
        keys = scratch.take("depth_keys", count, torch.int32)
        projected = Projected(
            memory.take("records", (count + 1) * RECORD.value, torch.float32),
            memory.take("color_slopes", count * COLOR_SLOPES.value, torch.float32),
            memory.take("row_counts", count, torch.int32),
        )
        launch(project, count + 1, 128)(
            gaussians=Parameters(**gaussians.detach().tensors()),
            count=count,
            camera=view,
            projected=projected,
            record_ints=projected.records.view(torch.int32),
            keys=keys,
            radii=radii,
            flags=flags,
            DEGREE=request.degree,
        )
        order, unit_ends = sort_by_depth(scratch, projected, keys)
        started = Started(
            request,
            view,
            memory,
            scratch,
            allocate,
            radii,
            projected,
            order,
            unit_ends,
            flags,
        )
        started.find_units(capacity)
        return started

    def finish(self, started: Started, room: Room) -> tuple[Tensor, Tensor, Tensor, TritonFrame]:
        """Make the lists and composite; return image, alpha, radii and the frame.

        If there are more units or pairs than ``room``, the image has only the background.
        """
        camera, memory, blocks = started.request.camera, started.memory, started.blocks
        image = started.allocate("image", (camera.height, camera.width, 3), torch.float32)
        alpha = started.allocate("alpha", (camera.height, camera.width), torch.float32)
        lists = make_lists(started, room)
        frame = TritonFrame(
            started.blocks_x,
            blocks,
            started.view,
            started.projected,
            started.units,
            lists,
            memory.take("transmittance", blocks * BLOCK_PIXELS.value, torch.float32),
            memory.take("last", blocks * BLOCK_PIXELS.value, torch.int32),
            memory.take("borders", count_borders(room.pairs) * BORDER.value, torch.float32),
        )
        split = min(SPLIT_BLOCKS, blocks)
        launch_grid(composite, blocks + split * (STEPS.value - 1))(
            lists=frame.of_blocks,
            pixels=frame.of_pixels(started.request),
            split=split,
            closing=len(started.radii),
            **frame.size(started.request),
            image=image,
            alpha=alpha,
            num_warps=1,
        )
        return image, alpha, started.radii, frame

    def backward(
        self,
        frame: TritonFrame,
        gaussians: Gaussians,
        request: RenderRequest,
        g_image: Tensor,
        g_alpha: Tensor | None,
    ) -> Gradients:
        """See `StagedRasterizer`."""
        lifetime, device = Lifetime(), g_image.device
        with torch.cuda.device_of(g_image):
            scratch = self._scratch.lease(lifetime, device)
            return self.differentiate(
                frame,
                gaussians,
                request,
                g_image,
                g_alpha,
                scratch,
                fresh_on(device),
                [torch.zeros_like(tensor) for tensor in gaussians.tensors().values()],
            )

    def differentiate(
        self,
        frame: TritonFrame,
        gaussians: Gaussians,
        request: RenderRequest,
        g_image: Tensor,
        g_alpha: Tensor | None,
        scratch: Workspace,
        allocate: Allocate,
        gradients: list[Tensor],
    ) -> Gradients:
        """Compute the gradients of Gaussians that are seen into the six ``gradients``.

        Others, and those of harmonics above the degree, are not changed.
        """
        lists, projected, count = frame.lists, frame.projected, len(gaussians)
        absolute = request.absolute
        rows = scratch.take("rows", lists.room.pairs * ROW.value, torch.float32)
        last_slots = scratch.take("last_slots", frame.blocks, torch.int64)
        inner = count_borders(lists.room.pairs)
        launch_grid(composite_backward, inner + frame.blocks)(
            lists=frame.of_blocks,
            pixels=frame.of_pixels(request),
            slots=lists.slots,
            blocks=frame.blocks,
            inner=inner,
            closing=count,
            **frame.size(request),
            last_slots=last_slots,
            g_image=g_image,
            g_alpha=g_image if g_alpha is None else g_alpha,
            rows_out=rows,
            HAS_ALPHA=g_alpha is not None,
            ABSOLUTE=absolute is not None,
            num_warps=1,
        )
        _sum_units(frame, last_slots, rows)
        g_screen = allocate("g_screen", (count, 2), torch.float32)
        g_extra = None
        if request.extra is not None:
            g_extra = allocate("g_extra", (count, *self.extras[request.extra]), torch.float32)
        # An output that is not wanted has no memory; its pointer is any other, and is not used.
        launch(backproject, count, 128)(
            gaussians=Parameters(**gaussians.tensors()),
            count=count,
            camera=frame.view,
            projected=projected,
            record_ints=projected.records.view(torch.int32),
            found=frame.units,
            **lists.room._asdict(),
            rows=rows,
            gradients=Parameters(*gradients),
            g_screen=g_screen,
            g_absolute=g_screen if absolute is None else absolute,
            g_extra=g_screen if g_extra is None else g_extra,
            DEGREE=request.degree,
            ABSOLUTE=absolute is not None,
            EXTRA=None if request.extra is None else EXTRA_KERNELS[request.extra],
        )
        return Gradients(gradients, g_screen, g_extra)

    def footprint(
        self,
        frame: TritonFrame,
        gaussians: Gaussians,
        request: RenderRequest,
        values: Tensor | None = None,
    ) -> Footprint:
        """See ``raster.base.RenderOutput``."""
        lifetime = Lifetime()
        with torch.cuda.device_of(gaussians.means):
            count, device = len(gaussians), gaussians.means.device
            scratch = self._scratch.lease(lifetime, device)
            covered = torch.zeros(count, dtype=torch.int32, device=device)
            sums, distances = torch.zeros(2, count, device=device)
            given = sums if values is None else values.detach().float().contiguous()
            # ``cover`` fills 3 of 16 columns
            rows = scratch.take("rows", frame.lists.room.pairs * ROW.value, torch.float32)
            last_slots = scratch.take("last_slots", frame.blocks, torch.int64)
            launch_grid(cover, frame.blocks)(
                lists=frame.of_blocks,
                **frame.size(request),
                slots=frame.lists.slots,
                last_slots=last_slots,
                values=given,
                rows_out=rows,
                HAS_VALUES=values is not None,
                num_warps=1,
            )
            _sum_units(frame, last_slots, rows)
            launch(sum_cover, count, 128)(
                row_counts=frame.projected.row_counts,
                found=frame.units,
                count=count,
                rows=rows,
                covered=covered,
                sums=sums,
                distances=distances,
            )
            return Footprint(covered, view_depths(gaussians, request.camera), sums, distances)


def fresh_on(device: torch.device) -> Allocate:
    """Outputs in memory of their own."""
    return lambda _, shape, dtype: torch.empty(shape, dtype=dtype, device=device)


def camera_numbers(camera: Camera, device: torch.device) -> Tensor:
    """`CameraNumbers` of ``camera``, [24] float32 on ``device``; the host does not wait."""
    return upload([*map(float, CameraNumbers.of(camera))], device)


def _sum_units(frame: TritonFrame, last_slots: Tensor, rows: Tensor) -> None:
    """Sum the ``rows`` of the pairs of each unit, in place."""
    room = frame.lists.room
    launch(sum_units, room.units, 32)(
        found=frame.units,
        last_slots=last_slots,
        **room._asdict(),
        rows=rows,
    )
