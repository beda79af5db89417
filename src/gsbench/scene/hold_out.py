"""Dividing photographs into training and test views, and the rest again for validation.

Sectors need an order of cameras in which neighbours are next to each other. Cameras that surround
the scene are ordered by azimuth around its centre and up direction. Other cameras are ordered along
the principal axis of their centres, so that planes across the axis separate the sectors.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from gsbench.errors import InputError
from gsbench.scene.names import match
from gsbench.scene.options import SplitRule
from gsbench.scene.types import Array
from gsbench.words import counted, some_of

# degrees: cameras with a wider gap between azimuths are on one side of the scene
SURROUNDED = 180.0
OPEN_RING = 30.0  # degrees: the order begins after a gap wider than this, else at the first camera
FACING = 0.9  # share of the cameras that must look towards the centre
# smallest eigenvalue of the axes' normal matrix (at most 2/3) below which axes count as parallel
PARALLEL = 1e-3
# decimals of a degree to which azimuths are rounded, so that all processors agree on ties
AZIMUTH_DECIMALS = 6


def arrange_cameras(cameras: Sequence[Any]) -> tuple[list[int], str]:
    """Order cameras by azimuth if they surround the scene, else along their principal axis.

    They have a ``rotation`` and a ``center``, as a `Camera` and a `Photograph` have. The azimuths
    start at the first camera, or after a gap of more than 30 degrees. Returns indices, and what the
    cameras are ordered by, and why.
    """
    centers = np.array([camera.center for camera in cameras])  # [V, 3]
    axes = np.array([camera.rotation for camera in cameras])  # [V, 3, 3] right, down, ahead
    azimuths, fault = _azimuths(axes, centers)
    if azimuths is not None:
        order = np.argsort(azimuths, kind="stable")
        around = azimuths[order]
        gaps = np.diff(around, append=around[0] + 360.0)  # [V] after each camera, degrees
        widest = int(gaps.argmax())
        gap = float(gaps[widest])
        if gap >= SURROUNDED:
            fault = (
                f"the cameras stand on one side of the scene, with none in {gap:.0f} degrees "
                "around its centre"
            )
    if fault:
        description = f"by planes across the principal axis of the cameras' centres, since {fault}"
        order = np.argsort(along_principal_axis(centers), kind="stable")
    else:
        if gap > OPEN_RING:
            order = np.roll(order, -(widest + 1))
        description = (
            "by azimuth around the scene's up and centre, as the cameras surround it (gaps up to "
            f"{gap:.0f} degrees)"
        )
    return order.tolist(), description


def sector_range(count: int, sector: int, sectors: int, exactly: int | None = None) -> range:
    """The positions of one of ``sectors`` contiguous parts of ``count`` ordered views.

    The sizes of sectors differ by at most one. With ``exactly``, the part has this many positions
    from the sector's start.

    Examples:
        >>> [list(sector_range(7, sector, 3)) for sector in range(3)]
        [[0, 1], [2, 3], [4, 5, 6]]
    """
    start, stop = sector * count // sectors, (sector + 1) * count // sectors
    return range(start, stop if exactly is None else start + exactly)


def along_principal_axis(centers: Array) -> Array:
    """Coordinates [V] of centres [V, 3] on their principal axis, away from the first camera."""
    coordinates: Array = (centers - centers.mean(axis=0)) @ _principal_axes(centers)[0]
    # The SVD leaves the sign of the axis open: the first camera that is not at the mean fixes it.
    off_center = np.abs(coordinates) > 1e-9 * (np.abs(coordinates).max() + 1e-300)
    return -coordinates if coordinates[np.argmax(off_center)] > 0.0 else coordinates


def _principal_axes(centers: Array) -> Array:
    return np.linalg.svd(centers - centers.mean(axis=0), full_matrices=False)[2]


def point_looked_at(forwards: Array, centers: Array) -> Array | None:
    """The point [3] nearest to all viewing axes in least squares; None if they are parallel."""
    across = np.eye(3) - forwards[:, :, None] * forwards[:, None, :]  # [V, 3, 3]
    normal = across.mean(axis=0)
    if float(np.linalg.eigvalsh(normal)[0]) < PARALLEL:
        return None
    # The sum over cameras of |P (p - c)|^2, where P takes away what lies along a viewing axis, is
    # least where (mean P) p = mean (P c).
    return np.linalg.solve(normal, (across @ centers[:, :, None]).mean(axis=0)[:, 0])


def scene_up(downs: Array, centers: Array) -> Array:
    """The mean up direction [3] or, if directions cancel out, the normal of the centres' plane."""
    mean: Array = -downs.mean(axis=0)
    length = float(np.linalg.norm(mean))
    return mean / length if length > 0.5 else _principal_axes(centers)[-1]


def _azimuths(axes: Array, centers: Array) -> tuple[Array | None, str]:
    """Azimuths [V] in [0, 360) from the first camera, counter-clockwise; or None and the reason."""
    forwards = axes[:, 2]  # [V, 3]
    center = point_looked_at(forwards, centers)
    if center is None:
        return None, "the cameras look in one direction"
    facing = float((((center - centers) * forwards).sum(axis=1) > 0).mean())
    if facing < FACING:
        return None, f"the cameras do not look at one place; {facing:.0%} do"
    up = scene_up(axes[:, 1], centers)
    flat = (centers - center) - ((centers - center) @ up)[:, None] * up  # [V, 3]
    first = flat[0] / (np.linalg.norm(flat[0]) or 1.0)
    aside = np.cross(up, first)
    degrees = np.degrees(np.arctan2(flat @ aside, flat @ first))  # [V]
    return np.round(degrees, AZIMUTH_DECIMALS).astype(np.float64) % 360.0, ""


def select_images(names: Sequence[str], max_images: int) -> list[str]:
    """Select at most ``max_images`` of n names: the k-th of m selected has index ``k * n // m``.

    The first name is always kept, and views on a closed ring stay evenly spaced. Images are
    selected before the split.

    Examples:
        >>> select_images(["a", "b", "c", "d", "e"], 3)
        ['a', 'b', 'd']
    """
    count = min(max_images, len(names))
    return [names[k * len(names) // count] for k in range(count)]


def resolve(wanted: Sequence[str] | None, names: Sequence[str]) -> list[str] | None:
    """The image files among ``names`` that a list names; extensions may be missing or differ."""
    if wanted is None:
        return None
    matches = match(wanted, names)
    if unknown := [name for name in wanted if name not in matches]:
        raise InputError(
            f"the split lists name {some_of(unknown)}, not among the usable images: correct the "
            "lists"
        )
    return sorted(matches.values())


def split_names(
    names: Sequence[str], train: Sequence[str] | None, test: Sequence[str] | None
) -> tuple[list[str], list[str]]:
    """Split sorted names into (training, test) by lists.

    If only one list is given, the other side gets all other names. If both are given, names in
    neither list are dropped. Raises `InputError` if there is no training view or no test view.
    """
    held_out = set(names) - set(train or ()) if test is None else set(test)
    if both := sorted(held_out & set(train or ())):
        raise InputError(
            f"the split lists hold {some_of(both)} for training and for testing: name each "
            "image once"
        )
    kept = set(names if train is None else train) - held_out
    training, testing = ([name for name in names if name in side] for side in (kept, held_out))
    if not training:
        raise InputError(
            f"the split leaves no training view of {len(names)}: raise scene.test_every or "
            "correct the lists"
        )
    if not testing:
        raise InputError(f"the split leaves no test view of {len(names)}: correct the lists")
    return training, testing


# names for training, names for testing
SplitLists = tuple[Sequence[str] | None, ...]
# names of training views and of test views, and how they were divided, in words
Split = tuple[list[str], list[str], str]


def hold_out(
    names: Sequence[str],
    rule: SplitRule,
    lists: SplitLists = (None, None),
    cameras: Mapping[str, Any] = {},
) -> Split:
    """Divide sorted ``names`` by ``rule``.

    ``lists`` are the resolved names of the training and the test list, ``cameras`` those of
    `arrange_cameras` by name, for sectors. With ``rule.validation``, the test views are dropped and
    the training views are divided again. Raises InputError if no view is left for training or for
    testing.
    """
    train, test, description = _divide(names, rule, lists, cameras)
    if not rule.validation:
        return train, test, description
    if rule.by_lists:  # the lists held out the test views above and cannot divide the rest
        rule = replace(rule, split="every_nth", train_list=None, test_list=None)
    away = f"the {counted(len(test), 'test view')} ({description}) put away unseen"
    train, test, description = _divide(train, rule, (None, None), cameras)
    return train, test, f"for validation {description}, with {away}"


def _divide(
    names: Sequence[str], rule: SplitRule, lists: SplitLists, cameras: Mapping[str, Any]
) -> Split:
    matched = max(1, len(names) // rule.sectors) if rule.match_views else None
    train, test = lists
    if rule.by_lists:
        description = "by lists"
    elif rule.split == "sector":
        if len(names) < rule.sectors:
            raise InputError(
                f"scene.sectors={rule.sectors} are more than the {len(names)} images: give fewer"
            )
        order, by = arrange_cameras([cameras[name] for name in names])
        positions = sector_range(len(names), rule.sector, rule.sectors, matched)
        test = [names[order[position]] for position in positions]
        description = f"part {rule.sector} of {rule.sectors} {by}"
    elif matched is None:
        test, description = names[:: rule.test_every], f"every {rule.test_every}th image"
    else:
        test = select_images(names, matched)
        spread = f"{matched} evenly spread over the sorted names"
        description = f"{spread}, as many as in a sector of {rule.sectors}"
    return *split_names(names, train, test), description
