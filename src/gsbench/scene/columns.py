"""Columns of ``per_view.csv`` that are no metrics. Loads nothing."""

from __future__ import annotations

ANGLE, DISTANCE = "angle_to_nearest", "distance_to_nearest"
