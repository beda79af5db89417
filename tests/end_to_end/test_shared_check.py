"""A check that two machines share, trained for real: each has a copy of the photographs, at a place of its own."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
import yaml
from PIL import Image

from gsbench.cli import run
from gsbench.scene.courtyard.render import render_courtyard
from tests.claims.test_sweep import content
from tests.launch.test_declare import TINY

pytestmark = pytest.mark.slow

SEEDS, SCENES = 3, ("near", "far")


def trained(runs: Path) -> set[tuple[str, int]]:
    """The scene and seed of each trial that is done."""
    found = [json.loads(file.read_text()) for file in runs.glob("check_it/*/*/*/results.json")]
    return {(one["scene"], one["seed"]) for one in found}


def test_two_machines_with_photographs_at_places_of_their_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    render_courtyard(tmp_path / "first" / "near", views=6, width=64, height=48)
    for folder in (Path("first", "far"), Path("second", "near"), Path("second", "far")):
        shutil.copytree(tmp_path / "first" / "near", tmp_path / folder)
    settings = {key: yaml.safe_load(value) for key, value in (word.split("=", 1) for word in TINY)}
    settings = {key: value for key, value in settings.items() if not key.startswith("scene")} | {"tracking": "none"}
    scenes = {
        name: {"scene": "colmap", "scene.name": name, "scene.path": f"${{oc.env:GSBENCH_DATA,data}}/{name}"}
        for name in SCENES
    }
    arms = {"few": {"init.count": 200}, "many": {"init.count": 300}}
    claim = content()["claims"][0] | {"baseline": "few", "arm": "many"}
    plan = {"settings": settings, "scenes": scenes, "arms": arms, "claims": [claim], "seeds": SEEDS}
    claims, share = tmp_path / "claims.yaml", tmp_path / "share.zip"
    claims.write_text(json.dumps(content() | plan))

    def on(machine: str) -> Path:
        monkeypatch.setenv("GSBENCH_DATA", str(tmp_path / machine))
        monkeypatch.setenv("GSBENCH_RUNS", str(tmp_path / f"{machine}_runs"))
        return tmp_path / f"{machine}_runs"

    first = on("first")
    assert run(["check", str(claims), "--scene", "near"]) == 0
    assert "waits for far" in capsys.readouterr().out
    assert trained(first) == {("near", 0), ("near", 1)}
    assert run(["check", str(claims), "--scene", "near", "--all-seeds"]) == 0
    assert "waits for far" in capsys.readouterr().out
    assert trained(first) == {("near", seed) for seed in range(SEEDS)}
    assert run(["export", "--results", "check_it", "--out", str(share)]) == 0

    second = on("second")
    assert run(["check", str(claims), "--with", str(share)]) == 0
    assert trained(second) == {("far", 0), ("far", 1)}  # .1 dB apart: refuted at the first look, where .3 dB matter
    said = (second / "check_it" / "claims.md").read_text()
    assert "Trials from share.zip count beside those that were run here" in said
    assert "2 scenes, 2 seeds" in said
    assert "had been measured before this plan" not in said
    assert run(["export", "--results", "check_it", "--with", str(share), "--out", str(tmp_path / "all.zip")]) == 0
    page = tmp_path / "again.md"
    assert run(["check", str(claims), "--from", str(tmp_path / "all.zip"), "--out", str(page)]) == 0
    again = page.read_text()
    assert [line for line in again.splitlines() if "lpips: " in line] == [
        line for line in said.splitlines() if "lpips: " in line
    ]

    shutil.rmtree(second)
    photograph = next((tmp_path / "second" / "near" / "images").iterdir())
    Image.new("RGB", (64, 48)).save(photograph)
    half = tmp_path / "half"  # of the first machine's share one seed: the other would be run here
    shutil.copytree(first, half)
    for trial in (half / "check_it" / "near").glob("*/*-seed1"):
        shutil.rmtree(trial)
    monkeypatch.setenv("GSBENCH_RUNS", str(half))
    assert run(["export", "--results", "check_it", "--out", str(tmp_path / "half.zip")]) == 0
    on("second")
    assert run(["check", str(claims), "--with", str(tmp_path / "half.zip")]) == 2
    assert "near: photographs or their model are not those of" in capsys.readouterr().err
    assert run(["check", str(claims), "--with", str(tmp_path / "half.zip"), "--scene", "far", "--dry-run"]) == 0
