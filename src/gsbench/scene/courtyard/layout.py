"""Objects of the courtyard: solid primitives with materials, in metres, z up, the lawn at z = 0."""

from dataclasses import dataclass, field
from itertools import pairwise
from math import cos, pi, radians, sin
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

BOX, SPHERE, TUBE = 0, 1, 2

STONE, PLASTER, WOOD, PAINT, TILES, LEAVES, CLAY, WATER, GLASS, METAL, LOG = range(11)

WALL_DISTANCE = 7.2  # m, inner face of the four walls from the centre
HOUSE_HEIGHT = 3.9  # m
WALL_HEIGHT = 2.3  # m
WELL_RADIUS = 0.8  # m

_OAK, _DARK_OAK, _PALE_WOOD = (0.30, 0.17, 0.085), (0.16, 0.095, 0.05), (0.48, 0.33, 0.18)
_SANDSTONE, _GREY_STONE = (0.46, 0.38, 0.28), (0.33, 0.32, 0.30)
_TERRACOTTA, _ROOF = (0.48, 0.19, 0.10), (0.40, 0.14, 0.075)
_WHITEWASH, _SHUTTER, _DOOR = (0.70, 0.63, 0.50), (0.06, 0.20, 0.22), (0.05, 0.12, 0.20)
_IRON, _GLASS, _WATER = (0.06, 0.06, 0.065), (0.05, 0.075, 0.10), (0.02, 0.045, 0.045)
_LEAF, _DEEP_LEAF, _PALE_LEAF = (0.10, 0.20, 0.045), (0.055, 0.13, 0.04), (0.17, 0.25, 0.06)


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


@dataclass
class _Builder:
    """Collects primitives in groups; positions are relative to the group's position and yaw."""

    rng: np.random.Generator
    rows: list[tuple[int, NDArray, NDArray, tuple, int, tuple]] = field(default_factory=list)
    starts: list[int] = field(default_factory=list)
    place: NDArray = field(default_factory=lambda: np.zeros(3))
    turn: NDArray = field(default_factory=lambda: np.eye(3))

    def group(self, x: float, y: float, yaw: float = 0.0) -> None:
        self.starts.append(len(self.rows))
        self.place, self.turn = np.array([x, y, 0.0]), _rotation(yaw=yaw)

    def add(self, kind: int, at, size, material: int, tint, **angles: float) -> None:
        center = self.place + self.turn @ np.array(at)
        self.rows.append((kind, center, self.turn @ _rotation(**angles), size, material, tint))

    def box(self, at, size, material, tint, **angles: float) -> None:
        """Add a box with side lengths ``size``, not half extents."""
        self.add(BOX, at, tuple(side / 2 for side in size), material, tint, **angles)

    def sphere(self, at, radius: float, material: int, tint) -> None:
        self.add(SPHERE, at, (radius, radius, radius), material, tint)

    def tube(
        self,
        at,
        radius: float,
        height: float,
        material: int,
        tint,
        inner: float = 0.0,
        **angles: float,
    ) -> None:
        self.add(TUBE, at, (radius, height / 2, inner), material, tint, **angles)

    def layout(self) -> Layout:
        kind, center, rotation, size, material, tint = zip(*self.rows, strict=True)
        sizes = [
            (*sides, _bounding_radius(shape, sides))
            for shape, sides in zip(kind, size, strict=True)
        ]
        starts = [*self.starts, len(self.rows)]
        bounds = np.array([_bounds(*row[:4]) for row in self.rows])  # [S, 2, 3]
        low = [bounds[a:b, 0].min(axis=0) for a, b in pairwise(starts)]
        high = [bounds[a:b, 1].max(axis=0) for a, b in pairwise(starts)]
        columns = (kind, center, rotation, sizes, material, tint, starts, low, high)
        return Layout(*map(np.array, columns))


def build_layout(seed: int) -> Layout:
    """Build the courtyard. The plan is fixed; the seed varies small objects and shrubs."""
    build = _Builder(np.random.default_rng(seed))
    # Objects near the cameras come first: a ray that hits one skips the groups behind it.
    _well(build)
    _crates(build)
    _bench(build)
    _pots(build)
    _logs(build)
    _sundial(build)
    _shrubs(build)
    _pergola(build)
    _walls(build)
    _house(build)
    return build.layout()


def _house(build: _Builder) -> None:
    build.group(0.0, WALL_DISTANCE + 0.3)
    width, height = 2 * WALL_DISTANCE, HOUSE_HEIGHT
    build.box((0, 0, height / 2), (width + 1.2, 0.6, height), PLASTER, _WHITEWASH)
    build.box((0, -0.32, 0.22), (width, 0.12, 0.44), STONE, _GREY_STONE)
    build.group(0.0, WALL_DISTANCE + 0.3)
    build.box((0, 0.75, height + 0.55), (width + 1.6, 2.9, 0.12), TILES, _ROOF, roll=30)
    build.box((0, -0.52, height - 0.14), (width + 1.4, 0.1, 0.12), WOOD, _DARK_OAK)
    for x in (-5.0, -2.5, 2.5, 5.0):
        build.group(x, WALL_DISTANCE)
        _window(build)
    build.group(0.0, WALL_DISTANCE)
    build.box((0, -0.03, 1.12), (1.36, 0.1, 2.24), STONE, _SANDSTONE)
    build.box((0, -0.07, 1.05), (1.04, 0.1, 2.1), WOOD, _DOOR)
    build.sphere((0.4, -0.14, 1.0), 0.035, METAL, _IRON)
    build.box((0, -0.35, 0.08), (1.6, 0.7, 0.16), STONE, _SANDSTONE)
    build.box((0, -0.42, 2.5), (1.8, 0.95, 0.07), TILES, _ROOF, roll=22)


def _window(build: _Builder) -> None:
    build.box((0, -0.03, 1.75), (1.16, 0.1, 1.46), WOOD, _PALE_WOOD)
    for x in (-0.27, 0.27):
        for z in (1.42, 2.06):
            build.box((x, -0.06, z), (0.46, 0.06, 0.54), GLASS, _GLASS)
    for x in (-0.92, 0.92):
        build.box((x, -0.035, 1.75), (0.62, 0.07, 1.46), PAINT, _SHUTTER)
        for z in (1.3, 2.2):
            build.box((x, -0.075, z), (0.6, 0.04, 0.09), PAINT, _SHUTTER)
    build.box((0, -0.12, 0.95), (1.4, 0.28, 0.08), STONE, _SANDSTONE)
    build.box((0, -0.2, 1.08), (1.1, 0.2, 0.18), CLAY, _TERRACOTTA)
    for x in (-0.38, 0.0, 0.38):
        build.sphere((x, -0.2, 1.22), 0.15, LEAVES, _PALE_LEAF)


def _walls(build: _Builder) -> None:
    length, height, middle = 2 * WALL_DISTANCE + 1.2, WALL_HEIGHT, WALL_DISTANCE + 0.25
    for x, y, yaw in ((middle, 0.0, 90.0), (-middle, 0.0, 90.0), (0.0, -middle, 0.0)):
        build.group(x, y, yaw)
        build.box((0, 0, height / 2), (length, 0.5, height), STONE, _SANDSTONE)
        build.box((0, 0, height + 0.06), (length, 0.66, 0.12), STONE, _GREY_STONE)
    build.group(0.6, -WALL_DISTANCE)
    build.box((0, 0.02, 1.15), (2.3, 0.16, 2.3), STONE, _GREY_STONE)
    for x in (-0.48, 0.48):
        build.box((x, 0.1, 1.05), (0.93, 0.1, 2.1), WOOD, _OAK)
        for z in (0.5, 1.6):
            build.box((x, 0.16, z), (0.86, 0.03, 0.1), METAL, _IRON)


def _pergola(build: _Builder) -> None:
    for y in (-4.2, -1.4, 1.4, 4.2):
        build.group(-5.9, y)
        build.box((0, 0, 0.14), (0.56, 0.56, 0.28), STONE, _GREY_STONE)
        build.tube((0, 0, 1.27), 0.19, 1.98, STONE, _WHITEWASH)
        build.box((0, 0, 2.32), (0.5, 0.5, 0.14), STONE, _GREY_STONE)
        angle = build.rng.uniform(0, 2 * pi)
        build.sphere((0.24 * cos(angle), 0.24 * sin(angle), 0.32), 0.25, LEAVES, _DEEP_LEAF)
    build.group(-6.3, 0.0)
    build.box((0.4, 0, 2.48), (0.2, 9.6, 0.2), WOOD, _DARK_OAK)
    for y in np.linspace(-4.5, 4.5, 10):
        build.box((0.1, float(y), 2.64), (2.3, 0.11, 0.14), WOOD, _OAK)


def _shrubs(build: _Builder) -> None:
    places = [(6.5, y) for y in (-5.8, -3.9, -1.6, 0.8, 3.2, 5.4)] + [
        (x, -6.5) for x in (-5.6, -3.6, -1.8, 3.0, 5.0)
    ]
    for x, y in places:
        build.group(x + build.rng.uniform(-0.15, 0.1), y + build.rng.uniform(-0.3, 0.3))
        tint = (_LEAF, _DEEP_LEAF, _PALE_LEAF)[build.rng.integers(3)]
        radius = build.rng.uniform(0.36, 0.58)
        build.sphere((0, 0, 0.7 * radius), radius, LEAVES, tint)
        for _ in range(4):
            angle, small = build.rng.uniform(0, 2 * pi), radius * build.rng.uniform(0.5, 0.72)
            height = radius * build.rng.uniform(0.5, 1.5)
            at = (0.62 * radius * cos(angle), 0.62 * radius * sin(angle), height)
            build.sphere(at, small, LEAVES, tint)


def _well(build: _Builder) -> None:
    build.group(0.0, 0.0, 20.0)
    build.tube((0, 0, 0.36), WELL_RADIUS, 0.72, STONE, _GREY_STONE, inner=0.58)
    build.tube((0, 0, 0.76), WELL_RADIUS + 0.06, 0.1, STONE, _SANDSTONE, inner=0.54)
    build.tube((0, 0, 0.2), 0.58, 0.4, WATER, _WATER)
    for x in (-0.7, 0.7):
        build.box((x, 0, 1.4), (0.13, 0.13, 1.3), WOOD, _OAK)
    build.box((0, 0, 1.98), (1.75, 0.12, 0.12), WOOD, _DARK_OAK)
    build.tube((0, 0, 1.52), 0.09, 1.35, LOG, _PALE_WOOD, tilt=90)
    build.box((0, -0.37, 2.1), (1.95, 0.98, 0.06), TILES, _ROOF, roll=38)
    build.box((0, 0.37, 2.1), (1.95, 0.98, 0.06), TILES, _ROOF, roll=-38)
    build.tube((0.15, -0.68, 0.95), 0.13, 0.28, WOOD, _PALE_WOOD, inner=0.11)
    build.tube((0.15, -0.68, 0.87), 0.135, 0.03, METAL, _IRON, inner=0.11)


def _crates(build: _Builder) -> None:
    build.group(2.0, -1.25, 18.0 + build.rng.uniform(-6, 6))
    _crate(build, (0, 0, 0), 0.72, 0.0, _PALE_WOOD)
    _crate(build, (0.86, 0.12, 0), 0.56, 24.0, _OAK)
    _crate(build, (0.04, -0.02, 0.72), 0.46, 31.0 + build.rng.uniform(-5, 5), _OAK)
    build.group(1.35, -2.15)
    build.tube((0, 0, 0.42), 0.31, 0.84, WOOD, _OAK)
    for z in (0.12, 0.3, 0.55, 0.74):
        build.tube((0, 0, z), 0.318, 0.05, METAL, _IRON)
    build.group(1.15, 1.75)
    build.sphere((0, 0, 0.26), 0.26, PAINT, (0.50, 0.06, 0.04))


def _crate(
    build: _Builder, at: tuple[float, float, float], side: float, yaw: float, tint: tuple
) -> None:
    x, y, z = at
    build.box((x, y, z + side / 2), (side - 0.04, side - 0.04, side - 0.02), WOOD, tint, yaw=yaw)
    turn, half, slat = _rotation(yaw=yaw), side / 2 - 0.035, 0.07
    for dx in (-half, half):
        for dy in (-half, half):
            across, along, _ = turn @ np.array([dx, dy, 0.0])
            post = (x + across, y + along, z + side / 2)
            build.box(post, (slat, slat, side), WOOD, _DARK_OAK, yaw=yaw)


def _bench(build: _Builder) -> None:
    build.group(-1.95, 1.45, 55.0 + build.rng.uniform(-6, 6))
    for y in (-0.16, 0.0, 0.16):
        build.box((0, y, 0.46), (1.6, 0.16, 0.045), WOOD, _PALE_WOOD)
    for z in (0.66, 0.84):
        build.box((0, 0.27, z), (1.6, 0.04, 0.13), WOOD, _PALE_WOOD, roll=-8)
    for x in (-0.68, 0.68):
        build.box((x, -0.16, 0.22), (0.07, 0.07, 0.44), WOOD, _DARK_OAK)
        build.box((x, 0.25, 0.46), (0.07, 0.07, 0.92), WOOD, _DARK_OAK, roll=-4)
        build.box((x, 0.03, 0.40), (0.06, 0.46, 0.06), WOOD, _DARK_OAK)


def _pots(build: _Builder) -> None:
    for x, y, scale in ((-1.55, -1.75, 1.0), (-2.25, -1.15, 0.75), (-2.2, -2.15, 0.6)):
        build.group(x, y)
        build.tube((0, 0, 0.2 * scale), 0.24 * scale, 0.4 * scale, CLAY, _TERRACOTTA)
        build.tube((0, 0, 0.4 * scale), 0.28 * scale, 0.07 * scale, CLAY, _TERRACOTTA)
        tint = (_LEAF, _PALE_LEAF, _DEEP_LEAF)[build.rng.integers(3)]
        build.sphere((0, 0, 0.66 * scale), 0.3 * scale, LEAVES, tint)
        for _ in range(3):
            angle, out = build.rng.uniform(0, 2 * pi), 0.18 * scale
            at = (out * cos(angle), out * sin(angle), scale * build.rng.uniform(0.65, 0.95))
            build.sphere(at, 0.19 * scale, LEAVES, tint)


def _logs(build: _Builder) -> None:
    build.group(-0.15, -2.55, -12.0 + build.rng.uniform(-5, 5))
    for row, count in enumerate((4, 3, 2)):
        for k in range(count):
            at = (build.rng.uniform(-0.04, 0.04), (k - (count - 1) / 2) * 0.25, 0.125 + row * 0.215)
            build.tube(at, build.rng.uniform(0.112, 0.124), 0.9, LOG, _OAK, tilt=90)


def _sundial(build: _Builder) -> None:
    build.group(2.45, 1.0, build.rng.uniform(0, 45))
    build.box((0, 0, 0.09), (0.66, 0.66, 0.18), STONE, _GREY_STONE)
    build.tube((0, 0, 0.58), 0.17, 0.8, STONE, _SANDSTONE)
    build.box((0, 0, 1.02), (0.44, 0.44, 0.09), STONE, _GREY_STONE)
    build.sphere((0, 0, 1.26), 0.2, STONE, _SANDSTONE)


def _rotation(yaw: float = 0.0, tilt: float = 0.0, roll: float = 0.0) -> NDArray[np.float64]:
    """The rotation [3, 3] by ``roll`` about x, ``tilt`` about y, then ``yaw`` about z, degrees."""
    a, b, c = radians(yaw), radians(tilt), radians(roll)
    about_z = np.array([[cos(a), -sin(a), 0], [sin(a), cos(a), 0], [0, 0, 1]])
    about_y = np.array([[cos(b), 0, sin(b)], [0, 1, 0], [-sin(b), 0, cos(b)]])
    about_x = np.array([[1, 0, 0], [0, cos(c), -sin(c)], [0, sin(c), cos(c)]])
    return about_z @ about_y @ about_x


def _bounds(kind: int, center: NDArray, rotation: NDArray, size: tuple) -> tuple[NDArray, NDArray]:
    """The axis-aligned bounds (low [3], high [3]) of one primitive, widened by 1e-6 m."""
    half = {BOX: size, SPHERE: size, TUBE: (size[0], size[0], size[1])}[kind]
    reach = np.full(3, size[0]) if kind == SPHERE else np.abs(rotation) @ np.array(half)
    return center - reach - 1e-6, center + reach + 1e-6


def _bounding_radius(kind: int, size: tuple) -> float:
    if kind == SPHERE:
        return size[0]
    return float(np.linalg.norm(size if kind == BOX else size[:2]))
