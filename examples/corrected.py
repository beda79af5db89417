"""PSNR after a correction of colours, for captures whose exposure or white balance changes.

A phone chooses exposure anew for each photograph, and no renderer can know that of a test view.
Mip-NeRF 360 (Barron et al. 2022) and gsplat therefore also report metrics after an affine map of
the render's colours to those of the photograph. The map is fitted to the test view itself, so
compare such values only with each other. docs/metric.md says how to run it.
"""

from dataclasses import dataclass

import torch

from gsbench.eval.images import in_double_precision

ROUNDS = 5  # as in Mip-NeRF 360's evaluation; each leaves out the pixels that the last one clipped
NO_CONTRAST = 1e-10  # smaller singular values, relative to the largest, are rounding errors
CLIPPED = 0.5 / 255  # values this near to 0 or 1 round to an end of the 8-bit range


@dataclass
class CorrectedPsnr:
    """PSNR of the corrected render."""

    label = "PSNR cc"  # no annotations, so these are not options
    unit = "dB"
    direction = 1
    decimals = 2
    worthwhile = 0.1

    def measure(self, image, truth):
        return self.measure_masked(image, truth, torch.ones_like(image[..., 0], dtype=torch.bool))

    def measure_masked(self, image, truth, mask):
        error = color_corrected(image, truth, mask) - in_double_precision(truth)
        return min(100.0, float(-10 * error[mask].square().mean().log10()))


def color_corrected(image, truth, mask):
    """Map the colours of ``image`` [H, W, 3] to those of ``truth``, both in [0, 1].

    The map is affine, with a row a_c of four numbers for each channel c. It minimises the sum over
    pixels of (a_c . (r, g, b, 1) - truth_c)^2, in double precision, and the result is clipped to
    [0, 1]. A pixel counts for a channel if ``mask`` [H, W] is True, no channel of the render is
    clipped, and the photograph's channel is not clipped. A channel with fewer than four such pixels
    stays as it is. This is done five times, each time with the last result.
    """
    corrected, goal = (in_double_precision(one).reshape(-1, 3) for one in (image, truth))  # [P, 3]
    for _ in range(ROUNDS):
        inputs = torch.cat([corrected, torch.ones_like(corrected[:, :1])], dim=1)  # [P, 4]
        is_inside = mask.reshape(-1) & unclipped(corrected).all(dim=1)
        mapped = []
        for channel in range(3):
            used = is_inside & unclipped(goal[:, channel])
            if used.sum() < 4:
                mapped.append(corrected[:, channel])
                continue
            # The pseudoinverse also works for a render of one colour, for which many maps are best.
            q, r = torch.linalg.qr(inputs[used])  # [U, 4], [4, 4]
            best = torch.linalg.pinv(r, rtol=NO_CONTRAST) @ (q.T @ goal[used, channel])
            mapped.append(inputs @ best)
        corrected = torch.stack(mapped, dim=1).clamp(0, 1)
    return corrected.reshape(image.shape)


def unclipped(values):
    return (values > CLIPPED) & (values < 1 - CLIPPED)
