"""The stages of a trial, and a step: a stage with its inputs, which knows its key without running. Loads no torch."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from gsbench.runs.hashing import sha256_of


@dataclass(frozen=True)
class Stage:
    """A kind of work. Bump ``version`` by hand when its code changes what it computes.

    ``resumable`` stages find what a killed build left and go on from it; the others start in an empty folder. Files
    that match ``scratch`` serve the build only: they are removed when the result is complete.
    """

    name: str
    version: int
    resumable: bool = False
    scratch: tuple[str, ...] = ()

    def key(self, inputs: dict[str, Any]) -> str:
        """sha256 of canonical JSON of the stage and all that it reads, upstream keys included."""
        return sha256_of({"stage": self.name, "version": self.version, "inputs": inputs})


@dataclass(frozen=True)
class Step:
    """One piece of a trial: ``build(folder)`` computes its result, which ``inputs`` determine (upstream keys among
    them).

    ``code`` are the rooms of gsbench that have a part in it, with their states (`gsbench.runs.code`). ``check``, called
    when it is built, raises where other code may have built it than ``inputs`` say.
    """

    stage: Stage
    inputs: dict[str, Any]
    build: Callable[[Path], None] = field(repr=False)
    code: Mapping[str, str] = field(default_factory=dict, repr=False)
    check: Callable[[], None] = field(default=lambda: None, repr=False)

    @cached_property
    def key(self) -> str:
        """The key under which the step's result is stored."""
        return self.stage.key(self.inputs)


# By name and version: bump a version when the code of a stage computes something else.
CAPTURE = Stage("scene", 1)
INIT = Stage("init", 1, resumable=True)
TRAIN = Stage("train", 2, resumable=True, scratch=("checkpoint-*.pt",))
GROUND_TRUTH = Stage("ground_truth", 1)
EVALUATE = Stage("evaluate", 2)

STAGES = (CAPTURE, INIT, TRAIN, GROUND_TRUTH, EVALUATE)
