"""The contract of a metric, a class that compares an image with its photograph.

docs/metric.md has an example.
"""

from collections.abc import Callable
from typing import Protocol, runtime_checkable

from torch import Tensor

# A metric of gsbench, of images as in `Metric` and a mask [H, W] of the pixels that count, or None.
Measure = Callable[[Tensor, Tensor, Tensor | None], float]


class Metric(Protocol):
    """Measures a render against its photograph.

    Class attributes say how to read its values: ``direction`` (1, -1 or 0), ``label``, ``unit``,
    ``decimals`` and ``worthwhile``. `gsbench.eval.facts.MetricFacts` explains them.

    Examples:
        The largest error of any pixel, in 8-bit levels (less is better):

        >>> import torch
        >>> class LargestError:
        ...     label, unit, direction, decimals, worthwhile = "largest error", "levels", -1, 0, 1.0
        ...
        ...     def measure(self, image, truth):
        ...         return 255 * (image - truth).abs().max().item()

        >>> metric: Metric = LargestError()
        >>> metric.measure(torch.zeros(4, 5, 3), torch.ones(4, 5, 3))
        255.0
    """

    def measure(self, image: Tensor, truth: Tensor) -> float:
        """The value of one view; both are [H, W, 3], float32 in [0, 1], on the evaluation's device.

        The render is rounded to 8 bits. Both images have equal pixels where a mask ignores them.
        May raise `UnavailableError`.
        """


@runtime_checkable
class MaskedMetric(Metric, Protocol):
    """Metric that can leave out the pixels that a mask ignores.

    Other metrics include these pixels, which are equal in both images.
    """

    def measure_masked(self, image: Tensor, truth: Tensor, mask: Tensor) -> float:
        """The value of one view over the pixels that count.

        ``mask`` is [H, W] bool; the images are those of `measure`.
        """


class UnavailableError(Exception):
    """Raised for a metric that cannot be computed.

    Its message is one line, the reason that results and tables show. ``awaited`` (gsbench's own
    metrics only) says that the metric can be computed after an installation or a download.
    """

    def __init__(self, reason: str, awaited: bool = False) -> None:
        super().__init__(reason)
        self.awaited = awaited


def require_size(image: Tensor, min_side: int) -> None:
    """Raise UnavailableError for a view [H, W, 3] with a side below ``min_side`` px."""
    height, width = image.shape[:2]
    if min(height, width) < min_side:
        raise UnavailableError(f"a view is {width}x{height} px, below {min_side} px a side")
