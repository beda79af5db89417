"""The training loop: the schedule of 3DGS, with any rasterizer and any densifier."""

import logging
import math
import time
from collections.abc import Callable, Collection, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from inspect import signature
from pathlib import Path
from typing import Any, Protocol

import torch
from torch import Tensor

from gsbench.densify import Densifier, DensifyContext, NoDensifier, Refinement
from gsbench.errors import InputError, TrainingError
from gsbench.eval.images import as_unit_range, replace_ignored
from gsbench.events import FEWEST_ROUNDS, RefineEvent, few_rounds
from gsbench.gaussians.model import MAX_SH_DEGREE, Gaussians
from gsbench.gaussians.ply import write_ply
from gsbench.gaussians.trainable import StepAll, TrainableGaussians
from gsbench.raster import Rasterizer
from gsbench.raster.base import RenderOutput
from gsbench.raster.depth import render_depth
from gsbench.raster.executors import find_executor, lacks
from gsbench.runs.layout import CURVES, EVENTS, HISTOGRAMS
from gsbench.scene.beside import DEPTH
from gsbench.scene.types import Camera, Scene
from gsbench.system.resources import CLOCK, free_bytes
from gsbench.system.stopping import deferred, requested
from gsbench.train.checkpoint import CheckpointWriter, load_checkpoint
from gsbench.train.ideas import NO_IDEAS, Ideas, Step, TrainedView, scheduled, value_of
from gsbench.train.loss import PhotometricLoss
from gsbench.train.options import TrainConfig
from gsbench.train.records import (
    PHOTOMETRIC,
    GrowthWatch,
    LossLog,
    append,
    drop_after,
    volume_histogram,
)
from gsbench.train.views import (
    CameraOrder,
    SceneViews,
    Targets,
    generators,
)

log = logging.getLogger(__name__)

SHARE_FOR_IMAGES = 0.5  # of a GPU's free memory; the rest is for the model and its renders


@dataclass(frozen=True)
class Status:
    """Values for a progress bar."""

    step: int
    loss: float
    num_gaussians: int
    iterations_per_second: float


class FastStep(Protocol):
    """Training steps without autograd, with the bits of those by autograd."""

    applies_adam: bool  # within ``step``: nothing can look at the model between both

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
        """Render ``camera`` and differentiate the loss; return the render and loss, L1, SSIM.

        ``regularizer`` [] is added to the loss; its sum with it is a fourth number.
        """
        ...

    def optimize(self, gaussians: TrainableGaussians) -> None:
        """Apply Adam with the gradients of the last step, unless ``step`` has."""
        ...


class Trainer:
    """Trains Gaussians on the training views of a scene.

    All random numbers come from generators seeded by ``seed``. ``run`` writes metrics, events and
    checkpoints into a folder and resumes from the newest checkpoint there. On the CPU, a resumed
    run gives the same bits as an uninterrupted one. A signal to stop (see
    `gsbench.system.stopping`) ends the run after the current iteration, with a checkpoint. At the
    iterations ``snapshot_at``, the model is also written to `snapshot_file`. Making a trainer
    raises InputError if the rasterizer lacks an output that the densifier needs.
    """

    def __init__(
        self,
        scene: Scene,
        initial: Gaussians,
        densifier: Densifier,
        rasterizer: Rasterizer,
        options: TrainConfig,
        seed: int,
        snapshot_at: Collection[int] = (),
        ideas: Ideas = NO_IDEAS,
    ) -> None:
        needs = densifier.needs_footprint, densifier.needs_extra
        if lack := lacks(rasterizer.name, rasterizer, *needs):
            raise InputError(f"{type(densifier).__name__} {lack}")
        if options.visible_adam and ideas.optimizer is not None:
            raise InputError(
                "train.visible_adam is a setting of Adam: leave it out with train.optimizer"
            )
        self.scene, self.densifier, self.rasterizer = scene, densifier, rasterizer
        self.options, self.ideas, self.snapshot_at = options, ideas, frozenset(snapshot_at)
        self.device = initial.means.device
        readers = [densifier, *ideas.named.values()]
        self.needs_depth = any(getattr(part, "needs_depth", False) for part in readers)
        self.shows_view = "view" in signature(densifier.observe).parameters
        initial = densifier.prepare(initial)
        color = [*options.background]
        self.background = torch.tensor(color, dtype=torch.float32, device=self.device)  # [3]
        self.loss = PhotometricLoss(options.ssim_weight, torch.get_num_threads())
        self.fast, step_all = fast_steps(rasterizer, self.loss, options, self.background)
        self.used: FastStep | None = None  # by this iteration
        replaced = ideas.reads_renders or ideas.optimizer is not None
        if options.by_autograd or replaced or self.needs_depth:
            self.fast = None
        self.gaussians = TrainableGaussians(
            initial, options, scene.extent, step_all, ideas.optimizer
        )
        self.rngs = generators(seed)
        self.order = CameraOrder(len(scene.train), self.rngs["cameras"])
        self.step, self.seconds = 0, 0.0
        of_loss = PHOTOMETRIC if ideas.loss is None else ("loss",)
        self.losses = LossLog([*of_loss, *(f"term_{one.label}" for one in ideas.terms)])
        self.growth = GrowthWatch()
        self.context = self._take_views()
        densifier.begin(initial, self.context)

    def _take_views(self) -> DensifyContext:
        """Take the training views to the device; return what the densifier may know of them."""
        views, free = self.scene.train, free_bytes(self.device)
        budget = None if free is None else int(SHARE_FOR_IMAGES * free)
        self.targets = Targets(views, self.device, budget)
        degree = partial(sh_degree_at, self.options)
        shown = SceneViews(views, self.targets, self.rasterizer, self.background, self.loss, degree)
        is_white = bool((self.background == 1).all())
        return DensifyContext(self.scene.extent, is_white, self.device, shown)

    def run(
        self, folder: Path, on_status: Callable[[Status], None] = lambda status: None
    ) -> Gaussians:
        """Train to the last iteration or the end of the time budget; return detached Gaussians.

        Raises TrainingError if a parameter or the loss is out of range, if no Gaussian is left, or
        if the device's memory is full.
        """
        self._resume(folder)
        if self.snapshot_at:
            (folder / snapshot_file(0)).parent.mkdir(exist_ok=True)
        writer = CheckpointWriter(folder, background=self.device.type != "cpu")
        # Signals wait for the end of the iteration: half a step could not be resumed.
        with closing(writer), deferred(), self._explained(folder):
            self._loop(folder, writer, on_status)
        rounds = (folder / EVENTS).read_bytes().count(b"\n")
        if not isinstance(self.densifier, NoDensifier) and rounds < FEWEST_ROUNDS:
            log.warning("%s", few_rounds(type(self.densifier).__name__, rounds, self.step))
        return self.gaussians.values.detach()

    def _loop(
        self, folder: Path, writer: CheckpointWriter, on_status: Callable[[Status], None]
    ) -> None:
        """Iterate to the end, a signal to stop or the end of the time budget; write all files."""
        options = self.options
        first_step, started, earlier_seconds = self.step, _clock(), self.seconds
        last_checkpoint = time.monotonic()
        with (folder / CURVES).open("a") as metrics, (folder / EVENTS).open("a") as events:
            while self.step < options.iterations:
                # Before the refinement: the losses of this iteration are those of this model.
                counts = {"num_gaussians": len(self.gaussians)}
                event = self.iterate(folder)
                self.seconds = earlier_seconds + _clock() - started
                out_of_time = self.seconds >= (options.max_seconds or math.inf)
                last = self.step == options.iterations or out_of_time
                if event is not None:
                    append(events, event.as_dict())
                if self.step in options.volume_histogram:
                    with (folder / HISTOGRAMS).open("a") as stream:
                        log_scales = self.gaussians.values.log_scales.detach()
                        append(stream, volume_histogram(self.step, log_scales))
                if self.step % options.log_every == 0 or last:
                    record = self.losses.wait() | counts | {"sh_degree": self.sh_degree}
                    # Measure again: on a GPU, `wait` has waited for queued work.
                    self.seconds = earlier_seconds + _clock() - started
                    rate = (self.step - first_step) / max(self.seconds - earlier_seconds, 1e-9)
                    append(metrics, record | {"seconds": round(self.seconds, 3)})
                    on_status(Status(self.step, self.losses.smoothed, len(self.gaussians), rate))
                minutes = (time.monotonic() - last_checkpoint) / 60
                due = (
                    self.step % options.checkpoint_every == 0
                    or minutes >= options.checkpoint_minutes
                )
                stop = requested()
                if stop or (due and not last):
                    writer.save(self.step, self._state())
                    last_checkpoint = time.monotonic()
                if stop:
                    writer.finish()
                    log.info("stopping at iteration %d, with a checkpoint", self.step)
                if last or stop:
                    break

    def iterate(self, folder: Path) -> RefineEvent | None:
        """Run one iteration; return the event of its refinement, if there was one.

        The order is that of 3DGS: rates, SH degree, render, backward, statistics, refinement, Adam.
        The losses are added to ``losses``. Snapshots are written below ``folder``. Raises
        TrainingError if a parameter is out of range or no Gaussian is left.
        """
        self.step += 1
        step, options = self.step, self.options
        self.gaussians.set_step(step)
        if self.ideas.schedule is not None:
            base = self.gaussians.base_rates(self.gaussians.position_rate)
            for name, rate in scheduled(self.ideas.schedule, step, base).items():
                self.gaussians.set_rate(name, rate)
        index = self.order.next()
        try:
            render, scalars = self._differentiate(index)
        except ValueError as error:  # the rasterizer rejects a parameter that is out of range
            raise TrainingError(f"iteration {step}: {error}; {_last_state(folder)}") from error
        self.losses.add(step, scalars)
        # The last iteration ends here: 3DGS saves its model before it refines and steps.
        if step == options.iterations:
            return None
        if step in self.snapshot_at:
            write_ply(self.gaussians.values, folder / snapshot_file(step))
        more = {"view": self._view(index)} if self.shows_view else {}
        self.densifier.observe(step, render, **more)
        if options.step_after_refine:
            self._optimize(render)
        event = self.densifier.refine(step, self.gaussians, self.rngs["densify"])
        if event is not None:
            self.growth.observe(event)
        # As in 3DGS, parameters that the refinement has replaced have no gradient: no step.
        if not options.step_after_refine:
            self._optimize(render)
        self.densifier.after_step(step, self.gaussians, self.rngs["densify"])
        if len(self.gaussians) == 0:
            raise TrainingError(
                f"no Gaussian was left after iteration {step}: pruning thresholds or a decay are "
                "too high"
            )
        return event

    def _differentiate(self, index: int) -> tuple[RenderOutput, Tensor]:
        """Render the training view ``index`` and compute the gradients of its loss.

        Returns the render, and the scalars for ``losses``.
        """
        camera = self.scene.train[index].camera
        target, mask = self.targets.get(index), self.targets.mask(index)
        regularizer = self.densifier.regularizer(self.gaussians.values)
        self.used = self.fast
        if self.fast is not None and self.fast.applies_adam:
            free = regularizer is None and mask is None and self._nobody_looks()
            self.used = self.fast if free else None
        if self.used is not None:
            return self.used.step(
                self.gaussians,
                camera,
                target,
                self.sh_degree,
                self.densifier.needs_absolute_gradient,
                self.densifier.needs_extra,
                mask,
                regularizer,
            )
        render = self.render(index)
        depth_points = self._add_depth(render, camera)
        image = replace_ignored(render.image, target, mask)
        total, scalars = self._loss(render, index, image, target)
        total.backward()
        if depth_points is not None and depth_points.grad is not None:
            # Terms on depth move the projected means, too: densifiers see the sum.
            of_image = render.screen_points.grad
            render.screen_points.grad = depth_points.grad + (0 if of_image is None else of_image)
        self.ideas.optimize()
        if regularizer is not None:
            # Direct steps, too, add its whole gradient to that of the loss: the same bits.
            if regularizer.requires_grad:
                regularizer.backward()
            total = total + regularizer
            scalars.append(total)
        return render, torch.stack([scalar.detach().to(total) for scalar in scalars])

    def _loss(
        self, render: RenderOutput, index: int, image: Tensor, target: Tensor
    ) -> tuple[Tensor, list[Tensor]]:
        """The sum to differentiate, and the scalars of `LossLog`, for a render with ``image``."""
        ideas = self.ideas
        if not ideas.reads_renders:
            loss, *shown = self.loss(image, target)
            return loss, [loss, *shown]
        step = Step(
            self.step,
            replace(render, image=image),
            self._view(index),
            self.gaussians.values,
            self.rngs["ideas"],
        )
        if ideas.loss is None:
            total, *shown = self.loss(image, target)
        else:
            total, shown = value_of(ideas.loss, step, "train.loss"), []
        scalars = [total, *shown]
        for one in ideas.terms:
            value = value_of(one.term, step, f"the term {one.label} of train.terms")
            total = total + one.weight * value
            scalars.append(value)
        return total, scalars

    def _add_depth(self, render: RenderOutput, camera: Camera) -> Tensor | None:
        """Add the depth to a render, if a part asks for it.

        Returns the projected means [N, 2] that get the gradient of the depth.
        """
        if not self.needs_depth:
            return None
        render.depth, of_depth = render_depth(self.rasterizer, self.gaussians.values, camera)
        return of_depth.screen_points

    def _view(self, index: int) -> TrainedView:
        """The training view ``index`` as ideas see it."""
        view = self.scene.train[index]
        beside = {
            name: torch.from_numpy(pixels).to(self.device) for name, pixels in view.beside.items()
        }
        return TrainedView(
            view.name,
            view.camera,
            as_unit_range(self.targets.get(index), torch.float32),
            self.targets.mask(index),
            beside.pop(DEPTH, None),
            beside,
        )

    def render(self, index: int) -> RenderOutput:
        """Render the training view ``index`` as in the current iteration, with gradients."""
        # Passed only if needed: a user's rasterizer may not have this argument.
        wanted = self.densifier.needs_extra
        extra = {} if wanted is None else {"extra": wanted}
        return self.rasterizer.render(
            self.gaussians.values,
            self.scene.train[index].camera,
            self.sh_degree,
            self.background,
            self.densifier.needs_absolute_gradient,
            **extra,
        )

    @contextmanager
    def _explained(self, folder: Path) -> Iterator[None]:
        """Turn errors of a loss that is not finite and of full memory into TrainingError.

        The message names the last good state.
        """
        try:
            yield
        except FloatingPointError as error:
            raise TrainingError(f"{error}; {_last_state(folder)}") from error
        except torch.OutOfMemoryError as error:
            raise TrainingError(
                f"iteration {self.step}: {self.device} has no memory left at "
                f"{len(self.gaussians):,} Gaussians; {_last_state(folder)}; lower "
                "densify.max_gaussians, scene.max_size or the number of trials at once "
                "(launch.parallel), or end other programs on that device"
            ) from error

    @property
    def sh_degree(self) -> int:
        return sh_degree_at(self.options, self.step)

    def _nobody_looks(self) -> bool:
        """Return whether nothing sees the model between the backward pass and Adam.

        Only gsbench's own densifiers are known to look at it in no other way than these.
        """
        densifier, step = self.densifier, self.step
        if (
            not type(densifier).__module__.startswith("gsbench.")
            or step == self.options.iterations
            or step in self.snapshot_at
            or self.shows_view
            or densifier.needs_footprint
            or densifier.needs_extra is not None
        ):
            return False
        event = RefineEvent(step=step, before=len(self.gaussians))
        return not densifier.rules(Refinement(step, self.gaussians, self.rngs["densify"], event))

    def _optimize(self, render: RenderOutput) -> None:
        if self.used is not None:
            self.used.optimize(self.gaussians)
            return
        self.gaussians.optimizer_step(
            self.sh_degree, render.visible if self.options.visible_adam else None
        )

    def _state(self) -> dict[str, Any]:
        self.losses.wait()  # raises if a loss was not finite: such a state must not be saved
        return {
            "step": self.step,
            "seconds": self.seconds,
            "smoothed_loss": self.losses.smoothed,
            "gaussians": self.gaussians.state_dict(),
            "densifier": self.densifier.state_dict(),
            "rngs": {name: rng.get_state() for name, rng in self.rngs.items()},
            "ideas": self.ideas.state_dict(),
            "remaining_views": list(self.order.remaining),
        }

    def _resume(self, folder: Path) -> None:
        state = load_checkpoint(folder)
        if state is not None:
            self.step = state["step"]
            self.seconds = state["seconds"]
            self.losses.smoothed = state["smoothed_loss"]
            self.gaussians.load_state_dict(state["gaussians"])
            self.ideas.load_state_dict(state["ideas"])
            self.densifier.load_state_dict(state["densifier"], self.context)
            for name, rng in self.rngs.items():
                rng.set_state(state["rngs"][name])
            self.order.remaining = list(state["remaining_views"])
            log.info("going on from iteration %d", self.step)
        for name in (CURVES, EVENTS, HISTOGRAMS):
            drop_after(folder / name, self.step)


def _clock() -> float:
    """Seconds, without those in which kernels were compiled."""
    return time.perf_counter() - CLOCK.seconds


def _last_state(folder: Path) -> str:
    return f"the last good state is the newest checkpoint in {folder}"


def snapshot_file(step: int) -> str:
    """The path, below a training's folder, of the model at iteration ``step``.

    As in 3DGS, the model is saved before the refinement and the optimiser step.
    """
    return f"snapshots/iteration_{step}.ply"


def fast_steps(
    rasterizer: Rasterizer, loss: PhotometricLoss, options: TrainConfig, background: Tensor
) -> tuple[FastStep | None, StepAll | None]:
    """Make fast steps, if rasterizer and loss are those that have them, and compiled Adam."""
    device = background.device.type
    if device == "cpu":
        from gsbench.raster.cpu import CpuRasterizer
        from gsbench.train.adam_cpu import CpuAdam, FusedStep
        from gsbench.train.loss_cpu import CompiledLoss

        adam = CpuAdam(torch.get_num_threads())
        compiled = loss.implementation(device)
        # a user's subclass may render otherwise
        if type(rasterizer) is CpuRasterizer and isinstance(compiled, CompiledLoss):
            fused = FusedStep(rasterizer, compiled, background)
            return None if options.visible_adam else fused, adam
        return None, adam
    if device != "cuda" or find_executor("triton").obstacle(device) is not None:
        return None, None
    # They import Triton.
    from gsbench.raster.triton.executor import TritonRasterizer
    from gsbench.train.adam_triton import TritonAdam
    from gsbench.train.direct import DirectStep
    from gsbench.train.loss_triton import TritonLoss

    kernels = loss.implementation(device)
    direct = None
    ours = rasterizer if type(rasterizer) is TritonRasterizer else None
    if ours and ours.direct_steps and isinstance(kernels, TritonLoss):
        direct = DirectStep(ours, kernels, background, True, options.visible_adam)
    return direct, TritonAdam()


def sh_degree_at(options: TrainConfig, step: int) -> int:
    """The degree of spherical harmonics at iteration ``step``."""
    return min(MAX_SH_DEGREE, step // options.sh_interval)
