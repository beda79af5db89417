"""The pictures of a trial's test views, and the error in their textured parts."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from gsbench.analysis.results import TrialResult
from gsbench.errors import InputError
from gsbench.records import Number, Record, read_if_sound
from gsbench.runs.layout import FROM_PIXELS, GROUND_TRUTH, MASKS, RENDERS
from gsbench.scene.masks import read_mask

TEXTURE_SIGMA = 2.0  # px: texture energy is the gradient's square averaged over such a Gaussian
LUMINANCE = (0.2126, 0.7152, 0.0722)  # Rec. 709
TEXTURED_SHARE = 0.2  # of a photograph's pixels, those with the most texture

Array = NDArray[np.float64]


def texture_energy(image: NDArray[np.uint8]) -> Array:
    """Local mean of the squared luminance gradient (8-bit levels squared), [H, W], of an image [H, W, 3] uint8."""
    from skimage.filters import gaussian  # here, since it is slow to import

    luminance = image.astype(np.float64) @ np.array(LUMINANCE)  # [H, W]
    rows, columns = np.gradient(luminance)
    return gaussian(rows**2 + columns**2, TEXTURE_SIGMA, mode="reflect", preserve_range=True)


def read_ignored(trial: TrialResult, view: str) -> NDArray[np.bool_] | None:
    """True where a mask ignores a pixel of the test view, [H, W]; None where all count."""
    path = trial.path / MASKS / f"{view}.png"
    return ~read_mask(path) if path.is_file() else None


def absolute_error(render: NDArray[np.uint8], truth: NDArray[np.uint8]) -> Array:
    """Mean absolute difference over channels, [H, W], in 8-bit levels."""
    return np.abs(render.astype(np.float64) - truth.astype(np.float64)).mean(axis=-1)


@dataclass(frozen=True, kw_only=True)
class FromPixels(Record):
    """Measures of a trial's pictures, as an archive keeps them, which has no pictures."""

    error_textured: Number


def textured_error(trial: TrialResult) -> float:
    """Mean absolute error (8-bit levels) over the most textured fifth of each held-out photograph, mean over views.

    Grass, foliage, fabric and gravel lie there. Raises InputError where renders are missing, and so is their measure.
    """
    kept = read_if_sound(trial.path / FROM_PIXELS, FromPixels)
    if kept is not None:
        return float(kept.error_textured)
    errors = []
    for view in view_names(trial):
        truth = read_image(trial.path / GROUND_TRUTH / f"{view}.png")
        texture = texture_energy(truth)  # [H, W]
        ignored = read_ignored(trial, view)
        counts = np.ones(texture.shape, dtype=bool) if ignored is None else ~ignored
        inside = counts & (texture >= np.quantile(texture[counts], 1 - TEXTURED_SHARE))
        errors.append(float(absolute_error(read_image(trial.path / RENDERS / f"{view}.png"), truth)[inside].mean()))
    return float(np.mean(errors))


def view_names(trial: TrialResult) -> list[str]:
    """The names of the rendered test views, sorted; raises ``InputError`` where there are none."""
    folder = trial.path / RENDERS
    names = sorted(path.stem for path in folder.glob("*.png"))
    if not names:
        raise InputError(f"{trial.label} holds no {RENDERS}")
    return names


def read_image(path: Path) -> NDArray[np.uint8]:
    """An image as [H, W, 3] uint8; raises ``InputError`` naming a damaged or missing file."""
    try:
        with Image.open(path) as image:
            return np.asarray(image.convert("RGB"))
    except (OSError, UnidentifiedImageError, SyntaxError, Image.DecompressionBombError) as error:
        raise InputError(f"{path} cannot be read as an image ({error})") from None
