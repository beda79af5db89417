"""Series of pictures that belong to photographs of the same numbers, told by their pixels.

Masks, depth maps and smaller copies may lie in folders of any name, or have any addition to the
names of their photographs.
"""

import re
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from gsbench.errors import InputError
from gsbench.scene.images import read_image, same_up_to_rounding, stem_of
from gsbench.scene.twins import GRID, NEAR, likeness

DIGITS = re.compile(r"\d+")
Place = tuple[str, str]  # folder, and form of the names: ``IMG_#`` for IMG_1, IMG_2, …
MIN_SHARE = 0.8  # of a series that must have a photograph of the same number
SAMPLES = 3  # pictures of a series that are compared with their photographs
SIDE = 64  # px of the picture in which colours are counted
GREY = 8  # of 255: the channels of a grey picture differ by less, also after JPEG
ALMOST_ALL = 0.99  # of the pixels
FEWER = 8  # a drawing has fewer colours than a photograph by this factor
NORMAL, MOST = 0.1, 0.9  # normals have a length of 1 up to this; the share of pixels that do


def side_series(folder: Path, names: Sequence[str]) -> dict[str, str]:
    """Map each picture of a series that belongs to another one to the series' folder or form.

    A series are the pictures of a folder whose names differ in numbers alone. It belongs to another
    one if its numbers are there too and a sample shows smaller copies, or grey pictures, drawings
    or normals of the size of photographs. Only series with common numbers are read.
    """
    series = _series(names)

    @cache
    def sample(name: str) -> Sample:
        return _sample(read_image(folder / name))

    found: dict[str, str] = {}
    for place, pictures in series.items():
        for other, photographs in series.items():
            common = sorted(pictures.keys() & photographs.keys())
            if other == place or len(common) < max(1, MIN_SHARE * len(pictures)):
                continue
            chosen = common[:: max(1, len(common) // SAMPLES)][:SAMPLES]
            try:
                belongs = all(
                    _belongs(sample(pictures[key]), sample(photographs[key])) for key in chosen
                )
            except InputError:  # a damaged file is reported when the capture is read
                continue
            if belongs:
                reason = f"{place[0]}/" if place[0] != other[0] else place[1].replace("#", "…")
                found |= {stem_of(name): reason for name in pictures.values()}
                break
    return {name: found[stem_of(name)] for name in names if stem_of(name) in found}


def _series(names: Sequence[str]) -> dict[Place, dict[tuple[object, ...], str]]:
    """The pictures of each series by the numbers in which their names differ.

    Of names that are the only one of their form in a folder, the name is the key.
    """
    forms: dict[Place, dict[str, str]] = defaultdict(dict)  # names by stem
    for name in names:
        stem = PurePosixPath(stem_of(name))
        forms[stem.parent.as_posix(), DIGITS.sub("#", stem.name)][stem.name] = name
    series: dict[Place, dict[tuple[object, ...], str]] = defaultdict(dict)
    for (parent, form), members in forms.items():
        if len(members) == 1:
            series[parent, ""] |= {(stem.casefold(),): name for stem, name in members.items()}
            continue
        numbers = np.array([[int(run) for run in DIGITS.findall(stem)] for stem in members], object)
        varying = (numbers != numbers[0]).any(axis=0)
        for name, row in zip(members.values(), numbers, strict=True):
            series[parent, form][tuple(row[varying])] = name
    return series


@dataclass(frozen=True)
class Sample:
    """The features of a picture that tell if it is a photograph."""

    size: tuple[int, int]  # px
    grey: NDArray[np.float64]  # [GRID, GRID], from 0 to 255
    colors: int  # number of different ones in a smaller picture
    is_grey: bool
    has_normals: bool


def _sample(pixels: NDArray[np.uint8]) -> Sample:
    image = Image.fromarray(pixels)
    small = np.asarray(image.resize((SIDE, SIDE), Image.Resampling.NEAREST)).reshape(-1, 3)
    spread = small.max(axis=1).astype(int) - small.min(axis=1)
    lengths = np.linalg.norm(small / 127.5 - 1, axis=1)
    return Sample(
        size=image.size,
        grey=np.asarray(image.convert("L").resize((GRID, GRID), Image.Resampling.BILINEAR), float),
        colors=len(np.unique(small, axis=0)),
        is_grey=bool((spread < GREY).mean() >= ALMOST_ALL),
        has_normals=bool((abs(lengths - 1) < NORMAL).mean() >= MOST),
    )


def _belongs(picture: Sample, photograph: Sample) -> bool:
    all_cells = np.ones((GRID, GRID), bool)
    smaller = all(own < other for own, other in zip(picture.size, photograph.size, strict=True))
    if smaller and likeness((picture.grey, all_cells), (photograph.grey, all_cells)) >= NEAR:
        return True
    return same_up_to_rounding(picture.size, photograph.size) and (
        (picture.is_grey and not photograph.is_grey)
        or (picture.has_normals and not photograph.has_normals)
        or picture.colors * FEWER < photograph.colors
    )
