"""The stages of a trial, by name and version: bump a version here when its code computes something else. Loads no
torch."""

from __future__ import annotations

from gsbench.runs.step import Stage

CAPTURE = Stage("scene", 1)
INIT = Stage("init", 1, resumable=True)
TRAIN = Stage("train", 2, resumable=True, scratch=("checkpoint-*.pt",))
GROUND_TRUTH = Stage("ground_truth", 1)
EVALUATE = Stage("evaluate", 2)

STAGES = (CAPTURE, INIT, TRAIN, GROUND_TRUTH, EVALUATE)
