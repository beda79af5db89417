"""Dividing photographs into training and test views: by a rule, by lists, and for a search once more among the rest.

Sectors need cameras in an order in which neighbours stand beside each other. Where cameras surround the scene, that is
their azimuth around its up and centre; where they do not, their places along the principal axis of their centres, so
that planes across it cut them into parts.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gsbench.errors import InputError
from gsbench.scene.camera import Camera
from gsbench.scene.names import select_images, split_names
from gsbench.scene.options import SplitRule
from gsbench.words import counted

SURROUNDED = 180.0  # degrees: with a wider gap in their azimuths, cameras stand on one side of the scene
OPEN_RING = 30.0  # degrees: a wider gap is where a ring begins; else it begins at the first camera
FACING = 0.9  # share of the cameras that must look towards the centre
PARALLEL = 1e-3  # least eigenvalue of the axes' normal matrix, at most 2/3: below it, they meet nowhere
SAME_AZIMUTH = 6  # decimals of a degree: what differs by less is the same place, whatever the processor rounds

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Arrangement:
    """Cameras in order: ``order`` are their indices; ``description`` says by what, and why."""

    order: tuple[int, ...]
    description: str


def arrange(cameras: Sequence[Camera]) -> Arrangement:
    """The order of cameras around the scene, from the first one or from after the widest gap, else along an axis."""
    centers = np.array([camera.center for camera in cameras])  # [V, 3]
    azimuths, fault = _azimuths(cameras, centers)
    if azimuths is not None:
        order = np.argsort(azimuths, kind="stable")
        gaps = np.diff(azimuths[order], append=azimuths[order[0]] + 360.0)  # [V] after each camera, degrees
        widest = int(gaps.argmax())
        gap = float(gaps[widest])
        if gap >= SURROUNDED:
            fault = f"the cameras stand on one side of the scene, with none in {gap:.0f} degrees around its centre"
    if fault:
        description = f"by planes across the principal axis of the cameras' centres, since {fault}"
        return Arrangement(_sorted(along_axis(centers)), description)
    if gap > OPEN_RING:
        order = np.roll(order, -(widest + 1))
    return Arrangement(
        tuple(int(index) for index in order),
        f"by azimuth around the scene's up and centre, as the cameras surround it (gaps up to {gap:.0f} degrees)",
    )


def sector_of(count: int, sector: int, sectors: int, exactly: int | None = None) -> range:
    """The places, among ``count`` in order, of part ``sector`` of ``sectors``; ``exactly`` so many from its first.

    Parts are contiguous, leave nothing out, and differ by at most one in size.

    Examples:
        >>> [list(sector_of(7, part, 3)) for part in range(3)]
        [[0, 1], [2, 3], [4, 5, 6]]
    """
    start, stop = sector * count // sectors, (sector + 1) * count // sectors
    return range(start, stop if exactly is None else start + exactly)


def along_axis(centers: Array) -> Array:
    """Places [V] of camera centres [V, 3] on their principal axis, which points away from the first camera."""
    offsets = centers - centers.mean(axis=0)
    _, _, axes = np.linalg.svd(offsets, full_matrices=False)
    places: Array = offsets @ axes[0]
    sign = places[np.argmax(np.abs(places) > 1e-9 * (np.abs(places).max() + 1e-300))]  # of the first that is off centre
    return -places if sign > 0 else places


def looked_at(cameras: Sequence[Camera], centers: Array) -> Array | None:
    """The point [3] nearest to all viewing axes, in least squares; None where the axes are parallel."""
    forwards = np.array([camera.rotation[2] for camera in cameras])  # [V, 3]
    across = np.eye(3) - forwards[:, :, None] * forwards[:, None, :]  # [V, 3, 3]
    normal = across.mean(axis=0)
    if float(np.linalg.eigvalsh(normal)[0]) < PARALLEL:
        return None
    solution: Array = np.linalg.solve(normal, (across @ centers[:, :, None]).mean(axis=0)[:, 0])
    return solution


def scene_up(cameras: Sequence[Camera], centers: Array) -> Array:
    """The mean of the cameras' up [3]; where they have none in common, the normal of the plane of their centres."""
    mean = -np.array([camera.rotation[1] for camera in cameras]).mean(axis=0)
    length = float(np.linalg.norm(mean))
    if length > 0.5:
        up: Array = mean / length
        return up
    _, _, axes = np.linalg.svd(centers - centers.mean(axis=0), full_matrices=False)
    normal: Array = axes[-1]
    return normal


def _azimuths(cameras: Sequence[Camera], centers: Array) -> tuple[Array | None, str]:
    """Azimuths [V] in [0, 360) degrees from the first camera's, counter-clockwise from above; None, and why."""
    center = looked_at(cameras, centers)
    if center is None:
        return None, "the cameras look in one direction"
    forwards = np.array([camera.rotation[2] for camera in cameras])  # [V, 3]
    facing = float((((center - centers) * forwards).sum(axis=1) > 0).mean())
    if facing < FACING:
        return None, f"the cameras do not look at one place; {facing:.0%} do"
    up = scene_up(cameras, centers)
    flat = (centers - center) - ((centers - center) @ up)[:, None] * up  # [V, 3]
    first = flat[0] / np.linalg.norm(flat[0]) if np.linalg.norm(flat[0]) > 0 else np.zeros(3)
    aside = np.cross(up, first)
    degrees = np.degrees(np.arctan2(flat @ aside, flat @ first))  # [V]
    return np.round(degrees, SAME_AZIMUTH).astype(np.float64) % 360.0, ""


def _sorted(places: Array) -> tuple[int, ...]:
    return tuple(int(index) for index in np.argsort(places, kind="stable"))


Lists = tuple[Sequence[str] | None, Sequence[str] | None]
Cameras = Callable[[Sequence[str]], Sequence[Camera]]


@dataclass(frozen=True)
class HeldOut:
    """Result of a rule on sorted names; ``description`` says how."""

    train: tuple[str, ...]
    test: tuple[str, ...]
    description: str


def hold_out(
    names: Sequence[str], rule: SplitRule, lists: Lists = (None, None), cameras: Cameras | None = None
) -> HeldOut:
    """Divide sorted ``names`` as ``rule`` says.

    ``lists`` are the resolved names of the training and the test list; ``cameras`` gives the cameras of names, None
    where they came without. Raises InputError where nothing is left for training or for testing.
    """
    rule.check()
    train, test, description = _divide(names, rule, lists, cameras)
    if not rule.validation:
        return HeldOut(train, test, description)
    again = replace(rule, split="every_nth", train_list=None, test_list=None) if rule.by_lists else rule
    learned, judged, how = _divide(train, again, (None, None), cameras)
    away = f"the {counted(len(test), 'test view')} ({description}) put away unseen"
    return HeldOut(learned, judged, f"for validation {how}, with {away}")


def _divide(
    names: Sequence[str], rule: SplitRule, lists: Lists, cameras: Cameras | None
) -> tuple[tuple[str, ...], tuple[str, ...], str]:
    matched = max(1, len(names) // rule.sectors) if rule.match_views else None
    if rule.by_lists:
        train, test = split_names(names, rule.test_every, *lists)
        return tuple(train), tuple(test), "by lists"
    if rule.split == "sector":
        test, description = _sector(names, rule, matched, cameras)
    elif matched is not None:
        test = select_images(names, matched, least=1)
        description = f"{matched} evenly spread over the sorted names, as many as in a sector of {rule.sectors}"
    else:
        train, test = split_names(names, rule.test_every)
        return tuple(train), tuple(test), f"every {rule.test_every}th image" if rule.test_every else "none"
    train, test = split_names(names, test=test)
    return tuple(train), tuple(test), description


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
    return test, f"part {rule.sector} of {rule.sectors} {found.description}"
