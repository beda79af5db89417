"""Verdicts from a published archive are those of the machine that made it, wherever photographs lay there."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
import yaml

from gsbench.analysis.results import read_experiment
from gsbench.claims.archive import write_archive
from gsbench.claims.file import ClaimsFile, parse_claims
from gsbench.claims.recheck import recheck
from gsbench.claims.sweep import prepare, run_looks
from gsbench.claims.verdict import Verdict
from gsbench.cli import run
from gsbench.config.compose import TrialConfig
from gsbench.errors import InputError
from gsbench.launch.declare import declare_plan
from gsbench.runs.layout import CONFIG, DECLARED
from gsbench.runs.trial_folder import TrialFolder
from tests.claims.test_archive import members
from tests.claims.test_sweep import FakeRunner, content, ready

SCENES = {
    "courtyard": None,
    "own": {"scene": "photos", "scene.name": "own", "scene.path": "${oc.env:GSBENCH_DATA,data}/own"},
    "absent": {"scene": "photos", "scene.name": "absent", "scene.path": "${oc.env:GSBENCH_DATA,data}/absent"},
}
MISSING = "the folder /labs/one/own does not exist"


class Runner(FakeRunner):
    """Writes results of any scene, with the configuration that the trial was asked for."""

    def __call__(self, trials: Sequence[TrialConfig]) -> None:
        super().__call__(trials)
        for trial in trials:
            folder, scene = TrialFolder.of(trial.values).path, trial.values["scene"]["name"]
            made = folder.parents[2] / "courtyard" / folder.parent.name / folder.name
            if made != folder:
                folder.parent.mkdir(parents=True, exist_ok=True)
                shutil.move(made, folder)
                results = folder / "results.json"
                results.write_text(results.read_text().replace('"scene": "courtyard"', f'"scene": "{scene}"'))
            (folder / CONFIG).write_text(trial.yaml)


def claims(**changes: Any) -> ClaimsFile:
    return parse_claims(content(**changes) | {"scenes": SCENES})


def made(tmp_path: Path) -> tuple[list[Verdict], Path]:
    """Run a check of made-up trials where the third scene is absent; its verdicts, and their archive."""
    runs = tmp_path / "runs"
    check = prepare(claims(), runs, lambda trial, _: MISSING if trial.values["scene"]["name"] == "absent" else "")
    declared = declare_plan(check.home, check.plan, check.plan_hash, check.missing)
    verdicts = run_looks(check, declared, Runner(noise=0.2), ready)
    archive = tmp_path / "a.zip"
    assert write_archive(read_experiment(check.home), archive) == []
    return verdicts, archive


def test_the_same_verdicts_where_photographs_lie_elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GSBENCH_DATA", "/labs/one/data")
    (before,), archive = made(tmp_path)
    monkeypatch.setenv("GSBENCH_DATA", "elsewhere")
    found = recheck(claims(says="the same in other words"), [archive], tmp_path / "unpacked")
    (after,) = found.verdicts
    assert len(before.trials) >= 8
    assert before.decision is not None
    assert (after.word, after.decision, after.by_scene) == (before.word, before.decision, before.by_scene)
    assert [name for name, _ in after.by_scene] == ["courtyard", "own"]
    assert f"absent: {MISSING}" in before.notes
    assert "absent: the folder own does not exist" in after.notes
    assert b"/labs/one/own" not in members(archive)["declared.jsonl"]
    assert found.declared in found.plans


def test_an_archive_of_a_version_that_kept_no_reasons(tmp_path: Path) -> None:
    _, archive = made(tmp_path)
    home = tmp_path / "runs" / "check_it"
    line = json.loads((home / DECLARED).read_text())
    del line["missing"]
    (home / DECLARED).write_text(json.dumps(line) + "\n")
    write_archive(read_experiment(home), archive)
    (verdict,) = recheck(claims(), [archive], tmp_path / "unpacked").verdicts
    assert "absent: was not tested" in verdict.notes


def test_another_plan_than_the_declared_is_refused(tmp_path: Path) -> None:
    _, archive = made(tmp_path)
    with pytest.raises(InputError, match="give the file as it was then"):
        recheck(claims(least=0.1), [archive], tmp_path / "unpacked")


def test_an_archive_of_a_plain_experiment_is_refused(tmp_path: Path) -> None:
    made(tmp_path)
    home = tmp_path / "runs" / "check_it"
    (home / DECLARED).unlink()
    write_archive(read_experiment(home), tmp_path / "b.zip")
    with pytest.raises(InputError, match="no plan of claims was declared in it"):
        recheck(claims(), [tmp_path / "b.zip"], tmp_path / "unpacked")


def test_settings_that_a_later_version_adds_change_nothing(tmp_path: Path) -> None:
    """Archives outlive versions: a configuration without a younger setting means its value of before."""
    _, archive = made(tmp_path)
    home = tmp_path / "runs" / "check_it"
    for file in home.glob(f"*/*/*/{CONFIG}"):
        values = yaml.safe_load(file.read_text())
        del values["scene"]["split"], values["init"]["points_from"]
        file.write_text(yaml.safe_dump(values))
    write_archive(read_experiment(home), archive)
    (verdict,) = recheck(claims(), [archive], tmp_path / "unpacked").verdicts
    assert len(verdict.trials) >= 8


def test_the_verb_keeps_the_reasons_beside_the_plan(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GSBENCH_RUNS", str(tmp_path / "runs"))
    nowhere = {"scene": "photos", "scene.name": "absent", "scene.path": str(tmp_path / "nowhere")}
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(content() | {"scenes": {"absent": nowhere}}))
    assert run(["check", str(tmp_path / "mine.yaml")]) == 0
    line = json.loads((tmp_path / "runs" / "check_it" / DECLARED).read_text())
    assert list(line["missing"].values()) == [["absent: scene absent: the folder nowhere does not exist"]]
