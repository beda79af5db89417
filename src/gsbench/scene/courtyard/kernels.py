"""Ray casting for the courtyard, compiled with numba; all functions are scalar and pure."""

from math import exp, floor, inf, sqrt

import numpy as np

from gsbench.scene.courtyard.layout import BOX, SPHERE
from gsbench.scene.courtyard.textures import clamp, ground, octaves2, shade_factors
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
def to_local(rotation, x, y, z):
    """World to local direction: the transpose of ``rotation`` [3, 3] times (x, y, z)."""
    return (
        rotation[0, 0] * x + rotation[1, 0] * y + rotation[2, 0] * z,
        rotation[0, 1] * x + rotation[1, 1] * y + rotation[2, 1] * z,
        rotation[0, 2] * x + rotation[1, 2] * y + rotation[2, 2] * z,
    )


@inlined
def inverse(value):
    """1 / value, large but finite at 0, so that a ray along a face of a box gives no NaN."""
    return 1.0 / value if abs(value) > 1e-12 else 1e12


@inlined
def enter_box(lx, ly, lz, hx, hy, hz, ox, oy, oz, ix, iy, iz):
    """(entry, exit) of a ray with inverse direction i and the box from l to h.

    If the ray misses the box, entry > exit.
    """
    # Kay and Kajiya 1986: the ray is in the box where it is between all three pairs of planes.
    ax, bx = (lx - ox) * ix, (hx - ox) * ix
    ay, by = (ly - oy) * iy, (hy - oy) * iy
    az, bz = (lz - oz) * iz, (hz - oz) * iz
    return max(min(ax, bx), min(ay, by), min(az, bz)), min(max(ax, bx), max(ay, by), max(az, bz))


@inlined
def hit_tube(outer, half, inner, ox, oy, oz, dx, dy, dz):
    """The first distance > 0 of a ray to a capped cylinder, solid or bored; inf for a miss."""
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
def hit_primitive(kind, size, ox, oy, oz, dx, dy, dz):
    """The first distance > 0 along a local ray to the primitive, or inf if it misses."""
    if kind == BOX:
        entry, exit_ = enter_box(
            -size[0],
            -size[1],
            -size[2],
            size[0],
            size[1],
            size[2],
            ox,
            oy,
            oz,
            inverse(dx),
            inverse(dy),
            inverse(dz),
        )
        return entry if 0.0 < entry <= exit_ else inf
    if kind == SPHERE:
        # |o + t d| = r with |d| = 1: t^2 + 2 b t + c = 0
        b, c = ox * dx + oy * dy + oz * dz, ox * ox + oy * oy + oz * oz - size[0] * size[0]
        root = b * b - c
        if root <= 0.0:
            return inf
        t = -b - sqrt(root)
        return t if t > 0.0 else inf
    return hit_tube(size[0], size[1], size[2], ox, oy, oz, dx, dy, dz)


@inlined
def cast(layout, ox, oy, oz, dx, dy, dz, any_hit):
    """(distance, primitive) of the nearest hit; the primitive may be GROUND or SKY.

    With ``any_hit``, for shadow rays, the first primitive found ends the search, and the ground is
    ignored.
    """
    best, index = inf, SKY
    ix, iy, iz = inverse(dx), inverse(dy), inverse(dz)
    if dz < -1e-9 and not any_hit:
        best, index = -oz / dz, GROUND
    for g in range(len(layout.group_low)):
        low, high = layout.group_low[g], layout.group_high[g]
        entry, exit_ = enter_box(
            low[0], low[1], low[2], high[0], high[1], high[2], ox, oy, oz, ix, iy, iz
        )
        if entry > exit_ or exit_ < 0.0 or entry > best:
            continue
        for i in range(layout.group_start[g], layout.group_start[g + 1]):
            center, size = layout.center[i], layout.size[i]
            x, y, z = ox - center[0], oy - center[1], oz - center[2]
            along = x * dx + y * dy + z * dz
            if along * along < x * x + y * y + z * z - size[3] * size[3]:
                continue  # misses the bounding sphere
            lx, ly, lz = to_local(layout.rotation[i], x, y, z)
            ux, uy, uz = to_local(layout.rotation[i], dx, dy, dz)
            t = hit_primitive(layout.kind[i], size, lx, ly, lz, ux, uy, uz)
            if t < best:
                best, index = t, i
                if any_hit:
                    return best, index
    return best, index


@inlined
def signed_distance(kind, size, x, y, z):
    """Distance from a local point to the primitive's surface, negative inside."""
    if kind == SPHERE:
        return sqrt(x * x + y * y + z * z) - size[0]
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
def nearest_surface(layout, x, y, z, limit):
    """The smallest |distance| from a point to any surface or the ground, at most ``limit``."""
    best = min(abs(z), limit)
    for g in range(len(layout.group_low)):
        low, high = layout.group_low[g], layout.group_high[g]
        qx, qy, qz = (
            max(low[0] - x, 0.0, x - high[0]),
            max(low[1] - y, 0.0, y - high[1]),
            max(low[2] - z, 0.0, z - high[2]),
        )
        # no primitive in the group's box can be nearer than the box itself
        if qx * qx + qy * qy + qz * qz >= best * best:
            continue
        for i in range(layout.group_start[g], layout.group_start[g + 1]):
            center, size = layout.center[i], layout.size[i]
            rx, ry, rz = x - center[0], y - center[1], z - center[2]
            if rx * rx + ry * ry + rz * rz >= (best + size[3]) ** 2:
                continue
            lx, ly, lz = to_local(layout.rotation[i], rx, ry, rz)
            best = min(best, abs(signed_distance(layout.kind[i], size, lx, ly, lz)))
    return best


@inlined
def sign(value):
    return 1.0 if value > 0 else -1.0


@inlined
def longer_first(a, b, size_a, size_b):
    """The coordinates of a face, that of its longer side first: grain and planks run along it."""
    return (a, b) if size_a > size_b else (b, a)


@inlined
def local_normal(kind, size, x, y, z):
    """The outward normal (3 values) at a local surface point, and (u, v) in m along the face."""
    if kind == SPHERE:
        r = size[0]
        return x / r, y / r, z / r, (x + y) * 0.8, z + 0.4 * (x - y)
    if kind == BOX:
        qx, qy, qz = abs(x) - size[0], abs(y) - size[1], abs(z) - size[2]
        if qx >= qy and qx >= qz:
            u, v = longer_first(y, z, size[1], size[2])
            return sign(x), 0.0, 0.0, u, v
        if qy >= qz:
            u, v = longer_first(x, z, size[0], size[2])
            return 0.0, sign(y), 0.0, u, v
        u, v = longer_first(x, y, size[0], size[1])
        return 0.0, 0.0, sign(z), u, v
    radius = sqrt(x * x + y * y)
    if abs(abs(z) - size[1]) < min(abs(radius - size[0]), abs(radius - size[2])):
        return 0.0, 0.0, sign(z), x, y
    side = 1.0 if abs(radius - size[0]) <= abs(radius - size[2]) else -1.0
    return side * x / radius, side * y / radius, 0.0, np.arctan2(y, x) * size[0], z


@inlined
def sky(dx, dy, dz, seed):
    """The colour of the sky in a direction: a gradient with faint clouds."""
    up = clamp(dz, 0.0, 1.0)
    mist = exp(-5.0 * up)
    scale = 1.0 / (up + 0.18)
    cloud = clamp(octaves2(dx * scale, dy * scale, 1.1, 5, 0.55, 0.02, seed + 301) * 0.9, 0.0, 1.0)
    red, green, blue = 0.24 + 0.50 * mist, 0.42 + 0.42 * mist, 0.80 + 0.16 * mist
    return red + cloud * (0.95 - red), green + cloud * (0.96 - green), blue + cloud * (0.98 - blue)


@inlined
def received(channel, sun, occlusion, up):
    """The light on a surface: sunlight, and ambient light from above (share ``up``) and below."""
    ambient = up * SKY_LIGHT[channel] + (1 - up) * BOUNCE_LIGHT[channel]
    return sun * SUN_LIGHT[channel] + occlusion * ambient


@inlined
def shade(layout, ox, oy, oz, dx, dy, dz, pixel, seed):
    """The linear colour that a camera ray sees; ``pixel`` is the angle of one subsample, in rad."""
    t, i = cast(layout, ox, oy, oz, dx, dy, dz, False)
    if i == SKY:
        return sky(dx, dy, dz, seed)
    x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
    if i == GROUND:
        nx, ny, nz = 0.0, 0.0, 1.0
        footprint = t * pixel / max(sqrt(-dz), 0.15)
        red, green, blue = ground(x, y, footprint, seed)
    else:
        center, rotation, tint = layout.center[i], layout.rotation[i], layout.tint[i]
        px, py, pz = to_local(rotation, x - center[0], y - center[1], z - center[2])
        lx, ly, lz, u, v = local_normal(layout.kind[i], layout.size[i], px, py, pz)
        nx = rotation[0, 0] * lx + rotation[0, 1] * ly + rotation[0, 2] * lz
        ny = rotation[1, 0] * lx + rotation[1, 1] * ly + rotation[1, 2] * lz
        nz = rotation[2, 0] * lx + rotation[2, 1] * ly + rotation[2, 2] * lz
        facing = abs(nx * dx + ny * dy + nz * dz)
        footprint = t * pixel / max(sqrt(facing), 0.15)
        light, warmth = shade_factors(
            layout.material[i], px, py, pz, u, v, footprint, seed + 1009 * (i + 1)
        )
        red = tint[0] * light * (1.0 + 0.30 * warmth)
        green = tint[1] * light
        blue = tint[2] * light * (1.0 - 0.30 * warmth)
    # Ambient occlusion: if there is less free space along the normal than the step, a surface is
    # near.
    occlusion = 1.0
    for step in OCCLUSION_STEPS:
        free = nearest_surface(layout, x + step * nx, y + step * ny, z + step * nz, step)
        occlusion -= 0.38 * (1.0 - free / step)
    sun = nx * SUN[0] + ny * SUN[1] + nz * SUN[2]
    if sun > 0.0:
        # The ray starts a little above the surface, which would otherwise shade itself.
        sx, sy, sz = x + _EPSILON * nx, y + _EPSILON * ny, z + _EPSILON * nz
        _, blocker = cast(layout, sx, sy, sz, SUN[0], SUN[1], SUN[2], True)
        sun = sun if blocker == SKY else 0.0
    sun = max(sun, 0.0)
    up = 0.5 + 0.5 * nz
    return (
        red * received(0, sun, occlusion, up),
        green * received(1, sun, occlusion, up),
        blue * received(2, sun, occlusion, up),
    )


@inlined
def encode(value):
    """Linear light to an 8-bit sRGB value, with a soft shoulder instead of clipping."""
    value = EXPOSURE * value
    if value > 0.6:
        value = 0.6 + 0.4 * (1.0 - exp(-(value - 0.6) / 0.4))
    # IEC 61966-2-1
    srgb = 12.92 * value if value <= 0.0031308 else 1.055 * value ** (1 / 2.4) - 0.055
    return floor(255.0 * clamp(srgb, 0.0, 1.0) + 0.5)


@kernel
def render(layout, camera_rotation, origin, intrinsics, image, seed):
    """Render one view into ``image`` [H, W, 3] uint8; ``intrinsics`` is (fx, fy, cx, cy) in px."""
    fx, fy, cx, cy = intrinsics
    ox, oy, oz = origin
    share = 1.0 / (SUBSAMPLES * SUBSAMPLES)
    pixel = 1.0 / (fx * SUBSAMPLES)
    for row in range(image.shape[0]):
        for column in range(image.shape[1]):
            red, green, blue = 0.0, 0.0, 0.0
            for sub in range(SUBSAMPLES * SUBSAMPLES):
                across = (column + (sub % SUBSAMPLES + 0.5) / SUBSAMPLES - cx) / fx
                down = (row + (sub // SUBSAMPLES + 0.5) / SUBSAMPLES - cy) / fy
                scale = 1.0 / sqrt(across * across + down * down + 1.0)
                dx, dy, dz = to_local(camera_rotation, across * scale, down * scale, scale)
                r, g, b = shade(layout, ox, oy, oz, dx, dy, dz, pixel, seed)
                red += share * min(r, 1.5)
                green += share * min(g, 1.5)
                blue += share * min(b, 1.5)
            image[row, column, 0] = encode(red)
            image[row, column, 1] = encode(green)
            image[row, column, 2] = encode(blue)
