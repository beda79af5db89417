"""The training views: their order, their images on the device, their sizes, and renders of them.

A training may start on small pictures (DashGaussian, arXiv 2503.18402).
"""

import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsbench.eval.images import as_unit_range, replace_ignored
from gsbench.eval.ssim import ssim_map
from gsbench.gaussians.model import Gaussians
from gsbench.raster import Rasterizer, RenderOutput
from gsbench.scene.beside import resize_mask
from gsbench.scene.types import Camera, View
from gsbench.train.loss import PhotometricLoss
from gsbench.train.options import TrainConfig
from gsbench.words import readable_bytes

log = logging.getLogger(__name__)

# every random number of a training comes from one of these streams
STREAMS = ("cameras", "densify", "ideas")


def generators(seed: int) -> dict[str, torch.Generator]:
    """A CPU generator for each of `STREAMS`, independent of each other and of other seeds."""
    found = {}
    for number, name in enumerate(STREAMS):
        (state,) = np.random.SeedSequence([seed, number]).generate_state(1, np.uint64)
        # 63 bits: torch takes seeds below 2^63.
        found[name] = torch.Generator().manual_seed(int(state >> np.uint64(1)))
    return found


class CameraOrder:
    """Draws training views at random without replacement; when all were drawn, it starts again."""

    def __init__(self, num_views: int, rng: torch.Generator) -> None:
        self.num_views = num_views
        self.rng = rng
        self.remaining: list[int] = []

    def next(self) -> int:
        if not self.remaining:
            self.remaining = torch.randperm(self.num_views, generator=self.rng).tolist()
        return self.remaining.pop()


class Targets:
    """The images of ``views`` on ``device``, [H, W, 3] uint8 each.

    If all images fit into ``budget`` bytes (None: no limit), they stay on the device; otherwise
    `get` copies each. On a CPU they share memory with the views. Masks, which need a third of the
    memory of images, always stay on the device.
    """

    def __init__(
        self, views: Sequence[View], device: torch.device, budget: int | None = None
    ) -> None:
        self._images = [torch.from_numpy(view.image) for view in views]
        self._masks = [
            None if view.mask is None else torch.from_numpy(view.mask).to(device)[..., None]
            for view in views
        ]
        self._device = device
        self.bytes = sum(image.numel() for image in self._images)
        self.resident = budget is None or self.bytes <= budget
        if self.resident:
            self._images = [image.to(device) for image in self._images]
        else:
            log.info(
                "the %d training images (%s) leave too little memory on %s: each is copied when "
                "it is needed",
                len(self._images),
                readable_bytes(self.bytes),
                device,
            )

    def mask(self, index: int) -> Tensor | None:
        """The mask of view ``index``, [H, W, 1] on the device, True where a pixel counts.

        None if all pixels count.
        """
        return self._masks[index]

    def get(self, index: int) -> Tensor:
        """The image of view ``index`` on the device.

        The copy may not be complete: use the image only in work that is queued after this call.
        """
        image = self._images[index]
        if self.resident or self._device.type != "cuda":
            return image
        # A copy is asynchronous only from page-locked memory.
        return image.pin_memory().to(self._device, non_blocking=True)


@dataclass(frozen=True)
class SceneViews:
    """Training views for densifiers, rendered and measured as in training.

    This class implements `gsbench.densify.scores.TrainingViews`. Pixels that a mask ignores are
    replaced by those of the photograph, so they have no error and no gradient.
    """

    views: Sequence[View]
    targets: Targets
    rasterizer: Rasterizer
    background: Tensor
    photometric_loss: PhotometricLoss
    sh_degree: Callable[[int], int]  # degree of spherical harmonics at an iteration

    def __len__(self) -> int:
        return len(self.views)

    def image(self, index: int) -> Tensor:
        return self.targets.get(index)

    def render(self, index: int, gaussians: Gaussians, step: int) -> RenderOutput:
        camera, degree = self.views[index].camera, self.sh_degree(step)
        render = self.rasterizer.render(gaussians, camera, degree, self.background)
        mask = self.targets.mask(index)
        if mask is None:
            return render
        return replace(render, image=replace_ignored(render.image, self.targets.get(index), mask))

    def dissimilarity(self, index: int, image: Tensor) -> Tensor:
        target = as_unit_range(self.targets.get(index), image.dtype)
        return (1 - ssim_map(image, target).mean(0)).clamp_min(0)

    def loss(self, index: int, image: Tensor) -> Tensor:
        return self.photometric_loss(image, self.targets.get(index))[0].detach()


# From the authors' code (utils/schedule_utils.py).
MAX_SCALE = 8.0  # the largest divisor of picture sides
FIRST_SHARE = 1 / 4  # minimum share of each picture's energy at the first size
NUM_POINTS = 32  # number of points of the schedule, equally spaced in energy


@dataclass(frozen=True)
class ScaleSchedule:
    """Divisors of picture sides: ``scales[i]`` at iteration ``begins[i]``, falling to 1."""

    begins: tuple[int, ...]
    scales: tuple[float, ...]

    def at(self, step: int) -> int:
        """The divisor of picture sides at iteration ``step``, rounded down to a whole number.

        Between two points, the area of pictures grows linearly.
        """
        area = np.interp(step, self.begins, [scale**-2 for scale in self.scales])
        return int(area**-0.5 + 1e-9)

    @property
    def full_from(self) -> int:
        """The iteration after which the divisor of picture sides falls below two."""
        first = next(i for i, scale in enumerate(self.scales) if scale < 2)
        return self.begins[max(first - 1, 0)]


def scale_schedule(images: Sequence[NDArray[np.uint8]], until: int) -> ScaleSchedule:
    """The schedule for ``images`` [H, W, 3] from iteration 0 to ``until`` (arXiv 2503.18402).

    A picture whose sides are reduced to a fraction keeps the central window of its spectrum with
    this fraction of the sides. The energy of a size is the sum of the moduli of the Fourier
    transform over this window. The first size has at least a quarter of the energy of every
    picture, but divides sides by at most 8. The points of the schedule are equally spaced in the
    energy averaged over pictures. Their iterations are proportional to the logarithm of energy /
    first energy.
    """
    sides = {side for image in images for side in image.shape[:2]}
    # all fractions from 0 to 1 at which the central window of a spectrum grows by pixels
    gains = [2 * np.arange(side // 2 + 1) / side for side in sides]
    fractions = np.unique(np.concatenate([[0.0, 1.0], *gains]))  # [F]
    curves = np.stack([_window_energies(image, fractions) for image in images])  # [V, F]
    if not (curves[:, -1] > 0).all():  # a black picture has no energy at any size
        return ScaleSchedule((0,), (1.0,))
    largest = min(
        MAX_SCALE,
        *(1 / _first_reaching(fractions, curve, FIRST_SHARE * curve[-1]) for curve in curves),
    )
    mean = curves.mean(0)
    first, whole = float(mean[fractions <= 1 / largest + 1e-12][-1]), float(mean[-1])
    energies = np.linspace(first, whole, NUM_POINTS)
    scales = [
        largest,
        *(1 / _first_reaching(fractions, mean, energy) for energy in energies[1:-1]),
        1.0,
    ]
    begins = [0] * NUM_POINTS
    if whole > first:
        begins = [int(until * math.log(e / first) / math.log(whole / first)) for e in energies]
    begins[-1] = until
    # If several points have the same iteration, the last is kept.
    points = dict(zip(begins, map(float, scales), strict=True))
    return ScaleSchedule(tuple(points), tuple(points.values()))


def _window_energies(
    image: NDArray[np.uint8], fractions: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The energies [F] of an image's spectrum within central windows of the sizes ``fractions``.

    The last window is the whole spectrum.
    """
    channels = np.abs(np.fft.fft2(image / 255.0, axes=(0, 1)))  # [H, W, 3]
    spectrum = np.fft.fftshift(channels, axes=(0, 1)).sum(-1)  # [H, W]
    height, width = spectrum.shape
    sums = np.zeros((height + 1, width + 1))  # summed-area table
    sums[1:, 1:] = spectrum.cumsum(0).cumsum(1)
    row, column = height // 2, width // 2  # of frequency zero
    down = (height * fractions / 2 + 1e-9).astype(int)  # [F] px
    across = (width * fractions / 2 + 1e-9).astype(int)
    top, bottom, left, right = row - down, row + down, column - across, column + across
    energies = sums[bottom, right] - sums[top, right] - sums[bottom, left] + sums[top, left]
    energies[-1] = sums[-1, -1]
    return energies


def _first_reaching(
    fractions: NDArray[np.float64], curve: NDArray[np.float64], value: float
) -> float:
    """The smallest of ``fractions`` [F] at which a rising ``curve`` [F] reaches ``value``."""
    return float(fractions[np.argmax(curve >= value * (1 - 1e-12))])


class Resolution:
    """The size of the pictures at each iteration; always the full one without a schedule.

    Sizes depend only on the pictures and on the densification window of ``options``; they change
    only after rounds of densification.
    """

    def __init__(self, options: TrainConfig, views: Sequence[View]) -> None:
        self.options = options
        self.schedule = ScaleSchedule((0,), (1.0,))
        if options.resolution_schedule == "pictures":
            self.schedule = scale_schedule([view.image for view in views], options.densify_stop)

    def scale(self, step: int) -> int:
        """The number by which the sides of pictures are divided at iteration ``step``."""
        options = self.options
        if step > options.densify_stop:
            return 1
        last_round = (step - 1) // options.densify_interval * options.densify_interval
        return self.schedule.at(last_round if last_round > options.densify_start else 0)

    def position_step(self, step: int) -> float:
        """The iteration of the means' learning-rate schedule to use at iteration ``step``.

        The schedule starts at `ScaleSchedule.full_from`.
        """
        end, wait = self.options.position_steps, self.schedule.full_from
        return end * max(0, step - wait) / max(end - wait, 1)


class ScaledViews:
    """The cameras and images of the training views at reduced sizes.

    The full size and the last other size are cached.
    """

    def __init__(
        self, views: Sequence[View], targets: Targets, device: torch.device, budget: int | None
    ) -> None:
        self._full, self._device, self._budget = views, device, budget
        self._sizes = {1: ([view.camera for view in views], targets)}

    def at(self, scale: int) -> tuple[list[Camera], Targets]:
        """Cameras and images with sides divided by ``scale``."""
        if scale not in self._sizes:
            small = [_reduced(view, scale) for view in self._full]
            targets = Targets(small, self._device, self._budget)
            self._sizes = {1: self._sizes[1], scale: ([view.camera for view in small], targets)}
        return self._sizes[scale]


def _reduced(view: View, scale: int) -> View:
    """``view`` with sides divided by ``scale``.

    The filter is that of the authors of DashGaussian, not that of `scene.images.resize_image`.
    """
    width, height = max(1, view.camera.width // scale), max(1, view.camera.height // scale)
    image = torch.from_numpy(view.image).permute(2, 0, 1).unsqueeze(0).float()  # [1, 3, H, W]
    small = torch.nn.functional.interpolate(image, (height, width), mode="bilinear", antialias=True)
    rounded = small.round().to(torch.uint8).squeeze(0)  # [3, height, width]
    pixels = rounded.permute(1, 2, 0).contiguous().numpy()
    mask = None if view.mask is None else resize_mask(view.mask, width, height)
    return replace(view, camera=view.camera.resized(width, height), image=pixels, mask=mask)
