"""Training steps on a GPU without autograd, recorded as CUDA graphs.

Most of a step's time on the host is Python: autograd, over a hundred operations of torch, seventeen
launches of Triton. Between two refinements every step launches the same kernels on the same memory,
so `DirectStep` records them once and replays them. Whatever changes from step to step is in the
memory of the device: camera, photograph, learning rates.

The sizes of the lists also change. Kernels therefore get room for more entries than the last views
needed. If a view needs still more, its kernels behave as if nothing were seen; the host reads the
real sizes before it uses the result, makes room, and repeats the render. The host reads them while
the device composites, so neither waits for the other. The bits are the same as without recording.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from functools import cached_property, partial
from typing import NamedTuple

import torch
from torch import Tensor

from gsbench.eval.images import replace_ignored
from gsbench.gaussians.trainable import KnownGradients, TrainableGaussians
from gsbench.raster.base import CameraNumbers, RenderOutput
from gsbench.raster.staged import (
    Lifetime,
    Readback,
    RenderRequest,
    make_probe,
    raise_for_values,
)
from gsbench.raster.triton.executor import TritonFrame, TritonRasterizer, camera_numbers
from gsbench.raster.triton.launch import Workspace
from gsbench.raster.triton.lists import UNITS_AT_FIRST, Room, Started, check_pairs
from gsbench.scene.types import Camera
from gsbench.train.adam_triton import TritonAdam
from gsbench.train.loss_triton import TritonLoss

log = logging.getLogger(__name__)

# Room for lists, relative to the largest that was needed. More costs time to sort; less costs
# repeated renders.
MARGIN = 1.2
MOST_SIZES = 4  # of images; each has memory of its own
# Adam's factors of so many steps are in page-locked memory at once. The host is at most two ahead.
FACTORS_KEPT = 4


class Shape(NamedTuple):
    """The properties that two steps with the same launches share, besides the parameters."""

    width: int  # px
    height: int
    degree: int
    absolute: bool
    extra: str | None
    target: torch.dtype
    masked: bool
    further: tuple[bool, ...]  # the parameters by which a regulariser has a gradient


class DirectStep:
    """Renders, measures and differentiates training views; applies Adam (`trainer.FastStep`).

    ``graphs`` turns recording on; without it, the same launches are made one by one. With
    ``visible_only``, Adam updates visible Gaussians only.
    """

    applies_adam = False

    def __init__(
        self,
        rasterizer: TritonRasterizer,
        loss: TritonLoss,
        background: Tensor,
        graphs: bool,
        visible_only: bool = False,
    ) -> None:
        self.rasterizer, self.loss, self.background = rasterizer, loss, background
        self.graphs, self.visible_only = graphs, visible_only
        self.repeats = 0  # renders that were repeated because lists had too little room
        self._memory: dict[tuple[int, int], _Memory] = {}
        self._plan: dict[tuple[int, int], _Plan] = {}
        self._last: _Plan | None = None
        self._cameras: dict[int, tuple[Camera, Tensor]] = {}

    @cached_property
    def pool(self) -> _GraphPool:
        return _GraphPool()

    def step(
        self,
        gaussians: TrainableGaussians,
        camera: Camera,
        target: Tensor,
        degree: int,
        absolute: bool,
        extra: str | None,
        mask: Tensor | None = None,
        regularizer: Tensor | None = None,
    ) -> tuple[RenderOutput, Tensor]:
        """Render ``camera``, and differentiate the loss against ``target`` [H, W, 3].

        Pixels where ``mask`` [H, W, 1] is False do not count. Only the gradient of ``regularizer``
        is computed by autograd. The next step overwrites the memory of the results. Raises
        ValueError for bad values of parameters.
        """
        size = camera.width, camera.height
        further = _gradients(regularizer, gaussians)
        regularized = tuple(gradient is not None for gradient in further)
        shape = Shape(*size, degree, absolute, extra, target.dtype, mask is not None, regularized)
        memory = self._memory_of(size)
        plan = self._plan.get(size)
        if plan is None or not plan.suits(gaussians, shape):
            self._plan.pop(size, None)  # first free the memory of its graphs
            self._last = None
            plan = self._plan[size] = _Plan(self, gaussians, camera, shape, memory)
        self._last = plan
        plan.take(camera, self._numbers(camera), target, mask, further)
        with torch.cuda.device_of(self.background):
            plan.run()
        if regularizer is None:
            return plan.render(), plan.losses
        total = plan.losses[0] + regularizer.detach()
        return plan.render(), torch.cat([plan.losses.to(total), total.view(1)])

    def optimize(self, gaussians: TrainableGaussians) -> None:
        """Apply Adam with the gradients of the last step; replaced parameters are left out."""
        plan = self._last
        assert plan is not None, "optimize follows step"
        states = gaussians.advance(plan.known)
        # After a refinement, a graph would write to the parameters that were replaced.
        if plan.recorded is not None and plan.suits(gaussians, plan.shape):
            plan.replay_adam(plan.recorded.adam)
        else:
            gaussians.apply(plan.known, states)

    def limit_room(self, room: Room) -> None:
        """Give the lists of all sizes no more than ``room``, so that the next render repeats."""
        for size, memory in self._memory.items():
            memory.room = room
            self._plan.pop(size, None)

    def _memory_of(self, size: tuple[int, int]) -> _Memory:
        """The memory for images of ``size``; that of the size not used for longest is freed."""
        memory = self._memory.pop(size, None) or _Memory(self.background.device)
        self._memory[size] = memory  # now the last one
        for oldest in list(self._memory)[:-MOST_SIZES]:
            del self._memory[oldest]
            self._plan.pop(oldest, None)
        return memory

    def _numbers(self, camera: Camera) -> Tensor:
        """The numbers of ``camera`` on the device; kept, since training views come back."""
        # A freed camera's id may come back for another, so the camera is kept and compared.
        known = self._cameras.get(id(camera))
        if known is None or known[0] is not camera:
            known = camera, camera_numbers(camera, self.background.device)
            self._cameras[id(camera)] = known
        return known[1]


def _gradients(term: Tensor | None, gaussians: TrainableGaussians) -> list[Tensor | None]:
    """The gradients of ``term`` [] by all parameters; None for those that it does not depend on."""
    leaves = gaussians.values.tensors().values()
    if term is not None and term.requires_grad:
        # Not `torch.autograd.grad`: a densifier may have parameters of its own.
        term.backward()
    found = [leaf.grad for leaf in leaves]
    for leaf in leaves:
        leaf.grad = None
    return found


class _Memory:
    """Memory of steps with one size of image, and the room for their lists."""

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self.kept, self.scratch, self.outputs = (Workspace(device) for _ in range(3))
        self.room: Room | None = None  # None: not known yet

    def allocate(self, name: str, shape: tuple[int, ...], dtype: torch.dtype) -> Tensor:
        """The tensor called ``name``, always at the same place, until it grows."""
        return self.outputs.take(name, math.prod(shape), dtype).view(shape)


Graph = Callable[[], None]  # replays its launches


class Phases(NamedTuple):
    """A step in three parts: up to the sizes of the lists, up to the gradients, and Adam."""

    project: Graph
    composite: Graph
    adam: Graph


class _Plan:
    """The `Phases` of steps with the same parameters and `Shape`, launched or recorded."""

    def __init__(
        self,
        owner: DirectStep,
        gaussians: TrainableGaussians,
        camera: Camera,
        shape: Shape,
        memory: _Memory,
    ) -> None:
        self.owner, self.shape, self.memory, self.camera = owner, shape, memory, camera
        self.parameters = list(gaussians.values.tensors().values())
        self.states = list(gaussians.adam.values())
        self.values = gaussians.values.detach()
        owner.rasterizer.check(self.values)
        count, allocate = len(self.values), memory.allocate
        # inputs of a step: a graph always reads the same memory, so they are copied to it
        size = camera.height, camera.width
        self.view = allocate("view", (len(CameraNumbers._fields),), torch.float32)
        self.target = allocate(f"target_{shape.target}", (*size, 3), shape.target)
        self.mask = allocate("mask", (*size, 1), torch.bool) if shape.masked else None
        shapes = {name: tuple(tensor.shape) for name, tensor in self.values.tensors().items()}
        self.further = [
            allocate(f"further_{name}", shapes[name], torch.float32) if wanted else None
            for name, wanted in zip(shapes, shape.further, strict=True)
        ]
        self.factors = allocate("factors", (len(self.parameters), 2), torch.float32)
        self.factors_on_host = torch.empty(
            (FACTORS_KEPT, *self.factors.shape), pin_memory=memory.device.type == "cuda"
        )
        # results, which the next step overwrites
        self.losses = allocate("losses", (3,), torch.float32)
        self.g_image = allocate("g_image", (*size, 3), torch.float32)
        self.gradients = [allocate(f"g_{name}", own, torch.float32) for name, own in shapes.items()]
        absolute = allocate("g_absolute", (count, 2), torch.float32) if shape.absolute else None
        self.request = RenderRequest(
            camera, shape.degree, owner.background, absolute, shape.extra, Lifetime()
        )
        self.screen_points = torch.zeros_like(self.values.means[:, :2], requires_grad=True)
        self.probe = make_probe(owner.rasterizer, shape.extra, self.values.means)
        # The first step compiles kernels and allocates memory, which must not be recorded.
        self.warm = False
        self.recorded: Phases | None = None
        # of the last phases
        self.started: Started
        self.finished: tuple[Tensor, Tensor, Tensor, TritonFrame]
        self.known: KnownGradients

    def suits(self, gaussians: TrainableGaussians, shape: Shape) -> bool:
        """Return whether a step with these parameters and this shape has these launches.

        A plan with a mask also serves views without one: their masks are True everywhere.
        """
        current = gaussians.values.tensors().values()
        return self.shape in (shape, shape._replace(masked=True)) and all(
            own is now for own, now in zip(self.parameters, current, strict=True)
        )

    def take(
        self,
        camera: Camera,
        numbers: Tensor,
        target: Tensor,
        mask: Tensor | None,
        further: list[Tensor | None],
    ) -> None:
        """Copy what differs from step to step to the memory that the launches read."""
        self.camera = camera
        self.view.copy_(numbers, non_blocking=True)
        self.target.copy_(target, non_blocking=True)
        if self.mask is not None and mask is not None:
            self.mask.copy_(mask)
        elif self.mask is not None:  # other views of this size have one
            self.mask.fill_(True)
        for own, gradient in zip(self.further, further, strict=True):
            if own is not None and gradient is not None:
                own.copy_(gradient)

    def run(self) -> None:
        """Render and differentiate; again, with more room, while the lists do not fit."""
        if self.memory.room is None:
            self._measure_room()
        while True:
            if self.warm and self.recorded is None and self.owner.graphs:
                self._record()
            self.warm = True
            phases = self.recorded or self._phases
            phases.project()
            sizes = Readback(self.started.units.status)
            phases.composite()
            units, pairs, bad = sizes.values().tolist()
            if bad:
                raise_for_values(self.values, self.owner.background)
            room = self._room
            if units <= room.units and pairs <= room.pairs:
                return
            # If the units had no room, the number of pairs is not known, but is larger.
            self._make_room(units, max(pairs, room.pairs))
            self.owner.repeats += 1

    def render(self) -> RenderOutput:
        image, alpha, radii, frame = self.finished
        # The plan's own request has the camera of its first step.
        request = self.request._replace(camera=self.camera)
        footprint = partial(self.owner.rasterizer.footprint, frame, self.values, request)
        absolute, probe = self.request.absolute, self.probe
        return RenderOutput(image, alpha, radii, self.screen_points, absolute, footprint, probe)

    def replay_adam(self, adam: Graph) -> None:
        """Apply the recorded ``adam`` with the present rates and step counts."""
        host = self.factors_on_host[self.states[0].step % FACTORS_KEPT]
        host.numpy()[:] = [state.factors for state in self.states]
        self.factors.copy_(host, non_blocking=True)
        adam()

    @property
    def _phases(self) -> Phases:
        return Phases(self._project, self._composite, self._adam)

    @property
    def _room(self) -> Room:
        assert self.memory.room is not None
        return self.memory.room

    def _project(self) -> None:
        room, memory = self.memory.room, self.memory
        capacity = UNITS_AT_FIRST * len(self.values) if room is None else room.units
        self.started = self.owner.rasterizer.start(
            self.values,
            self.request,
            self.view,
            memory.kept,
            memory.scratch,
            max(capacity, 1),
            memory.allocate,
        )

    def _composite(self) -> None:
        rasterizer, loss, memory = self.owner.rasterizer, self.owner.loss, self.memory
        self.finished = rasterizer.finish(self.started, self._room)
        image, _, radii, frame = self.finished
        image = replace_ignored(image, self.target, self.mask)
        loss.launch(image, self.target, self.losses, self.g_image, memory.scratch)
        if self.mask is not None:
            self.g_image.masked_fill_(~self.mask, 0.0)
        found = rasterizer.differentiate(
            frame,
            self.values,
            self.request,
            self.g_image,
            None,
            memory.scratch,
            memory.allocate,
            self.gradients,
        )
        self.screen_points.grad = found.screen
        if self.probe is not None:
            self.probe.grad = found.extra
        self.known = KnownGradients(
            self.parameters,
            self.gradients,
            self.further,
            frame.projected.row_counts,
            radii if self.owner.visible_only else None,
            self.shape.degree,
        )

    def _adam(self) -> None:
        updates = self.known.updates(self.states)
        known = self.known
        TritonAdam().launch(updates, self.factors[: len(updates)], known.seen, known.visible)

    def _measure_room(self) -> None:
        """Find the sizes of the lists of this view, and make room for them."""
        self._project()
        while True:
            units, pairs, _ = Readback(self.started.units.status).values().tolist()
            if units <= len(self.started.units.widths):
                break
            self.started.find_units(2 * units)
        self._make_room(units, pairs)

    def _make_room(self, units: int, pairs: int) -> None:
        check_pairs(pairs)
        known = self.memory.room or Room(1, 1)
        self.memory.room = Room(
            max(known.units, int(MARGIN * units) + 1), max(known.pairs, int(MARGIN * pairs) + 1)
        )
        # The graphs launch with the old room. The next step may allocate: it is not recorded yet.
        self.recorded, self.warm = None, False

    def _record(self) -> None:
        """Record the phases. If CUDA refuses, steps are never recorded again."""
        try:
            self.recorded = Phases(*map(self.owner.pool.record, self._phases))
        except torch.OutOfMemoryError:
            raise
        except RuntimeError as error:
            log.warning(
                "training steps are not recorded as CUDA graphs, so they are slower: %s",
                str(error).strip().splitlines()[0],
            )
            self.owner.graphs = False


class _GraphPool:
    """Records graphs, which share a pool of memory."""

    def __init__(self) -> None:
        self._stream = torch.cuda.Stream()
        self._handle = torch.cuda.graph_pool_handle()
        # torch frees the pool with its last graph, so one must stay.
        self._keeper = self._capture(lambda: torch.empty(1, device="cuda").zero_())

    def record(self, launches: Callable[[], object]) -> Graph:
        return self._capture(launches).replay

    def _capture(self, launches: Callable[[], object]) -> torch.cuda.CUDAGraph:
        # `torch.cuda.graph` would also collect garbage and empty the cache of the allocator.
        graph = torch.cuda.CUDAGraph()
        self._stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(self._stream):
            # "thread_local": other threads, such as that of checkpoints, may use the GPU meanwhile.
            graph.capture_begin(pool=self._handle, capture_error_mode="thread_local")
            try:
                launches()
            finally:
                graph.capture_end()
        torch.cuda.current_stream().wait_stream(self._stream)
        return graph
