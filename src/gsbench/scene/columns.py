"""Columns of ``per_view.csv`` that are no metrics. Loads nothing."""

from __future__ import annotations

ANGLE, DISTANCE = "angle_to_nearest", "distance_to_nearest"
COUNTED = "counted"  # the share of a view's pixels that its mask does not ignore; where there are masks
