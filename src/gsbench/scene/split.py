"""Settings of what is held out of a capture; `gsbench.scene.hold_out` does it. Loads nothing."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from gsbench.errors import InputError

SplitName = Literal["every_nth", "sector", "matched", "list"]
TEST_EVERY = 8  # Mip-NeRF 360 and 3DGS hold out every 8th image, from the first
SECTORS = 8  # as many views in each as every eighth
TRAIN_LIST, TEST_LIST = "train_list.txt", "test_list.txt"  # the names that nerfbaselines gives them


@dataclass(frozen=True)
class SplitRule:
    """Settings of holding views out; the fields are those of `gsbench.scene.options.SceneConfig`.

    ``every_nth``: every ``test_every``-th name, from the first. ``sector``: part ``sector`` of ``sectors`` contiguous
    ones (`gsbench.scene.sectors.arrange`). ``list``: as the lists say. With ``match_views`` the first two hold out
    equally many, those of a sector, so that equally many are left for training. ``validation``: the held-out views are
    put away, and the rule is applied to the rest once more.
    """

    split: SplitName = "every_nth"
    test_every: int = TEST_EVERY
    train_list: str | None = None
    test_list: str | None = None
    sector: int = 0
    sectors: int = SECTORS
    match_views: bool = False
    validation: bool = False

    @property
    def by_lists(self) -> bool:
        return self.split == "list" or self.train_list is not None or self.test_list is not None

    @property
    def asks_the_capture(self) -> bool:
        """Return whether a capture that says itself what it holds out is to be followed."""
        return self.split == "list" and self.train_list is None and self.test_list is None

    def check(self) -> None:
        """Raise InputError for settings that contradict each other."""
        lists = [key for key in ("train_list", "test_list") if getattr(self, key) is not None]
        if self.split == "matched":
            raise InputError(
                "scene.split=matched is a pair of trials: sweep it, as in -m scene.split=every_nth,sector "
                "scene.match_views=true"
            )
        if self.sector >= self.sectors:
            raise InputError(
                f"scene.sector={self.sector}: of scene.sectors={self.sectors} the last is {self.sectors - 1}"
            )
        if self.split == "sector" and lists:
            raise InputError(f"scene.split=sector and scene.{lists[0]} both say what is held out: give one")
        if self.match_views and self.by_lists:
            raise InputError("scene.match_views=true: what lists hold out cannot be matched; give every_nth or sector")


EVERY_NTH = SplitRule()
