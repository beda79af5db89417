"""Dividing photographs into training and test views: by a rule, by lists, and for a search once more among the rest."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from gsbench.errors import InputError
from gsbench.scene.camera import Camera
from gsbench.scene.names import select_images, split_names
from gsbench.scene.sectors import arrange, sector_of
from gsbench.scene.split import SplitRule
from gsbench.words import counted

Lists = tuple[Sequence[str] | None, Sequence[str] | None]
Cameras = Callable[[Sequence[str]], Sequence[Camera]]


@dataclass(frozen=True)
class HeldOut:
    """Result of a rule on sorted names; ``words`` say how."""

    train: tuple[str, ...]
    test: tuple[str, ...]
    words: str


def hold_out(
    names: Sequence[str], rule: SplitRule, lists: Lists = (None, None), cameras: Cameras | None = None
) -> HeldOut:
    """Divide sorted ``names`` as ``rule`` says.

    ``lists`` are the resolved names of the training and the test list; ``cameras`` gives the cameras of names, None
    where they came without. Raises InputError where nothing is left for training or for testing.
    """
    rule.check()
    train, test, words = _divide(names, rule, lists, cameras)
    if not rule.validation:
        return HeldOut(train, test, words)
    again = replace(rule, split="every_nth", train_list=None, test_list=None) if rule.by_lists else rule
    learned, judged, how = _divide(train, again, (None, None), cameras)
    away = f"the {counted(len(test), 'test view')} ({words}) put away unseen"
    return HeldOut(learned, judged, f"for validation {how}, with {away}")


def _divide(
    names: Sequence[str], rule: SplitRule, lists: Lists, cameras: Cameras | None
) -> tuple[tuple[str, ...], tuple[str, ...], str]:
    matched = max(1, len(names) // rule.sectors) if rule.match_views else None
    if rule.by_lists:
        train, test = split_names(names, rule.test_every, *lists)
        return tuple(train), tuple(test), "by lists"
    if rule.split == "sector":
        test, words = _sector(names, rule, matched, cameras)
    elif matched is not None:
        test = select_images(names, matched, least=1)
        words = f"{matched} evenly spread over the sorted names, as many as in a sector of {rule.sectors}"
    else:
        train, test = split_names(names, rule.test_every)
        return tuple(train), tuple(test), f"every {rule.test_every}th image" if rule.test_every else "none"
    train, test = split_names(names, test=test)
    return tuple(train), tuple(test), words


def _sector(
    names: Sequence[str], rule: SplitRule, exactly: int | None, cameras: Cameras | None
) -> tuple[list[str], str]:
    if cameras is None:
        raise InputError(
            "scene.split=sector needs the cameras, and these photographs came without: give a COLMAP model "
            "(scene=colmap; gsbench export writes that of a trial)"
        )
    if len(names) < rule.sectors:
        raise InputError(f"scene.sectors={rule.sectors} are more than the {len(names)} images: give fewer")
    found = arrange(cameras(names))
    places = sector_of(len(names), rule.sector, rule.sectors, exactly)
    test = [names[found.order[place]] for place in places]
    return test, f"part {rule.sector} of {rule.sectors} {found.words}"
