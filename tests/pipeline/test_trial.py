"""A trial's end, whatever its code does."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from gsbench.config.compose import compose_one
from gsbench.errors import InputError, TrainingError
from gsbench.pipeline.parts import Parts
from gsbench.pipeline.trial import _recorded_failures
from gsbench.runs.trial_folder import TrialFolder


@pytest.mark.parametrize("code", [0, None, 3, "text"])
def test_code_that_ends_the_process_is_a_failure(code: int | str | None, tmp_path: Path) -> None:
    folder = TrialFolder(tmp_path / "a" / "b" / "c" / "d" / "x")
    folder.path.mkdir(parents=True)
    with pytest.raises(TrainingError, match="ended the process"), _recorded_failures({"seed": 0}, folder):
        sys.exit(code)
    assert "ended the process" in json.loads((folder.path / "failed.json").read_text())["message"]


@pytest.mark.parametrize(
    ("words", "here", "refusal"),
    [
        (["raster=auto"], True, None),
        (["raster=cpu"], True, None),
        (["raster=gsplat"], False, None),  # where it will run there may be a GPU
        (["raster=gsplat"], True, "raster=gsplat runs on device=cuda"),
        (["raster=gsplat", "densify=taming"], False, "densify=taming .*; take raster=reference or raster=cpu"),
        (["raster=auto", "densify=taming"], False, None),
        (["raster=cpu", "densify=taming"], True, None),
    ],
)
def test_a_rasterizer_that_cannot_run_or_offer_what_is_asked_is_refused_before_any_work(
    words: list[str], here: bool, refusal: str | None
) -> None:
    parts = Parts(compose_one(["scene=courtyard", "device=cpu", *words]).values)
    if refusal is None:
        parts.check(here)
    else:
        with pytest.raises(InputError, match=refusal):
            parts.check(here)


def test_threads_are_those_that_are_set_or_what_parallel_trials_leave(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gsbench.pipeline.parts.available_threads", lambda parallel: 100 + parallel)
    for words, threads in ((["threads=3"], 3), (["threads=auto", "launch.parallel=2"], 102)):
        assert Parts(compose_one(["scene=courtyard", *words]).values).threads == threads
