"""Ray casting compared with samples and with a search over all primitives.

The functions run as plain Python here, not compiled.
"""

from math import inf
from types import FunctionType, SimpleNamespace

import numpy as np
import pytest

from gsbench.scene.courtyard import kernels, textures
from gsbench.scene.courtyard.layout import BOX, SPHERE, TUBE, build_layout


def uncompiled(*modules):
    """The functions of ``modules`` as plain Python, which call one another uncompiled."""
    names = {name: value for module in modules for name, value in vars(module).items()}
    for name, value in list(names.items()):
        if hasattr(value, "py_func"):
            names[name] = FunctionType(value.py_func.__code__, names)
    return SimpleNamespace(**names)


PLAIN = uncompiled(textures, kernels)
LAYOUT = build_layout(0)
SOLIDS = [LAYOUT.kind, LAYOUT.center, LAYOUT.rotation, LAYOUT.size]
SHAPES = {
    "box": (BOX, (0.5, 0.8, 0.3)),
    "long box": (BOX, (0.8, 0.3, 0.5)),
    "high box": (BOX, (0.3, 0.5, 0.8)),
    "sphere": (SPHERE, (0.7, 9.0, 9.0)),
    "tube": (TUBE, (0.6, 0.4, 0.0)),
    "tube with a bore": (TUBE, (0.8, 0.5, 0.5)),
}


def is_inside(kind, size, points):
    """Mask [P] of the ``points`` [P, 3] in the solid."""
    if kind == BOX:
        return (np.abs(points) < size).all(axis=-1)
    if kind == SPHERE:
        return np.linalg.norm(points, axis=-1) < size[0]
    radii = np.hypot(points[:, 0], points[:, 1])
    return (radii < size[0]) & (radii > size[2]) & (np.abs(points[:, 2]) < size[1])


def rays(seed, count, reach):
    """Origins and unit directions of rays towards the middle, some of them along an axis.

    Origins are about ``reach`` from the middle.
    """
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(count, 3))
    directions[: count // 4] = np.eye(3)[rng.integers(0, 3, count // 4)]
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return list(
        zip(rng.uniform(-0.7, 0.7, (count, 3)) - reach * directions, directions, strict=True)
    )


@pytest.mark.parametrize("name", SHAPES)
def test_a_ray_hits_a_solid_where_samples_along_it_enter_the_solid(name):
    kind, size = SHAPES[name]
    starts = [*rays(0, 120, 2.0), *(rays(1, 40, 0.0) if size[2] == 0.5 else [])]
    steps, hits = np.linspace(1e-4, 4.0, 8001), 0
    for origin, direction in starts:
        inside = is_inside(kind, size, origin + steps[:, None] * direction)
        if inside[0] or 0 < inside.sum() < 5:
            continue  # the ray starts inside the solid, or only grazes it
        found = PLAIN.hit_primitive(kind, size, origin, direction)
        if inside.any():
            hits += 1
            first = int(inside.argmax())
            assert steps[first - 1] <= found <= steps[first]
        else:
            assert found == inf
    assert 30 < hits < len(starts)


def test_the_first_hit_equals_that_of_a_search_over_all_primitives():
    """The boxes of groups exclude only what a ray misses."""
    found = set()
    for origin, direction in rays(4, 60, 4.0):
        origin = origin * [1, 1, 0.2] + [0, 0, 1.5]
        local = [
            PLAIN.hit_primitive(kind, size, (origin - center) @ turn, direction @ turn)
            for kind, center, turn, size in zip(*SOLIDS, strict=True)
        ]
        ground = -origin[2] / direction[2] if direction[2] < 0 else inf
        expected = min(ground, *local)
        index = PLAIN.GROUND if expected == ground else int(np.argmin(local))
        if expected == inf:
            index = PLAIN.SKY
        t, hit = PLAIN.cast(LAYOUT, origin, direction, False)
        assert (hit, t) == (index, pytest.approx(expected))
        _, anything = PLAIN.cast(LAYOUT, origin, direction, True)
        assert (anything == PLAIN.SKY) == (min(local) == inf)
        found.add(hit)
    assert {PLAIN.GROUND, PLAIN.SKY} < found
    assert len(found) > 10


def test_the_nearest_surface_equals_that_of_a_search_over_all_primitives():
    rng = np.random.default_rng(5)
    for point in np.concatenate(
        [rng.uniform([-7, -7, 0], [7, 7, 3], (40, 3)), LAYOUT.center[::6] + 0.1]
    ):
        distances = [
            abs(PLAIN.signed_distance(kind, size, (point - center) @ turn))
            for kind, center, turn, size in zip(*SOLIDS, strict=True)
        ]
        expected = min(abs(point[2]), *distances)
        for limit in (0.2, 5.0):
            found = PLAIN.nearest_surface(LAYOUT, point, limit)
            assert found == pytest.approx(min(expected, limit))
