"""Errors of two arms' renders, binned by the texture of the ground truth: the places where an arm helps.

Pixels are sorted into equally filled bins of the ground truth's texture energy, and the mean error of each arm is taken
in each bin, view and trial. Differences are then tested as those of
any metric are.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from gsbench.analysis.results import TrialResult, by_key
from gsbench.analysis.statistics import Answer, answer_family
from gsbench.errors import InputError
from gsbench.records import Number, Record, read_if_sound
from gsbench.runs.layout import FROM_PIXELS, GROUND_TRUTH, MASKS, RENDERS
from gsbench.scene.masks import read_mask

BINS = 5
TEXTURE_SIGMA = 2.0  # px: texture energy is the gradient's square averaged over such a Gaussian
LUMINANCE = (0.2126, 0.7152, 0.0722)  # Rec. 709
TEXTURED_SHARE = 0.2  # of a photograph's pixels, those with the most texture
SAMPLES = 200_000  # pixels of a scene from which the bins' edges are taken

Array = NDArray[np.float64]


@dataclass(frozen=True)
class RegionErrors:
    """Mean absolute errors (8-bit levels) of two arms in bins of texture, from the lowest to the highest.

    ``changes`` are second arm minus first, one for each bin, adjusted for their number.
    """

    first: tuple[float, ...]
    second: tuple[float, ...]
    changes: tuple[Answer, ...]

    def words(self) -> tuple[str, ...]:
        """Say of each bin whether the second arm is better, worse or undecided there."""
        words = {"supported": "better", "refuted": "worse"}
        return tuple(words.get(one.outcome(-1, None), "undecided") for one in self.changes)


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


def errors_by_region(pairs: Sequence[tuple[TrialResult, TrialResult]], bins: int = BINS) -> RegionErrors:
    """Compare two arms, by their ``pairs`` of trials, in bins of the photographs' texture.

    Raises ``InputError``, saying what is missing, where renders are absent.
    """
    if not pairs:
        raise InputError("no trials of the two arms share a scene, a seed and their conditions")
    errors: list[Array] = []  # by scene, [K, V, 2, bins]
    for own in by_key(pairs, lambda pair: pair[0].scene).values():
        edges = _edges(own[0][0], bins)
        errors.append(np.array([list(_pair_means(*pair, edges)) for pair in own]))
    means, differing = [], []
    for index in range(bins):
        inside = [array[:, np.isfinite(array[:, :, 0, index]).all(axis=0), :, index] for array in errors]  # [K, V', 2]
        kept = [array for array in inside if array.size]
        if not kept:
            raise InputError(f"texture: bin {index + 1} of {bins} is empty in every scene; ask for fewer bins")
        means.append(np.mean([array.mean(axis=(0, 1)) for array in kept], axis=0))  # [2]
        seeds = min(map(len, kept))
        differing.append(np.array([(array[:seeds, :, 1] - array[:seeds, :, 0]).mean(axis=1) for array in kept]))
    first_means, second_means = (tuple(float(mean[place]) for mean in means) for place in (0, 1))
    return RegionErrors(first_means, second_means, tuple(answer_family(differing)))


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


def _texture(trial: TrialResult, view: str, truth: NDArray[np.uint8]) -> Array:
    """The texture energy [H, W] of a photograph; pixels that a mask ignores are not a number, and in no bin."""
    ignored = read_ignored(trial, view)
    return texture_energy(truth) if ignored is None else np.where(ignored, np.nan, texture_energy(truth))


def _edges(trial: TrialResult, bins: int) -> Array:
    """The inner edges [bins - 1] that cut the finite values over a scene's test views into equal parts."""
    names = view_names(trial)
    samples = []
    for name in names:
        values = _texture(trial, name, read_image(trial.path / GROUND_TRUTH / f"{name}.png")).ravel()
        values = values[np.isfinite(values)]
        samples.append(values[:: max(1, len(values) * len(names) // SAMPLES)])
    return np.quantile(np.concatenate(samples), np.linspace(0, 1, bins + 1)[1:-1])


def _pair_means(one: TrialResult, other: TrialResult, edges: Array) -> Iterator[tuple[Array, Array]]:
    """For each view: the mean error of both trials in every bin, [bins] each; a bin without pixels is not a number."""
    if view_names(one) != view_names(other):
        raise InputError(f"{one.label} and {other.label} have different renders")
    for name in view_names(one):
        truth = read_image(one.path / GROUND_TRUTH / f"{name}.png")
        values = _texture(one, name, truth)
        index = np.where(np.isfinite(values), np.searchsorted(edges, values), len(edges) + 1).ravel()
        counts = np.bincount(index, minlength=len(edges) + 2)[:-1]
        means = []
        for trial in (one, other):
            render = read_image(trial.path / RENDERS / f"{name}.png")
            if render.shape != truth.shape:
                raise InputError(f"{trial.label}: the render of {name} has not the size of the ground truth")
            errors = absolute_error(render, truth).ravel()
            sums = np.bincount(index, weights=errors, minlength=len(edges) + 2)[:-1]
            means.append(np.where(counts > 0, sums / np.maximum(counts, 1), np.nan))
        yield means[0], means[1]
