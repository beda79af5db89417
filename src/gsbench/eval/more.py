"""Structural metrics that ``eval.more`` names, measured by the library piq (an extra)."""

from collections.abc import Callable
from typing import Any

from torch import Tensor

from gsbench.eval.images import as_batch, in_double_precision
from gsbench.eval.metric import Measure, UnavailableError, require_size

# Metrics of piq: the function there, and the shortest side (px) of an image that it measures. Five
# scales leave the window of 11 px inside 161 px. FSIM's limit is ours: phases mean little in an
# image that holds few of the shortest waves.
STRUCTURAL = {
    "ms_ssim": ("multi_scale_ssim", 161),
    "iw_ssim": ("information_weighted_ssim", 161),
    "fsim": ("fsim", 16),
    "gmsd": ("gmsd", 2),
}


def load_structural(key: str) -> Measure:
    """piq's metric ``key`` by its authors' definition, the same in all protocols; knows no masks.

    Raises UnavailableError, with the reason in one line, if piq cannot be imported.
    """
    name, min_side = STRUCTURAL[key]
    try:
        import piq
    # torchvision, which piq needs, raises RuntimeError if it was made for another torch
    except (ImportError, OSError, RuntimeError) as error:
        why = str(error).partition("\n")[0]
        raise UnavailableError(
            f"it needs the package piq: pip install 'gsbench-3dgs[piq]' ({why})", awaited=True
        ) from error
    function: Callable[..., Any] = getattr(piq, name)

    def measure(image: Tensor, truth: Tensor, mask: Tensor | None = None) -> float:
        require_size(image, min_side)
        pair = (as_batch(in_double_precision(one)) for one in (image, truth))
        try:
            return float(function(*pair, data_range=1.0))
        except RuntimeError as error:  # IW-SSIM inverts a matrix that is singular for a flat view
            if "singular" not in str(error):
                raise
            raise UnavailableError("a view is flat: it has no structure to compare") from error

    return measure
