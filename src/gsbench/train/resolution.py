"""Training on small pictures first (DashGaussian, arXiv 2503.18402).

It has as many Gaussians as the pictures can show.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from gsbench.densify import Refinement
from gsbench.events import RefineEvent
from gsbench.scene.images import resize_mask
from gsbench.scene.types import Camera, View
from gsbench.train.options import TrainConfig
from gsbench.train.views import Targets

# From the authors' code (utils/schedule_utils.py).
MAX_SCALE = 8.0  # picture sides are never divided by more
FIRST_SHARE = 1 / 4  # of each picture's spectrum is within the first size, at least
NUM_POINTS = 32  # of the schedule, equally spaced in the spectrum that they show


@dataclass(frozen=True)
class ScaleSchedule:
    """The sides of pictures are divided by ``scales[i]`` from iteration ``begins[i]`` on.

    The scales fall to 1.
    """

    begins: tuple[int, ...]
    scales: tuple[float, ...]

    def at(self, step: int) -> int:
        """The whole number by which iteration ``step`` divides sides.

        Between two points, the area of pictures grows linearly.
        """
        area = np.interp(step, self.begins, [scale**-2 for scale in self.scales])
        return int(area**-0.5 + 1e-9)

    @property
    def full_from(self) -> int:
        """The iteration from which sides are divided by less than two."""
        first = next(i for i, scale in enumerate(self.scales) if scale < 2)
        return self.begins[max(first - 1, 0)]


def scale_schedule(images: Sequence[NDArray[np.uint8]], until: int) -> ScaleSchedule:
    """The schedule for ``images`` [H, W, 3] from iteration 0 to ``until`` (arXiv 2503.18402).

    A picture reduced to a fraction of its size keeps the central window of that fraction of its
    spectrum; the energy of a size is the sum of the moduli of the Fourier transform over this
    window. The first size has at least a quarter of the energy of every picture, but divides sides
    by at most 8. The points of the schedule are equally spaced in the energy of the mean picture.
    Their iterations are proportional to the logarithm of energy / first energy.
    """
    sides = {side for image in images for side in image.shape[:2]}
    # From 0 to 1, the fractions at which a central window over a spectrum gains pixels.
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
    # of several points at one iteration, the last
    points = dict(zip(begins, map(float, scales), strict=True))
    return ScaleSchedule(tuple(points), tuple(points.values()))


def _window_energies(
    image: NDArray[np.uint8], fractions: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The energy of an image's spectrum within central windows of the sizes ``fractions`` [F], [F].

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
    """The least of ``fractions`` at which a rising ``curve`` [F] reaches ``value``."""
    return float(fractions[np.argmax(curve >= value * (1 - 1e-12))])


# From the authors' code (utils/schedule_utils.py).
FIRST_MOMENTUM = 5  # times the initial count: the momentum before any growth was seen
KEPT_MOMENTUM = 0.98  # factor on the momentum in each round
MAX_CANDIDATES = 1_000_000  # of one round that are added to the momentum
MAX_GROWTH = 0.2  # of the count, in one round


class Resolution:
    """The size of the pictures at each iteration, and the limit on the count that goes with it.

    Sizes depend only on the pictures and on the densification window of ``options``; they change
    after rounds.
    """

    def __init__(self, options: TrainConfig, views: Sequence[View], initial: int) -> None:
        self.options, self.initial = options, initial
        self.schedule = scale_schedule([view.image for view in views], options.densify_stop)
        # Gaussians beyond ``initial`` that pictures of full size may have
        self.momentum = FIRST_MOMENTUM * initial

    def scale(self, step: int) -> int:
        """The number by which the sides of pictures are divided at iteration ``step``."""
        options = self.options
        if step > options.densify_stop:
            return 1
        last_round = (step - 1) // options.densify_interval * options.densify_interval
        return self.schedule.at(last_round if last_round > options.densify_start else 0)

    def position_step(self, step: int) -> float:
        """The iteration of the means' learning-rate schedule to use at iteration ``step``.

        The schedule starts when the sides are divided by less than two.
        """
        end, wait = self.options.position_steps, self.schedule.full_from
        return end * max(0, step - wait) / max(end - wait, 1)

    def limit(self, refinement: Refinement, most: int | None) -> int:
        """The limit on the count after a round: n0 + (n - n0) / s^(2 - x), and n in the last round.

        n0 is the initial count, n the limit ``most`` for pictures of full size (None: n0 plus the
        momentum), s the number that divides the sides, x the progress of the window. A round adds
        at most a fifth of the count.
        """
        options, step = self.options, refinement.step
        added = self.momentum if most is None else most - self.initial
        if step + options.densify_interval < options.densify_stop:
            added = int(added / self.scale(step) ** (2 - step / options.densify_stop))
        return min(self.initial + added, int((1 + MAX_GROWTH) * refinement.event.before))

    def observe(self, event: RefineEvent) -> None:
        """Update the momentum by the number of candidates of a round.

        Those that grew and those that were refused.
        """
        candidates = sum(getattr(event, name) for name in RefineEvent.GROWN) + event.blocked_by_cap
        self.momentum = max(
            self.momentum, int(KEPT_MOMENTUM * self.momentum + min(MAX_CANDIDATES, candidates))
        )


class ScaledViews:
    """The cameras and images of the training views, reduced.

    The full size and the last other size are cached.
    """

    def __init__(
        self, views: Sequence[View], targets: Targets, device: torch.device, budget: int | None
    ) -> None:
        self._full, self._device, self._budget = views, device, budget
        self._targets = {1: targets}
        self._cameras: dict[int, list[Camera]] = {1: [view.camera for view in views]}

    def at(self, scale: int) -> tuple[list[Camera], Targets]:
        """Cameras and images with sides divided by ``scale``."""
        if scale not in self._targets:
            small = [_reduced(view, scale) for view in self._full]
            self._targets = {1: self._targets[1], scale: Targets(small, self._device, self._budget)}
            self._cameras = {1: self._cameras[1], scale: [view.camera for view in small]}
        return self._cameras[scale], self._targets[scale]


def _reduced(view: View, scale: int) -> View:
    """``view`` with sides divided by ``scale``, by the authors' filter.

    `scene.images.resize_image` has another.
    """
    width, height = max(1, view.camera.width // scale), max(1, view.camera.height // scale)
    image = torch.from_numpy(view.image).permute(2, 0, 1).unsqueeze(0).float()  # [1, 3, H, W]
    small = torch.nn.functional.interpolate(image, (height, width), mode="bilinear", antialias=True)
    rounded = small.round().to(torch.uint8).squeeze(0)  # [3, height, width]
    pixels = rounded.permute(1, 2, 0).contiguous().numpy()
    mask = None if view.mask is None else resize_mask(view.mask, width, height)
    return replace(view, camera=view.camera.resized(width, height), image=pixels, mask=mask)
