"""A check that two machines share, trained for real: each runs a scene, and one runs folder is copied into the
other."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
import yaml

from gsbench.cli import run
from gsbench.scene.courtyard.render import render_courtyard
from tests.claims.test_check import content
from tests.launch.test_declare import TINY

pytestmark = pytest.mark.slow

SCENES = ("near", "far")


def trained(runs: Path) -> set[tuple[str, int]]:
    """The scene and seed of each trial that is done."""
    found = [json.loads(file.read_text()) for file in runs.glob("check_it/*/*/*/results.json")]
    return {(one["scene"], one["seed"]) for one in found}


def test_copying_one_runs_folder_into_the_other_is_enough(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    data = tmp_path / "data"  # at one place on both machines
    render_courtyard(data / "near", views=6, width=64, height=48)
    shutil.copytree(data / "near", data / "far")
    monkeypatch.setenv("GSBENCH_DATA", str(data))
    settings = {key: yaml.safe_load(value) for key, value in (word.split("=", 1) for word in TINY)}
    settings = {key: value for key, value in settings.items() if not key.startswith("scene")} | {"tracking": "none"}
    scenes = {
        name: {"scene": "colmap", "scene.name": name, "scene.path": f"${{oc.env:GSBENCH_DATA,data}}/{name}"}
        for name in SCENES
    }
    arms = {"few": {"init.count": 200}, "many": {"init.count": 300}}
    claim = content()["claims"][0] | {"baseline": "few", "arm": "many"}
    claims = tmp_path / "claims.yaml"
    plan = {"settings": settings, "scenes": scenes, "arms": arms, "claims": [claim], "seeds": 2}
    claims.write_text(json.dumps(content() | plan))
    for machine, scene in zip(("first", "second"), SCENES, strict=True):
        monkeypatch.setenv("GSBENCH_RUNS", str(tmp_path / machine))
        assert run(["check", str(claims), "--scene", scene, "--all-seeds"]) == 0
        assert "the next look waits" in capsys.readouterr().out
        assert trained(tmp_path / machine) == {(scene, 0), (scene, 1)}
    shutil.copytree(tmp_path / "first" / "check_it", tmp_path / "second" / "check_it", dirs_exist_ok=True)
    capsys.readouterr()
    assert run(["check", str(claims), "--dry-run"]) == 0
    assert run(["check", str(claims)]) == 0
    said = capsys.readouterr().out
    assert "the next look waits" not in said
    page = (tmp_path / "second" / "check_it" / "claims.md").read_text()
    assert "2 scenes, 2 seeds" in page
    assert "had been measured before" not in page
    for machine in ("first", "second"):
        monkeypatch.setenv("GSBENCH_RUNS", str(tmp_path / machine))
        assert run(["export", "--results", "check_it", "--out", str(tmp_path / f"{machine}.zip")]) == 0
    monkeypatch.chdir(tmp_path)
    assert run(["check", str(claims), "--from", "second.zip", "--out", "again.md"]) == 0
    lines = [[one for one in text.splitlines() if "lpips" in one] for text in (page, Path("again.md").read_text())]
    assert lines[0] == lines[1]
    assert run(["check", str(claims), "--from", "first.zip", "second.zip"]) == 0
