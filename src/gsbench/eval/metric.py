"""Contract of a metric: a class that measures one image against another. docs/metric.md has an example."""

from typing import Protocol, runtime_checkable

from torch import Tensor


class Metric(Protocol):
    """Measures a render against its photograph.

    A class of the user's own says as class attributes how its values are to be read: ``direction`` (1, -1 or 0),
    ``label``, ``unit``, ``decimals`` and ``worthwhile``, as `gsbench.eval.facts.MetricFacts` explains them.

    Examples:
        The largest error of any pixel, in 8-bit levels; less is better:

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

        They hold what the protocol compares: images rounded to 8 bits. May raise `UnavailableError`. Where a mask
        ignores pixels, both images have the same there.
        """
        ...


@runtime_checkable
class MaskedMetric(Metric, Protocol):
    """Metric that can leave out the pixels that a mask ignores.

    Any other is given equal pixels there, and counts them.
    """

    def measure_masked(self, image: Tensor, truth: Tensor, mask: Tensor) -> float:
        """The value of one view over the pixels that count: ``mask`` [H, W] bool, and the images of `measure`."""
        ...


class UnavailableError(Exception):
    """A metric that cannot be computed; its text, one line, is the reason that results and tables give.

    ``awaited``, for gsbench's own metrics: what is missing may come, such as weights, and then the metric is computed.
    """

    def __init__(self, reason: str, awaited: bool = False) -> None:
        super().__init__(reason)
        self.awaited = awaited
