"""``gsbench export TRIAL --out page.html``: its cameras, and the command where npx fails."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest

from gsbench.cli import run
from gsbench.view.page import page_settings
from gsbench.view.trials import find_trial, model_folder, read_test_views

pytestmark = pytest.mark.slow
ADDRESS = "small:courtyard:adc"
NPX = """#!/bin/sh
for word in "$@"; do [ "$previous" = -E ] && settings="$word"; previous="$word"; done
case "$*" in *"{works}"*) cp "$settings" "$previous";; *) echo "no device" >&2; exit 1;; esac
"""


def stand_in(folder: Path, works: str) -> Path:
    """Write an npx that copies its settings to the page if its words contain ``works``."""
    folder.mkdir()
    (folder / "npx").write_text(NPX.replace("{works}", works))
    (folder / "npx").chmod(0o755)
    return folder


@pytest.mark.parametrize("works", ["splat-transform", "-g cpu"], ids=["with a GPU", "without"])
def test_the_page_has_every_test_view(
    works: str, small_runs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("GSBENCH_RUNS", str(small_runs))
    npx = stand_in(tmp_path / "bin", works)
    monkeypatch.setenv("PATH", f"{npx}{os.pathsep}{os.environ['PATH']}")
    assert run(["export", ADDRESS, "--out", str(tmp_path / "page.html")]) == 0
    settings = json.loads((tmp_path / "page.html").read_text())
    trial = find_trial(ADDRESS, small_runs)
    assert settings == page_settings(trial)
    views = read_test_views(trial, model_folder(trial))
    assert [one["title"] for one in settings["annotations"]] == [view.name for view in views]
    for view, one in zip(views, settings["annotations"], strict=True):
        camera, shown = view.camera, one["camera"]["initial"]
        # The viewer turns the model by half a turn about z.
        target = camera.rotation @ (np.array(shown["target"]) * (-1, -1, 1)) + camera.translation
        assert target[:2] == pytest.approx([0, 0], abs=1e-9)
        assert target[2] > 0.2
        np.testing.assert_allclose(np.array(shown["position"]) * (-1, -1, 1), camera.center)
        assert np.tan(np.radians(shown["fov"] / 2)) * 2 * camera.fx == pytest.approx(camera.width)
    (track,) = settings["animTracks"]
    frames = track["keyframes"]
    shown = [one["camera"]["initial"] for one in settings["annotations"]]
    stops = [*shown, shown[0]]
    assert len(frames["times"]) == len(stops)
    for key, size in (("position", 3), ("target", 3), ("fov", 1)):
        wanted = np.ravel([stop[key] for stop in stops])
        assert frames["values"][key] == wanted.tolist()
        assert len(wanted) == size * len(stops)


@pytest.mark.parametrize(
    ("works", "cause"), [("never", r"failed (no device)"), ("", "is not installed")]
)
def test_without_npx_the_error_names_the_command_to_type(
    works: str,
    cause: str,
    small_runs: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setenv("GSBENCH_RUNS", str(small_runs))
    place = f"{stand_in(tmp_path / 'bin', works)}:/bin" if works else str(tmp_path)
    monkeypatch.setenv("PATH", place)
    assert run(["export", ADDRESS, "--out", str(tmp_path / "page.html")]) == 1
    said = capsys.readouterr().err
    assert cause in said
    assert "npx @playcanvas/splat-transform" in said
    assert said.count("\n") == 1
    assert (tmp_path / "page.ply").read_bytes()[:3] == b"ply"
    assert json.loads((tmp_path / "page.json").read_text())["version"] == 2
    assert not (tmp_path / "page.html").exists()
