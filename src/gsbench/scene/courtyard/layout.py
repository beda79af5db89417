"""Objects of the courtyard: solid primitives with materials, in metres, z up, the lawn at z = 0."""

from collections.abc import Iterable, Iterator
from itertools import pairwise, product
from math import cos, pi, radians, sin
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

BOX, SPHERE, TUBE = 0, 1, 2
X, Y, Z = 0, 1, 2

STONE, PLASTER, WOOD, PAINT, TILES, LEAVES, CLAY, WATER, GLASS, METAL, LOG = range(11)

WALL_DISTANCE = 7.2  # m, inner face of the four walls from the centre
HOUSE_HEIGHT = 3.9  # m
WALL_HEIGHT = 2.3  # m
WELL_RADIUS = 0.8  # m

# Materials with their tints in linear RGB.
_OAK, _DARK_OAK = (WOOD, (0.30, 0.17, 0.085)), (WOOD, (0.16, 0.095, 0.05))
_PALE_WOOD, _DOOR = (WOOD, (0.48, 0.33, 0.18)), (WOOD, (0.05, 0.12, 0.20))
_OAK_LOG, _PALE_LOG = (LOG, _OAK[1]), (LOG, _PALE_WOOD[1])
_SANDSTONE, _GREY_STONE = (STONE, (0.46, 0.38, 0.28)), (STONE, (0.33, 0.32, 0.30))
_WHITE_STONE, _WHITEWASH = (STONE, (0.70, 0.63, 0.50)), (PLASTER, (0.70, 0.63, 0.50))
_TERRACOTTA, _ROOF = (CLAY, (0.48, 0.19, 0.10)), (TILES, (0.40, 0.14, 0.075))
_SHUTTER, _BALL = (PAINT, (0.06, 0.20, 0.22)), (PAINT, (0.50, 0.06, 0.04))
_IRON, _GLASS = (METAL, (0.06, 0.06, 0.065)), (GLASS, (0.05, 0.075, 0.10))
_LEAF, _DEEP_LEAF = (LEAVES, (0.10, 0.20, 0.045)), (LEAVES, (0.055, 0.13, 0.04))
_PALE_LEAF, _WATER = (LEAVES, (0.17, 0.25, 0.06)), (WATER, (0.02, 0.045, 0.045))


class Layout(NamedTuple):
    """The primitives as arrays, sorted by group; rays test the bounding box of a group first.

    The first three values of ``size`` are half extents of a BOX, (radius, -, -) of a SPHERE, or
    (outer radius, half height, inner radius or 0) of a TUBE, whose axis is local z. The fourth is
    the radius of the bounding sphere. ``rotation`` [S, 3, 3] maps local to world directions.
    """

    kind: NDArray[np.int64]  # [S]
    center: NDArray[np.float64]  # [S, 3] m
    rotation: NDArray[np.float64]  # [S, 3, 3]
    size: NDArray[np.float64]  # [S, 4] m
    material: NDArray[np.int64]  # [S]
    tint: NDArray[np.float64]  # [S, 3] linear RGB
    group_start: NDArray[np.int64]  # [G + 1] first primitive of each group
    group_low: NDArray[np.float64]  # [G, 3] m
    group_high: NDArray[np.float64]  # [G, 3] m


# A solid: its kind, position, size, material, tint and rotation. A group: x, y, yaw in degrees, and
# its solids, whose positions are relative to the group's.
Solid = tuple[
    int, tuple[float, ...], tuple[float, ...], int, tuple[float, ...], NDArray[np.float64]
]
Groups = Iterator[tuple[float, float, float, Iterable[Solid]]]


def build_layout(seed: int) -> Layout:
    """Build the courtyard. The plan is fixed; the seed varies small objects and shrubs."""
    rng, rows, starts = np.random.default_rng(seed), list[Any](), [0]
    for part in PARTS:
        for x, y, yaw, solids in part(rng):
            turn = _rotation(yaw, Z)
            for kind, at, size, material, tint, rotation in solids:
                center, reach = np.array([x, y, 0.0]) + turn @ at, _bounding_radius(kind, size)
                # Half the sides of an upright box around the solid, widened by 1e-6 m.
                half = np.array((size[0], *size[:2]) if kind == TUBE else size)
                half = np.minimum(np.abs(turn @ rotation) @ half, reach) + 1e-6
                bounds = center - half, center + half
                row = kind, center, turn @ rotation, (*size, reach), material, tint, *bounds
                rows.append(row)
            starts.append(len(rows))
    *columns, low, high = map(np.array, zip(*rows, strict=True))
    groups = [slice(*ends) for ends in pairwise(starts)]
    boxes = [low[own].min(axis=0) for own in groups], [high[own].max(axis=0) for own in groups]
    return Layout(*columns, *map(np.array, (starts, *boxes)))


def _bounding_radius(kind: int, size: tuple[float, ...]) -> float:
    if kind == SPHERE:
        return size[0]
    return float(np.linalg.norm(size if kind == BOX else size[:2]))


def _rotation(degrees: float, axis: int) -> NDArray[np.float64]:
    """The rotation [3, 3] about one axis (0, 1, 2 for x, y, z)."""
    angle, i, j = radians(degrees), (axis + 1) % 3, (axis + 2) % 3
    matrix = np.eye(3)
    matrix[i, i] = matrix[j, j] = cos(angle)
    matrix[i, j], matrix[j, i] = -sin(angle), sin(angle)
    return matrix


def box(x, y, z, width, depth, height, paint, degrees=0.0, axis=X) -> Solid:
    """A box with these sides, not half extents, turned about an axis."""
    size = width / 2, depth / 2, height / 2
    return BOX, (x, y, z), size, *paint, _rotation(degrees, axis)


def sphere(x, y, z, radius, paint) -> Solid:
    return SPHERE, (x, y, z), (radius, radius, radius), *paint, np.eye(3)


def tube(x, y, z, radius, height, paint, inner=0.0, tilt=0.0) -> Solid:
    """A cylinder, with a bore of the radius ``inner``."""
    return TUBE, (x, y, z), (radius, height / 2, inner), *paint, _rotation(tilt, Y)


def _house(_) -> Groups:
    y, width, height = WALL_DISTANCE + 0.3, 2 * WALL_DISTANCE, HOUSE_HEIGHT
    yield (
        0,
        y,
        0,
        [
            box(0, 0, height / 2, width + 1.2, 0.6, height, _WHITEWASH),
            box(0, -0.32, 0.22, width, 0.12, 0.44, _GREY_STONE),
        ],
    )
    yield (
        0,
        y,
        0,
        [
            box(0, 0.75, height + 0.55, width + 1.6, 2.9, 0.12, _ROOF, 30),
            box(0, -0.52, height - 0.14, width + 1.4, 0.1, 0.12, _DARK_OAK),
        ],
    )
    for x in (-5.0, -2.5, 2.5, 5.0):
        yield x, WALL_DISTANCE, 0, _window()
    yield (
        0,
        WALL_DISTANCE,
        0,
        [
            box(0, -0.03, 1.12, 1.36, 0.1, 2.24, _SANDSTONE),
            box(0, -0.07, 1.05, 1.04, 0.1, 2.1, _DOOR),
            sphere(0.4, -0.14, 1.0, 0.035, _IRON),
            box(0, -0.35, 0.08, 1.6, 0.7, 0.16, _SANDSTONE),
            box(0, -0.42, 2.5, 1.8, 0.95, 0.07, _ROOF, 22),
        ],
    )


def _window() -> Iterator[Solid]:
    yield box(0, -0.03, 1.75, 1.16, 0.1, 1.46, _PALE_WOOD)
    for x in (-0.27, 0.27):
        for z in (1.42, 2.06):
            yield box(x, -0.06, z, 0.46, 0.06, 0.54, _GLASS)
    for x in (-0.92, 0.92):
        yield box(x, -0.035, 1.75, 0.62, 0.07, 1.46, _SHUTTER)
        for z in (1.3, 2.2):
            yield box(x, -0.075, z, 0.6, 0.04, 0.09, _SHUTTER)
    yield box(0, -0.12, 0.95, 1.4, 0.28, 0.08, _SANDSTONE)
    yield box(0, -0.2, 1.08, 1.1, 0.2, 0.18, _TERRACOTTA)
    for x in (-0.38, 0.0, 0.38):
        yield sphere(x, -0.2, 1.22, 0.15, _PALE_LEAF)


def _walls(_) -> Groups:
    length, height, middle = 2 * WALL_DISTANCE + 1.2, WALL_HEIGHT, WALL_DISTANCE + 0.25
    for x, y, yaw in ((middle, 0.0, 90.0), (-middle, 0.0, 90.0), (0.0, -middle, 0.0)):
        yield (
            x,
            y,
            yaw,
            [
                box(0, 0, height / 2, length, 0.5, height, _SANDSTONE),
                box(0, 0, height + 0.06, length, 0.66, 0.12, _GREY_STONE),
            ],
        )
    gate = [box(0, 0.02, 1.15, 2.3, 0.16, 2.3, _GREY_STONE)]
    for x in (-0.48, 0.48):
        gate.append(box(x, 0.1, 1.05, 0.93, 0.1, 2.1, _OAK))
        gate += [box(x, 0.16, z, 0.86, 0.03, 0.1, _IRON) for z in (0.5, 1.6)]
    yield 0.6, -WALL_DISTANCE, 0, gate


def _pergola(rng) -> Groups:
    for y in (-4.2, -1.4, 1.4, 4.2):
        angle = rng.uniform(0, 2 * pi)
        yield (
            -5.9,
            y,
            0,
            [
                box(0, 0, 0.14, 0.56, 0.56, 0.28, _GREY_STONE),
                tube(0, 0, 1.27, 0.19, 1.98, _WHITE_STONE),
                box(0, 0, 2.32, 0.5, 0.5, 0.14, _GREY_STONE),
                sphere(0.24 * cos(angle), 0.24 * sin(angle), 0.32, 0.25, _DEEP_LEAF),
            ],
        )
    beam = box(0.4, 0, 2.48, 0.2, 9.6, 0.2, _DARK_OAK)
    rafters = [box(0.1, y, 2.64, 2.3, 0.11, 0.14, _OAK) for y in np.linspace(-4.5, 4.5, 10)]
    yield -6.3, 0, 0, [beam, *rafters]


def _shrubs(rng) -> Groups:
    places = [(6.5, y) for y in (-5.8, -3.9, -1.6, 0.8, 3.2, 5.4)]
    for x, y in (*places, *((x, -6.5) for x in (-5.6, -3.6, -1.8, 3.0, 5.0))):
        at = x + rng.uniform(-0.15, 0.1), y + rng.uniform(-0.3, 0.3)
        paint = (_LEAF, _DEEP_LEAF, _PALE_LEAF)[rng.integers(3)]
        radius = rng.uniform(0.36, 0.58)
        solids = [sphere(0, 0, 0.7 * radius, radius, paint)]
        for _ in range(4):
            angle, small = rng.uniform(0, 2 * pi), radius * rng.uniform(0.5, 0.72)
            beside = 0.62 * radius * cos(angle), 0.62 * radius * sin(angle)
            solids.append(sphere(*beside, radius * rng.uniform(0.5, 1.5), small, paint))
        yield *at, 0, solids


def _well(_) -> Groups:
    yield (
        0,
        0,
        20,
        [
            tube(0, 0, 0.36, WELL_RADIUS, 0.72, _GREY_STONE, 0.58),
            tube(0, 0, 0.76, WELL_RADIUS + 0.06, 0.1, _SANDSTONE, 0.54),
            tube(0, 0, 0.2, 0.58, 0.4, _WATER),
            *(box(x, 0, 1.4, 0.13, 0.13, 1.3, _OAK) for x in (-0.7, 0.7)),
            box(0, 0, 1.98, 1.75, 0.12, 0.12, _DARK_OAK),
            tube(0, 0, 1.52, 0.09, 1.35, _PALE_LOG, tilt=90),
            box(0, -0.37, 2.1, 1.95, 0.98, 0.06, _ROOF, 38),
            box(0, 0.37, 2.1, 1.95, 0.98, 0.06, _ROOF, -38),
            tube(0.15, -0.68, 0.95, 0.13, 0.28, _PALE_WOOD, 0.11),
            tube(0.15, -0.68, 0.87, 0.135, 0.03, _IRON, 0.11),
        ],
    )


def _crates(rng) -> Groups:
    yield (
        2.0,
        -1.25,
        18.0 + rng.uniform(-6, 6),
        [
            *_crate(0, 0, 0, 0.72, 0.0, _PALE_WOOD),
            *_crate(0.86, 0.12, 0, 0.56, 24.0, _OAK),
            *_crate(0.04, -0.02, 0.72, 0.46, 31.0 + rng.uniform(-5, 5), _OAK),
        ],
    )
    hoops = (tube(0, 0, z, 0.318, 0.05, _IRON) for z in (0.12, 0.3, 0.55, 0.74))
    yield 1.35, -2.15, 0, [tube(0, 0, 0.42, 0.31, 0.84, _OAK), *hoops]
    yield 1.15, 1.75, 0, [sphere(0, 0, 0.26, 0.26, _BALL)]


def _crate(x, y, z, side, yaw, paint) -> Iterator[Solid]:
    middle, board = z + side / 2, side - 0.04
    yield box(x, y, middle, board, board, side - 0.02, paint, yaw, Z)
    turn, half = _rotation(yaw, Z), side / 2 - 0.035
    for corner in product((-half, half), repeat=2):
        across, along = turn[:2, :2] @ corner
        yield box(x + across, y + along, middle, 0.07, 0.07, side, _DARK_OAK, yaw, Z)


def _bench(rng) -> Groups:
    seat = [box(0, y, 0.46, 1.6, 0.16, 0.045, _PALE_WOOD) for y in (-0.16, 0.0, 0.16)]
    seat += [box(0, 0.27, z, 1.6, 0.04, 0.13, _PALE_WOOD, -8) for z in (0.66, 0.84)]
    for x in (-0.68, 0.68):
        seat += [
            box(x, -0.16, 0.22, 0.07, 0.07, 0.44, _DARK_OAK),
            box(x, 0.25, 0.46, 0.07, 0.07, 0.92, _DARK_OAK, -4),
            box(x, 0.03, 0.40, 0.06, 0.46, 0.06, _DARK_OAK),
        ]
    yield -1.95, 1.45, 55.0 + rng.uniform(-6, 6), seat


def _pots(rng) -> Groups:
    for x, y, scale in ((-1.55, -1.75, 1.0), (-2.25, -1.15, 0.75), (-2.2, -2.15, 0.6)):
        paint = (_LEAF, _PALE_LEAF, _DEEP_LEAF)[rng.integers(3)]
        solids = [
            tube(0, 0, 0.2 * scale, 0.24 * scale, 0.4 * scale, _TERRACOTTA),
            tube(0, 0, 0.4 * scale, 0.28 * scale, 0.07 * scale, _TERRACOTTA),
            sphere(0, 0, 0.66 * scale, 0.3 * scale, paint),
        ]
        for _ in range(3):
            angle, out = rng.uniform(0, 2 * pi), 0.18 * scale
            at = out * cos(angle), out * sin(angle), scale * rng.uniform(0.65, 0.95)
            solids.append(sphere(*at, 0.19 * scale, paint))
        yield x, y, 0, solids


def _logs(rng) -> Groups:
    yaw, logs = -12.0 + rng.uniform(-5, 5), []
    for row, count in enumerate((4, 3, 2)):
        for k in range(count):
            at = rng.uniform(-0.04, 0.04), (k - (count - 1) / 2) * 0.25, 0.125 + row * 0.215
            logs.append(tube(*at, rng.uniform(0.112, 0.124), 0.9, _OAK_LOG, tilt=90))
    yield -0.15, -2.55, yaw, logs


def _sundial(rng) -> Groups:
    yield (
        2.45,
        1.0,
        rng.uniform(0, 45),
        [
            box(0, 0, 0.09, 0.66, 0.66, 0.18, _GREY_STONE),
            tube(0, 0, 0.58, 0.17, 0.8, _SANDSTONE),
            box(0, 0, 1.02, 0.44, 0.44, 0.09, _GREY_STONE),
            sphere(0, 0, 1.26, 0.2, _SANDSTONE),
        ],
    )


# Objects near the cameras come first: a ray that hits one skips the groups behind it.
PARTS = (_well, _crates, _bench, _pots, _logs, _sundial, _shrubs, _pergola, _walls, _house)
