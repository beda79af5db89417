"""The settings of a scene: where photographs lie, how many, how large, which are held out."""

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from annotated_types import Ge, Interval
from pydantic import NonNegativeInt, PositiveFloat

from gsbench.errors import InputError
from gsbench.scene.rules import MIN_IMAGES, MIN_SIZE, check_accept, given
from gsbench.settings import (
    MISSING,
    FolderName,
    PathName,
    TargetName,
    check_settings,
    is_folder_name,
)

MAX_IMAGES = 200  # the paper's limit per scene


def downscaled_size(width: int, height: int, max_size: int | None) -> tuple[int, int]:
    """The size with the longest side at most ``max_size``, which never grows.

    The other side is rounded half up to at least 1.

    Examples:
        >>> downscaled_size(4946, 3286, max_size=1600)
        (1600, 1063)
    """
    longest = max(width, height)
    if max_size is None or max_size >= longest:
        return width, height

    def scaled(side: int) -> int:
        return max(1, math.floor(side * max_size / longest + 0.5))

    return scaled(width), scaled(height)


def check_final_size(size: tuple[int, int], max_size: int | None, what: str) -> None:
    """Raise InputError if ``what``, of ``size`` (width, height), would have a side below 16 px."""
    width, height = downscaled_size(*size, max_size)
    given(
        "view-size",
        min(width, height),
        what,
        size=f"{width}x{height}",
        full=f"{size[0]}x{size[1]}",
        limit="" if max_size is None else f" with scene.max_size={max_size}",
    )


def require_enough(count: int, folder: Path, which: str, remedy: str = "") -> None:
    """Raise InputError for fewer than three photographs."""
    given(
        "too-few-images",
        count,
        str(folder),
        which=which,
        mend=remedy or "give more photographs",
    )


TEST_EVERY = 8  # Mip-NeRF 360 and 3DGS hold out every 8th image, from the first
SECTORS = 8  # a sector then has as many views as every_nth holds out by default
LISTS = ("train_list.txt", "test_list.txt")  # as nerfbaselines names them


@dataclass
class SplitRule:
    """Settings that say which views are held out.

    ``every_nth`` holds out every ``test_every``-th name, from the first. ``sector`` holds out
    sector number ``sector`` of ``sectors`` contiguous ones
    (`gsbench.scene.hold_out.arrange_cameras`). ``list`` follows the lists. With ``match_views``,
    ``every_nth`` holds out as many views as a sector has, so both leave equally many for training.
    With ``validation``, the held-out views are dropped, and the rule is applied again to the rest.
    Raises InputError for settings that contradict each other.
    """

    # views held out: every test_every-th image, a sector, lists; matched: says how to sweep
    split: Literal["every_nth", "sector", "matched", "list"] = "every_nth"
    # every_nth: hold out every so-many-th sorted name
    test_every: Annotated[int, Ge(2)] = TEST_EVERY
    # file of names, one a line; null with split=list: train_list.txt
    train_list: PathName | None = None
    test_list: PathName | None = None  # the same; null with split=list: test_list.txt
    sector: NonNegativeInt = 0  # number of the sector that is held out
    sectors: Annotated[int, Ge(2)] = SECTORS  # contiguous parts of the cameras
    match_views: bool = False  # every_nth and sector hold out equally many views
    validation: bool = False  # drop the test views, and measure on views held out of the rest

    @property
    def lists(self) -> tuple[str | None, ...]:
        return self.train_list, self.test_list

    @property
    def by_lists(self) -> bool:
        return self.split == "list" or any(self.lists)

    def __post_init__(self) -> None:
        if self.split == "matched":
            raise InputError(
                "scene.split=matched is a pair of trials: sweep it, as in -m "
                "scene.split=every_nth,sector scene.match_views=true"
            )
        if self.sector >= self.sectors:
            raise InputError(
                f"scene.sector={self.sector}: of scene.sectors={self.sectors} the last is "
                f"{self.sectors - 1}"
            )
        if self.split == "sector" and self.by_lists:
            raise InputError(
                "scene.split=sector and a list both say what is held out: give one of them"
            )
        if self.match_views and self.by_lists:
            raise InputError(
                "scene.match_views=true: what lists hold out cannot be matched; give every_nth or "
                "sector"
            )


Backdrop = Literal["black", "white"]  # the colour under transparent pixels
PrincipalPoint = Literal["used", "centred"]
MAX_SIZE = 16_384  # px, the longest side of a view of the courtyard


# Kinds of scenes, and the settings that only they read.
READ_BY = {
    ("colmap", "photos", "transforms"): ("images",),
    ("colmap", "photos", "transforms", "reader"): ("masks",),
    ("colmap",): ("sparse",),
    ("courtyard",): ("views", "width", "height", "seed"),
}


@dataclass
class SceneConfig(SplitRule):
    name: FolderName | None = MISSING  # null: the name of the folder `path`
    kind: Literal["colmap", "photos", "transforms", "courtyard", "reader"] = MISSING
    # scene=reader: a class of your own that reads the capture; its options are further keys
    _target_: TargetName | None = None
    path: PathName | None = None  # folder of the capture
    # image folder below path; null: images, or what transforms.json names
    images: PathName | None = None
    sparse: PathName | None = None  # model folder below path; null: sparse/0 or sparse
    transparent: Backdrop = "black"  # colour under transparent pixels
    # folder below path with a mask for each image, black where ignored; null: no masks
    masks: PathName | None = None
    # pictures beside the photographs that losses read: depth, or a folder's name (docs/ideas.md)
    beside: list[FolderName] = field(default_factory=list)
    # world units of one step of an integer depth map; null: 0.001
    depth_scale: PositiveFloat | None = None
    max_size: Annotated[int, Ge(MIN_SIZE)] | None = None  # longest side, px; never enlarges
    max_images: Annotated[int, Ge(MIN_IMAGES)] = MAX_IMAGES  # evenly spaced over the sorted names
    # ids of rules (docs/captures.md) whose refusal becomes a line in log, results and tables
    accept: list[str] = field(default_factory=list)
    # centred: moved to the image centre, as 3DGS assumes
    principal_point: PrincipalPoint = "used"
    # courtyard only, as are the next three: in steps of 7.5 degrees; 48 close the ring
    views: Annotated[int, Interval(ge=3, le=9999)] = 48
    width: Annotated[int, Interval(ge=MIN_SIZE, le=MAX_SIZE)] = 400  # px
    height: Annotated[int, Interval(ge=MIN_SIZE, le=MAX_SIZE)] = 300  # px
    # of the small variations: every seed has the same plan
    seed: Annotated[int, Interval(ge=0, le=2**31 - 1)] = 0

    def __post_init__(self) -> None:
        if self.name is None:
            name = Path(self.path or "").expanduser().absolute().name
            self.name = name if is_folder_name(name) else "scene"
        check_settings(self, "scene")
        if self.kind != "courtyard" and not self.path:
            raise InputError(
                "scene.path is not set: say where the capture lies, for example "
                "scene.path=/my/photos"
            )
        if self.kind == "courtyard" and self.path:
            raise InputError(
                f"scene.path={self.path} is not read by the built-in courtyard: add scene=photos "
                "(bare photographs), scene=colmap or scene=transforms"
            )
        if (self.kind == "reader") != (self._target_ is not None):
            raise InputError(
                f"scene.kind={self.kind} with scene._target_={self._target_}: a reader of your own "
                "is scene=reader scene._target_=mine.MyReader"
            )
        self._check_that_all_is_read()
        super().__post_init__()
        check_accept(self.accept)
        if self.split == "sector" and self.kind == "photos":
            raise InputError(
                "scene.split=sector needs the cameras, and these photographs came without: give a "
                "COLMAP model (scene=colmap; gsbench export writes that of a trial)"
            )
        if self.kind == "courtyard":
            check_final_size((self.width, self.height), self.max_size, "the courtyard")

    def _check_that_all_is_read(self) -> None:
        """Raise InputError for a setting that the scene's kind or split would ignore."""
        unread = {
            key: f"by scene.kind={self.kind}, only by {' and '.join(kinds)}: leave it out "
            f"(default: {getattr(SceneConfig, key)})"
            for kinds, keys in READ_BY.items()
            if self.kind not in kinds
            for key in keys
        }
        if self.split != "sector" and not self.match_views:
            why = f"with scene.split={self.split}: add scene.split=sector, or leave it out"
            unread |= dict.fromkeys(("sector", "sectors"), why)
        for key, why in unread.items():
            if getattr(self, key) != getattr(SceneConfig, key):
                raise InputError(f"scene.{key}={getattr(self, key)} is not read {why}")
