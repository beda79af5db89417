"""MS-SSIM, IW-SSIM, FSIM with colour and GMSD, measured by the library piq (an extra)."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from gsbench.eval.images import as_batch
from gsbench.eval.metric import UnavailableError


@dataclass(frozen=True)
class Structural:
    """A metric of piq: its function there, and the shortest side of an image that it measures."""

    function: str
    min_side: int  # px


# Five scales leave the window of 11 px inside 161 px. FSIM's limit is ours: phases mean little in
# an image that holds few of the shortest waves.
STRUCTURAL = {
    "ms_ssim": Structural("multi_scale_ssim", 161),
    "iw_ssim": Structural("information_weighted_ssim", 161),
    "fsim": Structural("fsim", 16),
    "gmsd": Structural("gmsd", 2),
}


def load_structural(key: str) -> Callable[[Tensor, Tensor], float]:
    """piq's metric ``key`` of two images [H, W, 3] in [0, 1], in their precision.

    Raises UnavailableError, with the reason in one line, if piq cannot be imported.
    """
    try:
        import piq
    # torchvision, which piq needs, raises RuntimeError if it was made for another torch
    except (ImportError, OSError, RuntimeError) as error:
        why = str(error).partition("\n")[0]
        raise UnavailableError(
            f"it needs the package piq: pip install 'gsbench-3dgs[piq]' ({why})", awaited=True
        ) from error
    function: Callable[..., Any] = getattr(piq, STRUCTURAL[key].function)

    def measure(image: Tensor, truth: Tensor) -> float:
        try:
            return float(function(as_batch(image), as_batch(truth), data_range=1.0))
        except RuntimeError as error:  # IW-SSIM inverts a matrix that is singular for a flat view
            if "singular" not in str(error):
                raise
            raise UnavailableError("a view is flat: it has no structure to compare") from error

    return measure
