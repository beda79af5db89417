"""The settings of a scene: where its photographs lie, how many are read and how large, which are held out."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Literal

from annotated_types import Ge, Interval
from pydantic import NonNegativeInt, PositiveInt

from gsbench.errors import InputError
from gsbench.scene.sizes import MIN_SIZE, check_final_size
from gsbench.scene.split import SECTORS, TEST_EVERY, SplitName, SplitRule
from gsbench.settings import MISSING, FolderName, PathName, check_settings, is_folder_name

Behind = Literal["black", "white"]
MAX_SIZE = 16_384  # px, of a picture of the courtyard


def folder_name(path: str | None) -> str:
    """The name of the scene in the folder ``path``; ``scene`` where that cannot name a folder of results."""
    name = Path(path or "").expanduser().absolute().name
    return name if is_folder_name(name) else "scene"


@dataclass
class SceneConfig:
    name: FolderName | None = MISSING  # null: that of the folder `path`
    kind: Literal["colmap", "photos", "transforms", "courtyard"] = MISSING
    path: PathName | None = None  # folder of the capture
    images: PathName | None = None  # image folder below path; null: images
    sparse: PathName | None = None  # model folder below path; null: sparse/0 or sparse
    transparent: Behind = "black"  # what transparent pixels are laid over
    masks: PathName | None = None  # folder below path of a mask for each image: black is ignored; null: all counts
    downscale: PositiveInt = 1  # divide both sides by it
    max_size: Annotated[int, Ge(MIN_SIZE)] | None = None  # longest side, px; never enlarges
    resample: Literal["lanczos", "area", "bicubic"] = "lanczos"
    max_images: Annotated[int, Ge(3)] = 200  # evenly spaced over the sorted names
    test_every: Annotated[int, Ge(2)] = TEST_EVERY  # every 8th sorted name is held out
    split: SplitName = (
        "every_nth"  # what is held out: every test_every-th image | sector | list; matched: a sweep of both
    )
    train_list: PathName | None = None  # file of names, one a line; null with split=list: train_list.txt
    test_list: PathName | None = None  # the same; null with split=list: test_list.txt
    sector: NonNegativeInt = 0  # which of them is held out
    sectors: Annotated[int, Ge(2)] = SECTORS  # contiguous parts of the cameras
    match_views: bool = False  # every_nth and sector hold out equally many
    validation: bool = False  # put the test views away, and judge by views that are held out of the rest
    principal_point: Literal["used", "centred"] = "used"  # 3DGS ignores it
    views: Annotated[int, Interval(ge=3, le=9999)] = 48  # courtyard only, as are the next three
    width: Annotated[int, Interval(ge=MIN_SIZE, le=MAX_SIZE)] = 400
    height: Annotated[int, Interval(ge=MIN_SIZE, le=MAX_SIZE)] = 300
    seed: Annotated[int, Interval(ge=0, le=2**31 - 1)] = 0

    def __post_init__(self) -> None:
        if self.name is None:
            self.name = folder_name(self.path)
        check_settings(self, "scene")
        if self.kind != "courtyard" and not self.path:
            raise InputError("scene.path is not set: say where the capture lies, for example scene.path=/my/photos")
        if self.kind == "courtyard" and self.path:
            raise InputError(
                f"scene.path={self.path} is not read by the built-in courtyard: add scene=photos (bare photographs), "
                "scene=colmap or scene=transforms"
            )
        self.split_rule.check()
        if self.split == "sector" and self.kind == "photos":
            raise InputError(
                "scene.split=sector needs the cameras, and these photographs came without: give a COLMAP model "
                "(scene=colmap)"
            )
        if self.kind == "courtyard" and self.masks is not None:
            raise InputError("scene.masks: the courtyard's photographs are made here and have none: leave it out")
        if self.kind == "courtyard":
            check_final_size((self.width, self.height), self.downscale, self.max_size, "the courtyard")

    @property
    def split_rule(self) -> SplitRule:
        """The split: the settings of what is held out."""
        return SplitRule(**{entry.name: getattr(self, entry.name) for entry in fields(SplitRule)})
