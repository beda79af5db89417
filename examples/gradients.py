"""A metric; docs/metric.md says how to run it."""

from dataclasses import dataclass

from pydantic import PositiveInt

from gsbench.eval.metric import UnavailableError


@dataclass
class GradientError:
    """Mean absolute error of the differences between pixels ``distance`` apart, in 8-bit levels."""

    distance: PositiveInt = 1

    label = "gradient error"  # no annotations, so these are not options
    unit = "levels"
    direction = -1
    decimals = 2
    worthwhile = 0.05

    def measure(self, image, truth):
        if min(image.shape[:2]) <= self.distance:
            raise UnavailableError(f"a view is smaller than {self.distance} px")
        # [H, W, 3]: gradients are linear, so their difference is that of the error
        error = 255 * (image - truth)
        across = error[:, self.distance :] - error[:, : -self.distance]
        down = error[self.distance :] - error[: -self.distance]
        return (across.abs().mean() + down.abs().mean()).item() / 2
