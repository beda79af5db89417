"""Ray casting for the courtyard, compiled with numba.

All functions are pure. Points, directions and colours are tuples or arrays of three numbers.
"""

from math import exp, floor, inf, sqrt

import numpy as np

from gsbench.scene.courtyard.layout import BOX, SPHERE
from gsbench.scene.courtyard.textures import (
    ahead,
    blend,
    ground,
    minus,
    octaves,
    scaled,
    shade_factors,
    unit,
)
from gsbench.system.jit import inlined, kernel

GROUND, SKY = -1, -2
# unit vector towards the sun: from the south-west, 48 degrees high
SUN = (-0.5130, -0.4305, 0.7426)
SUN_LIGHT = (2.55, 2.30, 1.90)
SKY_LIGHT = (0.42, 0.50, 0.64)  # ambient light from above
BOUNCE_LIGHT = (0.19, 0.18, 0.13)  # ambient light from below
OCCLUSION_STEPS = (0.1, 0.35)  # m along the normal, where ambient occlusion is measured
EXPOSURE = 1.12
SUBSAMPLES = 2  # per side of a pixel
_EPSILON = 1e-4  # m, how far a shadow ray starts above the surface


@inlined
def dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inlined
def to_local(rotation, v):
    """World to local direction: the transpose of ``rotation`` [3, 3] times ``v``."""
    return dot(rotation[:, 0], v), dot(rotation[:, 1], v), dot(rotation[:, 2], v)


@inlined
def inverse(value):
    """1 / value, large but finite at 0, so that a ray along a face of a box gives no NaN."""
    return 1.0 / value if abs(value) > 1e-12 else 1e12


@inlined
def inverses(v):
    return inverse(v[0]), inverse(v[1]), inverse(v[2])


@inlined
def enter_box(low, high, origin, inverted):
    """(entry, exit) of a ray, with the inverses of its direction, and a box.

    If the ray misses the box, entry > exit.
    """
    # Kay and Kajiya 1986: the ray is in the box where it is between all three pairs of planes.
    entry, exit_ = -inf, inf
    for k in range(3):
        a, b = (low[k] - origin[k]) * inverted[k], (high[k] - origin[k]) * inverted[k]
        entry, exit_ = max(entry, min(a, b)), min(exit_, max(a, b))
    return entry, exit_


@inlined
def hit_tube(size, origin, direction):
    """The first distance > 0 of a ray to a capped cylinder, solid or bored; inf for a miss."""
    outer, half, inner = size[0], size[1], size[2]
    (ox, oy, oz), (dx, dy, dz) = origin, direction
    best = inf
    # The mantles x^2 + y^2 = r^2: the roots of a t^2 + 2 b t + c. A ray along the axis has a = 0.
    a = dx * dx + dy * dy
    for radius in (outer, inner):
        if radius > 0.0 and a > 1e-12:
            b, c = ox * dx + oy * dy, ox * ox + oy * oy - radius * radius
            root = b * b - a * c
            if root > 0.0:
                root = sqrt(root)
                for t in ((-b - root) / a, (-b + root) / a):
                    if 0.0 < t < best and abs(oz + t * dz) <= half:
                        best = t
    # The caps z = -half and z = half are rings between the bore and the mantle.
    if abs(dz) > 1e-12:
        for cap in (-half, half):
            t = (cap - oz) / dz
            if 0.0 < t < best:
                x, y = ox + t * dx, oy + t * dy
                if inner * inner <= x * x + y * y <= outer * outer:
                    best = t
    return best


@inlined
def hit_primitive(kind, size, origin, direction):
    """The first distance > 0 along a local ray to the primitive, or inf if it misses."""
    if kind == BOX:
        entry, exit_ = enter_box(scaled(-1.0, size), size, origin, inverses(direction))
        return entry if 0.0 < entry <= exit_ else inf
    if kind == SPHERE:
        # |o + t d| = r with |d| = 1: t^2 + 2 b t + c = 0
        b, c = dot(origin, direction), dot(origin, origin) - size[0] * size[0]
        root = b * b - c
        if root <= 0.0:
            return inf
        t = -b - sqrt(root)
        return t if t > 0.0 else inf
    return hit_tube(size, origin, direction)


@inlined
def cast(layout, origin, direction, any_hit):
    """(distance, primitive) of the nearest hit; the primitive may be GROUND or SKY.

    With ``any_hit``, for shadow rays, the first primitive found ends the search, and the ground is
    ignored.
    """
    best, index = inf, SKY
    inverted = inverses(direction)
    if direction[2] < -1e-9 and not any_hit:
        best, index = -origin[2] / direction[2], GROUND
    for g in range(len(layout.group_low)):
        entry, exit_ = enter_box(layout.group_low[g], layout.group_high[g], origin, inverted)
        if entry > exit_ or exit_ < 0.0 or entry > best:
            continue
        for i in range(layout.group_start[g], layout.group_start[g + 1]):
            size, rotation = layout.size[i], layout.rotation[i]
            start = minus(origin, layout.center[i])
            local = to_local(rotation, start), to_local(rotation, direction)
            t = hit_primitive(layout.kind[i], size, local[0], local[1])
            if t < best:
                best, index = t, i
                if any_hit:
                    return best, index
    return best, index


@inlined
def signed_distance(kind, size, point):
    """Distance from a local point to the primitive's surface, negative inside."""
    x, y, z = point
    if kind == SPHERE:
        return sqrt(dot(point, point)) - size[0]
    if kind == BOX:
        qx, qy, qz = abs(x) - size[0], abs(y) - size[1], abs(z) - size[2]
    else:
        middle = 0.5 * (size[0] + size[2]) if size[2] > 0.0 else 0.0
        qx, qy, qz = abs(sqrt(x * x + y * y) - middle) - (size[0] - middle), -inf, abs(z) - size[1]
    # A box, or the section of a tube, which is a box in (radius, z). Outside, this is the distance
    # to the nearest face, edge or corner; inside, minus the distance to the nearest face.
    outside = sqrt(max(qx, 0.0) ** 2 + max(qy, 0.0) ** 2 + max(qz, 0.0) ** 2)
    return outside + min(max(qx, qy, qz), 0.0)


@inlined
def nearest_surface(layout, point, limit):
    """The smallest |distance| from a point to any surface or the ground, at most ``limit``."""
    best = min(abs(point[2]), limit)
    for g in range(len(layout.group_low)):
        low, high, away = layout.group_low[g], layout.group_high[g], 0.0
        for k in range(3):
            away += max(low[k] - point[k], 0.0, point[k] - high[k]) ** 2
        # no primitive in the group's box can be nearer than the box itself
        if away >= best * best:
            continue
        for i in range(layout.group_start[g], layout.group_start[g + 1]):
            size, offset = layout.size[i], minus(point, layout.center[i])
            local = to_local(layout.rotation[i], offset)
            best = min(best, abs(signed_distance(layout.kind[i], size, local)))
    return best


@inlined
def sign(value):
    return 1.0 if value > 0 else -1.0


@inlined
def longer_first(a, b, size_a, size_b):
    """The coordinates of a face, that of its longer side first: grain and planks run along it."""
    return (a, b) if size_a > size_b else (b, a)


@inlined
def local_normal(kind, size, point):
    """The outward normal at a local surface point, and a pair of m along the face."""
    x, y, z = point
    if kind == SPHERE:
        r = size[0]
        return (x / r, y / r, z / r), ((x + y) * 0.8, z + 0.4 * (x - y))
    if kind == BOX:
        qx, qy, qz = abs(x) - size[0], abs(y) - size[1], abs(z) - size[2]
        if qx >= qy and qx >= qz:
            return (sign(x), 0.0, 0.0), longer_first(y, z, size[1], size[2])
        if qy >= qz:
            return (0.0, sign(y), 0.0), longer_first(x, z, size[0], size[2])
        return (0.0, 0.0, sign(z)), longer_first(x, y, size[0], size[1])
    radius = sqrt(x * x + y * y)
    if abs(abs(z) - size[1]) < min(abs(radius - size[0]), abs(radius - size[2])):
        return (0.0, 0.0, sign(z)), (x, y)
    side = 1.0 if abs(radius - size[0]) <= abs(radius - size[2]) else -1.0
    return (side * x / radius, side * y / radius, 0.0), (np.arctan2(y, x) * size[0], z)


@inlined
def sky(direction, seed):
    """The colour of the sky in a direction: a gradient with faint clouds."""
    up = unit(direction[2])
    mist = exp(-5.0 * up)
    scale = 1.0 / (up + 0.18)
    place = direction[0] * scale, direction[1] * scale, 0.0
    cloud = unit(octaves(place, 1.1, 5, 0.55, 0.02, seed + 301) * 0.9)
    clear = 0.24 + 0.50 * mist, 0.42 + 0.42 * mist, 0.80 + 0.16 * mist
    return blend(clear, cloud, (0.95, 0.96, 0.98))


@inlined
def shade(layout, origin, direction, pixel, seed):
    """The linear colour that a camera ray sees; ``pixel`` is the angle of one subsample, in rad."""
    t, i = cast(layout, origin, direction, False)
    if i == SKY:
        return sky(direction, seed)
    point = ahead(origin, t, direction)
    if i == GROUND:
        normal = 0.0, 0.0, 1.0
        color = ground(point, t * pixel / max(sqrt(-direction[2]), 0.15), seed)
    else:
        rotation, tint = layout.rotation[i], layout.tint[i]
        local = to_local(rotation, minus(point, layout.center[i]))
        facing, face = local_normal(layout.kind[i], layout.size[i], local)
        normal = dot(rotation[0], facing), dot(rotation[1], facing), dot(rotation[2], facing)
        footprint = t * pixel / max(sqrt(abs(dot(normal, direction))), 0.15)
        light, warmth = shade_factors(
            layout.material[i], local, face, footprint, seed + 1009 * (i + 1)
        )
        red, blue = 1.0 + 0.30 * warmth, 1.0 - 0.30 * warmth
        color = tint[0] * light * red, tint[1] * light, tint[2] * light * blue
    # Ambient occlusion: if there is less free space along the normal than the step, a surface is
    # near.
    occlusion = 1.0
    for step in OCCLUSION_STEPS:
        free = nearest_surface(layout, ahead(point, step, normal), step)
        occlusion -= 0.38 * (1.0 - free / step)
    sun = dot(normal, SUN)
    if sun > 0.0:
        # The ray starts a little above the surface, which would otherwise shade itself.
        _, blocker = cast(layout, ahead(point, _EPSILON, normal), SUN, True)
        sun = sun if blocker == SKY else 0.0
    sun = max(sun, 0.0)
    up = 0.5 + 0.5 * normal[2]
    ambient = ahead(scaled(up, SKY_LIGHT), 1 - up, BOUNCE_LIGHT)
    red, green, blue = ahead(scaled(occlusion, ambient), sun, SUN_LIGHT)
    return color[0] * red, color[1] * green, color[2] * blue


@inlined
def encode(value):
    """Linear light to an 8-bit sRGB value, with a soft shoulder instead of clipping."""
    value = EXPOSURE * value
    if value > 0.6:
        value = 0.6 + 0.4 * (1.0 - exp(-(value - 0.6) / 0.4))
    # IEC 61966-2-1
    srgb = 12.92 * value if value <= 0.0031308 else 1.055 * value ** (1 / 2.4) - 0.055
    return floor(255.0 * unit(srgb) + 0.5)


@kernel
def render(layout, camera_rotation, origin, intrinsics, image, seed):
    """Render one view into ``image`` [H, W, 3] uint8; ``intrinsics`` is (fx, fy, cx, cy) in px."""
    fx, fy, cx, cy = intrinsics
    share = 1.0 / (SUBSAMPLES * SUBSAMPLES)
    pixel = 1.0 / (fx * SUBSAMPLES)
    for row in range(image.shape[0]):
        for column in range(image.shape[1]):
            total = 0.0, 0.0, 0.0
            for sub in range(SUBSAMPLES * SUBSAMPLES):
                across = (column + (sub % SUBSAMPLES + 0.5) / SUBSAMPLES - cx) / fx
                down = (row + (sub // SUBSAMPLES + 0.5) / SUBSAMPLES - cy) / fy
                scale = 1.0 / sqrt(across * across + down * down + 1.0)
                direction = to_local(camera_rotation, (across * scale, down * scale, scale))
                red, green, blue = shade(layout, origin, direction, pixel, seed)
                seen = min(red, 1.5), min(green, 1.5), min(blue, 1.5)
                total = ahead(total, share, seen)
            for channel in range(3):
                image[row, column, channel] = encode(total[channel])
