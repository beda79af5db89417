"""Metrics that ``eval.more`` names: structural ones, and metrics after a correction of colours.

MS-SSIM, IW-SSIM, FSIM with colour and GMSD are measured by the library piq (an extra).

The correction of a render's colours is for captures whose exposure or white balance changes. A
phone chooses exposure anew for each photograph, and no renderer can know the exposure of a test
view. Mip-NeRF 360 (Barron et al. 2022) and gsplat therefore also report metrics after an affine map
of the render's colours to those of the photograph.
"""

from collections.abc import Callable
from typing import Any

import torch
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


ROUNDS = 5  # as in Mip-NeRF 360's evaluation; each leaves out the pixels that the last one clipped
NO_CONTRAST = 1e-10  # smaller singular values, relative to the largest, are rounding errors
CLIPPED = 0.5 / 255  # values this near to 0 or 1 round to an end of the 8-bit range


def color_corrected(image: Tensor, truth: Tensor, mask: Tensor | None = None) -> Tensor:
    """Map the colours of ``image`` [H, W, 3] to those of ``truth``, both in [0, 1].

    The map is affine, with a row a_c of four numbers for each channel c. It minimises the sum over
    pixels of (a_c . (r, g, b, 1) - truth_c)^2, in double precision, and the result is clipped to
    [0, 1]. A pixel counts for a channel if ``mask`` [H, W] is True, no channel of the render is
    clipped, and the photograph's channel is not clipped. A channel with fewer than four such pixels
    stays as it is. This is done five times, each time with the last result.
    """
    corrected = in_double_precision(image).reshape(-1, 3)  # [P, 3]
    goal = in_double_precision(truth).reshape(-1, 3)  # [P, 3]
    counted = torch.ones_like(goal[:, 0], dtype=torch.bool) if mask is None else mask.reshape(-1)
    for _ in range(ROUNDS):
        inputs = torch.cat([corrected, torch.ones_like(corrected[:, :1])], dim=1)  # [P, 4]
        is_inside = counted & _unclipped(corrected).all(dim=1)
        mapped = []
        for channel in range(3):
            used = is_inside & _unclipped(goal[:, channel])
            x, y = inputs[used], goal[used, channel]
            if len(y) < inputs.shape[1]:
                mapped.append(corrected[:, channel])
                continue
            # The pseudoinverse also works for a render of one colour, for which many maps are best.
            q, r = torch.linalg.qr(x)  # [U, 4], [4, 4]
            mapped.append(inputs @ (torch.linalg.pinv(r, rtol=NO_CONTRAST) @ (q.T @ y)))
        corrected = torch.stack(mapped, dim=1).clamp(0, 1)
    return corrected.reshape(image.shape)


def _unclipped(values: Tensor) -> Tensor:
    return (values > CLIPPED) & (values < 1 - CLIPPED)


def after_correction(measure: Measure, gain: bool = False) -> Measure:
    """``measure`` after `color_corrected`, or with ``gain`` its increase by that."""

    def measured(image: Tensor, truth: Tensor, mask: Tensor | None) -> float:
        value = measure(color_corrected(image, truth, mask).to(image), truth, mask)
        return value - measure(image, truth, mask) if gain else value

    return measured
