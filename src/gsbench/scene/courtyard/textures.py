"""Procedural solid textures of the courtyard, compiled with numba.

Every pattern is a sum of noise octaves. An octave fades out as its cells approach the footprint of
a pixel on the surface, so distant surfaces show no aliasing. All functions are scalar, pure and
deterministic. Colours are linear RGB.
"""

from math import floor, sqrt

from gsbench.scene.courtyard.layout import Material
from gsbench.system.jit import inlined


@inlined
def random_cell(x, y, z, seed):
    """A hash of a lattice cell, uniform in [0, 1)."""
    h = (x * 374761393 + y * 668265263 + z * 1274126177 + seed * 974634777) & 0xFFFFFFFF
    # the final mix of xxHash32
    h = ((h ^ (h >> 15)) * 2246822519) & 0xFFFFFFFF
    h = ((h ^ (h >> 13)) * 3266489917) & 0xFFFFFFFF
    return ((h ^ (h >> 16)) & 0xFFFFFFFF) / 4294967296.0


@inlined
def smooth(t):
    """Perlin 2002: 6 t^5 - 15 t^4 + 10 t^3 has no slope and no curvature at 0 and 1."""
    return t * t * t * (t * (6 * t - 15) + 10)


@inlined
def plane_noise(x, y, seed):
    """Value noise over the plane with unit cells, in [-1, 1]."""
    ix, iy = floor(x), floor(y)
    u, v = smooth(x - ix), smooth(y - iy)
    low = random_cell(ix, iy, 0, seed) * (1 - u) + random_cell(ix + 1, iy, 0, seed) * u
    high = random_cell(ix, iy + 1, 0, seed) * (1 - u) + random_cell(ix + 1, iy + 1, 0, seed) * u
    return 2 * (low * (1 - v) + high * v) - 1


@inlined
def noise(point, cell, seed):
    """Value noise in space with cells of ``cell`` m, in [-1, 1]."""
    x, y, z = point[0] / cell, point[1] / cell, point[2] / cell
    layer = floor(z)
    w = smooth(z - layer)
    near = plane_noise(x, y, seed + 7919 * layer)
    if w == 0.0:  # also for all patterns over the plane
        return near
    return near * (1 - w) + plane_noise(x, y, seed + 7919 * (layer + 1)) * w


@inlined
def unit(value):
    """The nearest number in [0, 1]."""
    return min(1.0, max(0.0, value))


@inlined
def visible(cell, footprint):
    """The weight of a detail of size ``cell``: 0 up to one pixel of ``footprint``, 1 from two."""
    return unit(cell / footprint - 1.0)


@inlined
def octaves(point, cell, count, gain, footprint, seed):
    """Noise octaves in space, about [-1, 1]; cells of ``cell`` m, halved for each octave."""
    total, amplitude = 0.0, 1.0
    for k in range(count):
        weight = visible(cell, footprint)
        if weight == 0.0:
            break
        total += weight * amplitude * noise(point, cell, seed + k)
        amplitude *= gain
        cell *= 0.5
    return total


@inlined
def pebbles(x, y, cell, seed):
    """Cellular noise at (x, y), with one random feature point in each cell.

    Returns the distance to the nearest point, how much farther the second is, both in cells, and a
    random shade of the nearest point in [0, 1).
    """
    # Worley 1996; only the point's own cell and the cells beside it are searched
    gx, gy = floor(x / cell), floor(y / cell)
    first, second, shade = 9.0, 9.0, 0.0
    for i in range(gx - 1, gx + 2):
        for j in range(gy - 1, gy + 2):
            dx = i + random_cell(i, j, 1, seed) - x / cell
            dy = j + random_cell(i, j, 2, seed) - y / cell
            distance = sqrt(dx * dx + dy * dy)
            if distance < first:
                first, second, shade = distance, first, random_cell(i, j, 3, seed)
            elif distance < second:
                second = distance
    return first, second - first, shade


@inlined
def groove(position, period, width, footprint):
    """1 on the lines between strips of ``period``, else 0, softened to the pixel's footprint."""
    offset = abs(position / period - floor(position / period + 0.5)) * period
    soft = max(width, 0.7 * footprint)
    line = max(0.0, 1.0 - offset / soft)
    return line * min(1.0, width / soft) * min(1.0, 1.5 * width / soft + 0.2)


@inlined
def minus(a, b):
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@inlined
def scaled(factor, v):
    return factor * v[0], factor * v[1], factor * v[2]


@inlined
def ahead(origin, t, direction):
    """The point at distance ``t`` along a ray."""
    return origin[0] + t * direction[0], origin[1] + t * direction[1], origin[2] + t * direction[2]


@inlined
def blend(color, share, other):
    """``color`` with a ``share`` of the ``other`` colour."""
    return ahead(color, share, minus(other, color))


@inlined
def ground(point, footprint, seed):
    """Colour of the ground at a place in m: lawn, a gravel path, and bare soil along the walls."""
    x, y, _ = point
    flat = x, y, 0.0
    wobble = 0.10 * octaves(flat, 0.7, 4, 0.6, footprint, seed + 11)
    radius = sqrt(x * x + y * y)
    to_door = max(abs(x + 0.12 * y * (y - 7.2) / 7.2) - 0.55, -y)
    to_gate = max(abs(x - 0.6 * (y / 7.2) ** 2 + 0.9 * y * (y + 7.2) / 14.0 * 0.5) - 0.5, y)
    path = min(min(to_door, to_gate), abs(radius - 1.15) - 0.32) + wobble
    soil = min(7.2 - abs(x), 7.2 - abs(y)) - 1.05 + 1.3 * wobble
    edge = max(0.03, footprint)

    # The grass is faint on purpose, so that feature detectors find little in the lawn.
    patch = octaves(flat, 1.9, 3, 0.55, footprint, seed + 21)
    blades = octaves((x * 1.5, y, 0.0), 0.14, 4, 0.85, 0.8 * footprint, seed + 31)
    tuft = noise(flat, 0.33, seed + 41)
    light = 1.0 + 0.10 * patch + 0.13 * blades + 0.06 * tuft
    dry = unit(0.35 + 0.30 * patch + 0.12 * tuft)
    color = scaled(light, ahead((0.092, 0.135, 0.036), dry, (0.062, 0.020, 0.014)))
    inside = unit(0.5 - path / edge)
    if inside > 0.0:
        _, border, shade = pebbles(x, y, 0.055, seed + 51)
        sharp = visible(0.055, footprint)
        gap = unit(1.0 - 4.0 * border)
        stone = 0.27 + sharp * (0.26 * (shade - 0.5) - 0.15 * gap + 0.05)
        stone *= 1.0 + 0.10 * octaves(flat, 0.9, 4, 0.7, footprint, seed + 61)
        warm = 0.06 * sharp * (2.0 * random_cell(int(shade * 4096.0), 5, 0, seed) - 1.0)
        gravel = stone * (1.06 + warm), stone * 0.97, stone * (0.83 - warm)
        color = blend(color, inside, gravel)
    bare = unit(0.5 - soil / edge) * (1.0 - inside)
    if bare > 0.0:
        earth = 1.0 + 0.45 * octaves(flat, 0.16, 4, 0.7, footprint, seed + 71)
        color = blend(color, bare, scaled(earth, (0.115, 0.075, 0.045)))
    return color


@inlined
def shade_factors(material, point, face, footprint, seed):
    """(lightness, warmth) of a material at a local point in m, and a place on its ``face`` in m.

    Lightness is a factor of the tint; warmth above 0 makes it redder, below 0 bluer.
    """
    (px, py, pz), (u, v) = point, face
    light, warmth = 1.0, 0.0
    if material == Material.STONE:
        row = floor(v / 0.24)
        shift = u + 0.27 * row + 0.1 * random_cell(row, 3, 0, seed)
        column = floor(shift / 0.46)
        block = random_cell(column, row, 9, seed) - 0.5
        mortar = max(groove(shift, 0.46, 0.016, footprint), groove(v, 0.24, 0.016, footprint))
        grain = octaves(point, 0.13, 4, 0.75, footprint, seed + 101)
        light = (1.0 + 0.42 * block + 0.22 * grain) * (1.0 - 0.45 * mortar)
        warmth = 0.5 * (random_cell(column, row, 10, seed) - 0.5)
    elif material == Material.PLASTER:
        stain = octaves(point, 1.3, 3, 0.6, footprint, seed + 111)
        grain = octaves(point, 0.11, 4, 0.8, footprint, seed + 121)
        damp = unit(1.0 - (v + 1.95) / 0.9)
        light = 1.0 + 0.07 * stain + 0.07 * grain - 0.22 * damp * (0.6 + 0.5 * stain)
        warmth = 0.10 * stain
    elif material in (Material.WOOD, Material.PAINT):
        plank = floor(v / 0.16 + 0.5)
        tone = random_cell(plank, 4, 0, seed) - 0.5
        fibre = octaves((u * 0.12, v, px + py + pz), 0.035, 3, 0.8, 0.7 * footprint, seed + 131)
        knots = octaves((u, v * 2.5, pz), 0.3, 3, 0.6, footprint, seed + 141)
        strength, depth = (1.0, 0.55) if material == Material.WOOD else (0.25, 0.0)
        light = 1.0 + strength * (0.30 * tone + 0.24 * fibre + 0.20 * knots)
        light *= 1.0 - depth * groove(v + 0.08, 0.16, 0.008, footprint)
        warmth = 0.2 * strength * (tone + knots)
    elif material == Material.TILES:
        row = floor(v / 0.2)
        shift = u + 0.09 * (row - 2.0 * floor(row / 2.0))
        tile = random_cell(floor(shift / 0.18), row, 6, seed) - 0.5
        ridge = (v / 0.2 - row) if footprint < 0.2 else 0.5
        moss = unit(octaves(point, 0.5, 4, 0.7, footprint, seed + 151) - 0.25)
        light = (1.0 + 0.55 * tile * visible(0.18, footprint)) * (0.72 + 0.5 * ridge)
        light *= 1.0 - 0.5 * groove(shift, 0.18, 0.012, footprint)
        warmth = 0.4 * tile - 1.1 * moss
    elif material == Material.LEAVES:
        _, border, leaf = pebbles(u + 0.31 * pz, v + 0.23 * px, 0.032, seed + 161)
        sharp = visible(0.032, footprint)
        clump = octaves(point, 0.22, 3, 0.7, footprint, seed + 171)
        gap = unit(1.0 - 5.0 * border)
        light = 0.9 + sharp * (0.9 * (leaf - 0.5) - 0.40 * gap) + 0.40 * clump
        warmth = 0.5 * sharp * (leaf - 0.5) + 0.2 * clump
    elif material == Material.CLAY:
        light = 1.0 + 0.22 * octaves(point, 0.12, 4, 0.75, footprint, seed + 181)
        light *= 1.0 - 0.2 * groove(v, 0.1, 0.008, footprint)
        warmth = 0.3 * noise(point, 0.15, seed + 182)
    elif material in (Material.WATER, Material.GLASS):
        ripple = octaves(point, 0.4, 2, 0.5, footprint, seed + 191)
        light = 1.0 + 0.35 * ripple + 0.5 * min(0.3, max(-0.3, v))
    elif material == Material.METAL:
        rust = octaves(point, 0.1, 4, 0.8, footprint, seed + 201)
        light = 1.0 + 0.4 * rust
        warmth = 0.8 * unit(rust)
    elif material == Material.LOG:
        radius = sqrt(px * px + py * py)
        bark = octaves((px * 2.0, py * 2.0, pz * 0.35), 0.06, 3, 0.8, footprint, seed + 211)
        light = 0.8 + 0.55 * bark
        if u * u + v * v < 0.1 and abs(abs(pz) - 0.45) < 1e-4:  # the sawn ends show rings
            bent = radius + 0.01 * noise((px, py, 0.0), 0.03, seed)
            rings = groove(bent, 0.02, 0.005, footprint)
            light = 2.2 - 0.9 * rings + 0.25 * noise((px, py, 0.0), 0.04, seed + 5)
        warmth = 0.25 * bark
    return max(light, 0.08), warmth
