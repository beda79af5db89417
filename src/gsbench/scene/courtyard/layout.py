"""The courtyard's plan (``plan.yaml``) as solid primitives with materials, in metres, z up."""

from collections.abc import Callable, Iterator
from enum import IntEnum
from itertools import pairwise, product
from math import cos, radians, sin
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gsbench.parsing import table_beside
from gsbench.scene.types import Array

BOX, SPHERE, TUBE = 0, 1, 2
X, Y, Z = 0, 1, 2
Material = IntEnum(
    "Material", "STONE PLASTER WOOD PAINT TILES LEAVES CLAY WATER GLASS METAL LOG", start=0
)


class Layout(NamedTuple):
    """The primitives as arrays, sorted by group; rays test the bounding box of a group first.

    The values of ``size`` are half extents of a BOX, (radius, -, -) of a SPHERE, or (outer radius,
    half height, inner radius or 0) of a TUBE, whose axis is local z. ``rotation`` [S, 3, 3] maps
    local to world directions.
    """

    kind: NDArray[np.int64]  # [S]
    center: Array  # [S, 3] m
    rotation: Array  # [S, 3, 3]
    size: Array  # [S, 3] m
    material: NDArray[np.int64]  # [S]
    tint: Array  # [S, 3] linear RGB
    group_start: NDArray[np.int64]  # [G + 1] first primitive of each group
    group_low: Array  # [G, 3] m
    group_high: Array  # [G, 3] m


# kind, position, size, paint and rotation of a primitive, relative to its part
Solid = tuple[int, tuple[float, ...], tuple[float, ...], str, Array]


def build_layout(seed: int) -> Layout:
    """Build the courtyard. The plan is fixed; the seed varies small objects and shrubs."""
    plan = table_beside(__file__, "plan.yaml")
    rng, rows, starts = np.random.default_rng(seed), list[Any](), [0]

    def draw(value: Any) -> float:
        return value[0] + rng.uniform(*value[1:]) if isinstance(value, list) else value

    # The order of the random numbers is part of the plan.
    for part in plan["parts"].values():
        for place in part["places"]:
            x, y, yaw = map(draw, place[:3])
            paints = plan["paints"]
            if leaves := part.get("leaves"):
                paints = {**paints, "any_leaf": paints[leaves[rng.integers(len(leaves))]]}
            scale, turn = draw([*place, 1.0][3]), _rotation(yaw, Z)
            for form, lengths, paint, *angles in part["solids"]:
                angles = [*map(draw, angles)]
                lengths = [scale * draw(length) for length in lengths]
                for kind, at, size, own, rotation in FORMS[form](*lengths, paint, *angles):
                    material, *tint = paints[own]
                    center = np.array([x, y, 0.0]) + turn @ at
                    # Half the sides of an upright box around the solid, widened by 1e-6 m.
                    half = np.array((size[0], *size[:2]) if kind == TUBE else size)
                    half = np.abs(turn @ rotation) @ half + 1e-6
                    look = Material[material.upper()], tint, center - half, center + half
                    rows.append((kind, center, turn @ rotation, size, *look))
            starts.append(len(rows))
    *columns, low, high = map(np.array, zip(*rows, strict=True))
    groups = [slice(*ends) for ends in pairwise(starts)]
    boxes = [low[own].min(axis=0) for own in groups], [high[own].max(axis=0) for own in groups]
    return Layout(*columns, *map(np.array, (starts, *boxes)))


def _rotation(degrees: float, axis: int) -> Array:
    """The rotation [3, 3] about one axis (0, 1, 2 for x, y, z)."""
    across, along = cos(radians(degrees)), sin(radians(degrees))
    about_z = np.array([[across, -along, 0.0], [along, across, 0.0], [0.0, 0.0, 1.0]])
    return np.roll(about_z, axis + 1, axis=(0, 1))


def box(x, y, z, width, depth, height, paint, degrees=0.0, axis=X) -> Iterator[Solid]:
    """A box with these sides, not half extents, turned about an axis."""
    yield BOX, (x, y, z), (width / 2, depth / 2, height / 2), paint, _rotation(degrees, axis)


def sphere(x, y, z, radius, paint) -> Iterator[Solid]:
    yield SPHERE, (x, y, z), (radius, radius, radius), paint, np.eye(3)


def tube(x, y, z, radius, height, paint, inner=0.0, tilt=0.0) -> Iterator[Solid]:
    """A cylinder, with a bore of the radius ``inner``."""
    yield TUBE, (x, y, z), (radius, height / 2, inner), paint, _rotation(tilt, Y)


def blob(out, radius, z, paint, angle) -> Iterator[Solid]:
    return sphere(out * cos(angle), out * sin(angle), z, radius, paint)


def crate(x, y, z, side, paint, yaw) -> Iterator[Solid]:
    """A box with a post of oak at each of its upright edges."""
    middle, board = z + side / 2, side - 0.04
    yield from box(x, y, middle, board, board, side - 0.02, paint, yaw, Z)
    turn, half = _rotation(yaw, Z), side / 2 - 0.035
    for corner in product((-half, half), repeat=2):
        across, along = turn[:2, :2] @ corner
        yield from box(x + across, y + along, middle, 0.07, 0.07, side, "dark_oak", yaw, Z)


FORMS: dict[str, Callable[..., Iterator[Solid]]] = {
    "box": box,
    "sphere": sphere,
    "tube": tube,
    "blob": blob,
    "crate": crate,
}
