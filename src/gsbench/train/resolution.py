"""Training on small pictures first, and on no more Gaussians than they can show (DashGaussian, arXiv 2503.18402)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from gsbench.densify import Refinement
from gsbench.events import RefineEvent
from gsbench.scene.camera import Camera
from gsbench.scene.masks import resize_mask
from gsbench.scene.types import View
from gsbench.train.options import TrainConfig
from gsbench.train.views import Targets

# Of the authors' code (utils/schedule_utils.py).
LARGEST_SCALE = 8.0  # pictures are never divided by more
FIRST_SHARE = 1 / 4  # of each picture's spectrum, that the first size shows at least
LEVELS = 32  # points of the schedule, equally far apart in what they show


@dataclass(frozen=True)
class Levels:
    """A schedule of sizes: at iteration ``begins[i]`` pictures are divided by ``scales[i]``, which falls to 1."""

    begins: tuple[int, ...]
    scales: tuple[float, ...]

    def at(self, step: int) -> int:
        """The whole number by which iteration ``step`` divides pictures: between levels their area, in pixels, grows
        linearly."""
        area = np.interp(step, self.begins, [scale**-2 for scale in self.scales])
        return int(area**-0.5 + 1e-9)

    @property
    def full_from(self) -> int:
        """The iteration from which pictures are divided by less than two."""
        first = next(i for i, scale in enumerate(self.scales) if scale < 2)
        return self.begins[max(first - 1, 0)]


def levels(images: Sequence[NDArray[np.uint8]], until: int) -> Levels:
    """The levels at which ``images`` [H, W, 3] are trained on, from iteration 0 to ``until`` (arXiv 2503.18402).

    What a size shows of a picture is the sum of the moduli of its Fourier transform over the central window of that
    size. The first size shows a quarter of every picture, or divides by 8; the levels are equally far apart in what
    they show of the mean picture; and each begins when the logarithm of that, from the first to the whole, is as far on
    its way as the iteration is.
    """
    fractions = _fractions({image.shape[:2] for image in images})
    curves = np.stack([_shown(image, fractions) for image in images])  # [V, F]
    if not (curves[:, -1] > 0).all():  # a black picture shows nothing at any size
        return Levels((0,), (1.0,))
    largest = min(LARGEST_SCALE, *(1 / _least(fractions, curve, FIRST_SHARE * curve[-1]) for curve in curves))
    mean = curves.mean(0)
    first, whole = float(mean[fractions <= 1 / largest + 1e-12][-1]), float(mean[-1])
    shown = np.linspace(first, whole, LEVELS)
    scales = [largest, *(1 / _least(fractions, mean, share) for share in shown[1:-1]), 1.0]
    begins = [int(until * math.log(share / first) / math.log(whole / first)) if whole > first else 0 for share in shown]
    begins[-1] = until
    kept = [i for i in range(LEVELS) if i == LEVELS - 1 or begins[i] < begins[i + 1]]  # the last of those that coincide
    return Levels(tuple(begins[i] for i in kept), tuple(float(scales[i]) for i in kept))


def _fractions(shapes: set[tuple[int, ...]]) -> NDArray[np.float64]:
    """The sizes [F], as fractions from 0 to 1, at which a window over a spectrum of one of the ``shapes`` grows."""
    return np.unique([0.0, 1.0, *(2 * k / side for shape in shapes for side in shape for k in range(side // 2 + 1))])


def _shown(image: NDArray[np.uint8], fractions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Share that windows of the sizes ``fractions`` [F] show of an image, [F]; the last is the whole spectrum."""
    spectrum = np.fft.fftshift(np.abs(np.fft.fft2(image / 255.0, axes=(0, 1))), axes=(0, 1)).sum(-1)  # [H, W]
    height, width = spectrum.shape
    sums = np.zeros((height + 1, width + 1))
    sums[1:, 1:] = spectrum.cumsum(0).cumsum(1)
    row, column = height // 2, width // 2  # of the mean
    tall, wide = ((side * fractions / 2 + 1e-9).astype(int) for side in (height, width))  # half windows [F]
    top, bottom, left, right = row - tall, row + tall, column - wide, column + wide
    shown = sums[bottom, right] - sums[top, right] - sums[bottom, left] + sums[top, left]
    shown[-1] = sums[-1, -1]
    return shown


def _least(fractions: NDArray[np.float64], curve: NDArray[np.float64], share: float) -> float:
    """The least of ``fractions`` at which a rising ``curve`` [F] reaches ``share``."""
    return float(fractions[np.argmax(curve >= share * (1 - 1e-12))])


# Of the authors' code (utils/schedule_utils.py).
FIRST_MOMENTUM = 5  # times the initial count: what may be added before growth was seen
KEPT_MOMENTUM = 0.98
MOST_MOMENTUM = 1_000_000  # that one round adds to it
MOST_GROWTH = 0.2  # of the count, in a round


class Resolution:
    """The size of the pictures at each iteration, and the count that goes with it.

    Sizes follow from the pictures and the window of ``options`` alone; they change after a round of that window.
    """

    def __init__(self, options: TrainConfig, views: Sequence[View], initial: int) -> None:
        self.options, self.initial = options, initial
        self.levels: Levels = levels([view.image for view in views], options.densify_stop)
        self.momentum = FIRST_MOMENTUM * initial  # Gaussians above ``initial`` that the whole pictures may have

    def scale(self, step: int) -> int:
        """The number by which the sides of the pictures are divided at iteration ``step``."""
        options = self.options
        if step > options.densify_stop:
            return 1
        last = (step - 1) // options.densify_interval * options.densify_interval  # round
        return self.levels.at(last if last > options.densify_start else 0)

    def position_step(self, step: int) -> float:
        """The place of iteration ``step`` in the schedule of the means' learning rate, which waits until the pictures
        are divided by less than two."""
        end, wait = self.options.position_steps, self.levels.full_from
        return end * max(0, step - wait) / max(end - wait, 1)

    @property
    def limits_count(self) -> bool:
        return self.options.resolution_schedule == "pictures_and_count"

    def limit(self, refinement: Refinement, most: int | None) -> int:
        """The count that a round is to stay below, where the whole pictures may have ``most``, or, for None, what was
        asked for so far.

        n0 + (n - n0) / s^(2 - x), for n0 initial Gaussians, pictures divided by s and x of the window done, and n in
        the last round; and a fifth more than there were before the round.
        """
        options, step = self.options, refinement.step
        above = self.momentum if most is None else most - self.initial
        if step + options.densify_interval < options.densify_stop:
            above = int(above / self.scale(step) ** (2 - step / options.densify_stop))
        return min(self.initial + above, int((1 + MOST_GROWTH) * refinement.event.before))

    def observe(self, event: RefineEvent) -> None:
        """Take note of how many candidates a round had: those that grew, and those that were refused."""
        candidates = sum(getattr(event, name) for name in RefineEvent.GROWN) + event.blocked_by_cap
        self.momentum = max(self.momentum, int(KEPT_MOMENTUM * self.momentum + min(MOST_MOMENTUM, candidates)))


class Pictures:
    """The training views at the size of an iteration. They are kept at one size besides the full one."""

    def __init__(self, views: Sequence[View], targets: Targets, device: torch.device, budget: int | None) -> None:
        self._full, self._device, self._budget = views, device, budget
        self._targets = {1: targets}
        self._cameras: dict[int, list[Camera]] = {1: [view.camera for view in views]}

    def at(self, scale: int) -> tuple[list[Camera], Targets]:
        """Cameras and images with sides divided by ``scale``."""
        if scale not in self._targets:
            small = [_smaller(view, scale) for view in self._full]
            self._targets = {1: self._targets[1], scale: Targets(small, self._device, self._budget)}
            self._cameras = {1: self._cameras[1], scale: [view.camera for view in small]}
        return self._cameras[scale], self._targets[scale]


def _smaller(view: View, scale: int) -> View:
    """The filter is that of the authors' code; `scene.images.resize_image` rounds once in each direction, upwards."""
    width, height = max(1, view.camera.width // scale), max(1, view.camera.height // scale)
    image = torch.from_numpy(view.image).permute(2, 0, 1).unsqueeze(0).float()  # [1, 3, H, W]
    small = torch.nn.functional.interpolate(image, (height, width), mode="bilinear", antialias=True)
    pixels = small.round().to(torch.uint8).squeeze(0).permute(1, 2, 0).contiguous().numpy()  # [height, width, 3]
    mask = None if view.mask is None else resize_mask(view.mask, width, height)
    return replace(view, camera=view.camera.resized(width, height), image=pixels, mask=mask)
