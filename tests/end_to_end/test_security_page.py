"""docs/security.md, line by line: what each verb may run, and which edits of files are noticed."""

import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from gsbench.cli import run
from gsbench.errors import InputError
from gsbench.runs.store import read_manifest
from gsbench.runs.trial_folder import TrialFolder
from gsbench.verbs import VERBS
from gsbench.view.trials import find_trial, model_file
from tests.end_to_end.conftest import FINISHED

PAGE = Path(__file__).parents[2] / "docs/security.md"
pytestmark = pytest.mark.slow


def table(heading):
    """The rows of the table below a heading of the page, as lists of cells."""
    section = PAGE.read_text(encoding="utf-8").partition(f"## {heading}\n")[2].partition("\n## ")[0]
    rows = [line.strip("| ").split(" | ") for line in section.splitlines() if line.startswith("|")]
    return rows[2:]


RUNS = table("What each verb reads from others, and what it may run")
EDITS = table("Which edits are noticed")


def test_the_page_names_every_verb():
    named = re.findall(r"`(\w+)(?: --from)?`", " ".join(row[0] for row in RUNS))
    assert sorted(set(named)) == sorted(VERBS)


@pytest.fixture
def place(runs, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("GSBENCH_RUNS", str(runs))
    return runs


def test_verbs_that_run_nothing_start_no_program(place, monkeypatch):
    assert run(["export", "--results", FINISHED, "--out", "a.zip"]) == 0

    def start(*words, **how):
        raise AssertionError(f"a program was started: {words}")

    monkeypatch.setattr(subprocess, "Popen", start)
    scene = f"{FINISHED}:courtyard"
    commands = {
        "tables": [FINISHED],
        "report": [FINISHED],
        "explain": [f"{scene}:psnr:adc"],
        "status": [FINISHED],
        "plan": [FINISHED],
        "pool": ["a.zip", "--arm", "volumetric"],
        "site": ["a.zip", "--out", "site"],
        "vote": ["make", FINISHED, "--arms", "adc,volumetric", "--out", "vote"],
    }
    (nothing,) = [row[0] for row in RUNS if row[0].startswith("`tables`")]
    assert re.findall(r"`(\w+)`", nothing) == [verb for verb in commands if verb != "status"]
    for verb, words in commands.items():
        assert run([verb, *words]) in (0, 2), verb


# ---- edits


@pytest.fixture
def trial(place):
    return min(path.parent for path in place.glob(f"{FINISHED}/*/*-adc/*/results.json"))


@pytest.fixture
def shown(place, capsys, caplog):
    """What the verbs that read results say of the experiment, by verb."""

    def look():
        texts = {}
        for verb, words in {
            "tables": ["tables", FINISHED],
            "report": ["report", FINISHED, "--out", "r.html"],
            "status": ["status", FINISHED],
            "export": ["export", "--results", FINISHED, "--out", "x.zip"],
        }.items():
            capsys.readouterr()
            caplog.clear()
            run(words)
            texts[verb] = "".join(capsys.readouterr()) + caplog.text
        return texts

    return look


def edit(file):
    """Change the last byte of a file but its line break."""
    content = file.read_bytes()
    place = len(content.rstrip()) - 1
    file.write_bytes(content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :])


def edited_number(file, without_hashes=False):
    values = json.loads(file.read_text())
    values["metrics"]["psnr"] += 1
    if without_hashes:
        del values["made_of"]
    file.write_text(json.dumps(values))


def results(trial, shown):
    edited_number(trial / "results.json")
    texts = shown()
    assert all("results.json was changed after it was written" in text for text in texts.values())
    edited_number(trial / "results.json", without_hashes=True)
    assert not any("was changed" in text for text in shown().values())


def files_of_a_trial(trial, shown):
    for name in ("config.yaml", "per_view.csv", "point_cloud.ply"):
        kept = shutil.copy2(trial / name, trial.parents[4] / "kept")
        edit(trial / name)
        for verb, text in shown().items():
            assert f"{name} was changed after results.json was written" in text, verb
        with pytest.raises(InputError):
            model_file(find_trial(str(trial), trial.parents[3]))
        shutil.copy2(kept, trial / name)


def curves(trial, shown):
    for name in ("metrics.jsonl", "events.jsonl"):
        with (trial / name).open("a") as file:
            file.write('{"step": 300, "loss": 0.1}\n')
    texts = shown()
    for name in ("metrics.jsonl", "events.jsonl"):
        assert f"{name} was changed after it was written" in texts["report"]
    assert "volumetric" in texts["tables"]


def pictures(trial, shown):
    edit(next((trial / "renders").iterdir()))
    assert not any("was changed" in text for text in shown().values())
    files = TrialFolder(trial)
    assert files.why_not_done(files.settings()) is not None


def store(trial, shown):
    """What is read before a use of the entry refuses it; for views, tests/scene/test_load.py."""
    entry = min(
        path.parent for path in (trial.parents[3] / "store").glob("ground_truth/*/manifest.json")
    )
    edit(next(entry.glob("*.png")))
    assert not any("was changed" in text for text in shown().values())
    with pytest.raises(ValueError, match="differs from what was written"):
        read_manifest(entry, thorough=True)
    assert run(["export", "init", str(trial), "--out", "whole"]) == 0
    for cameras in (trial.parents[3] / "store").glob("init/*/sparse/0/cameras.*"):
        edit(cameras)
    assert run(["export", "init", str(trial), "--out", "edited"]) == 2
    assert run(["export", str(trial), "--out", "page.html"]) == 2
    assert not list(Path().glob("edited*"))


def plans(trial, shown):
    before = shown()
    home = trial.parents[2]
    plan = json.loads((home / "plan.json").read_text())
    for planned in plan["trials"].values():
        planned["time"] = 1
    (home / "plan.json").write_text(json.dumps(plan))
    assert shown() == before


# rows whose tests are where their files are made
ELSEWHERE = {
    "`ledger.jsonl`": "tests/runs/test_ledger.py::test_a_line_that_was_changed_is_found",
    "`votes/ROUND/key.json`": "tests/claims/test_votes.py::test_a_changed_key_is_refused",
    "`votes/ROUND/PERSON.json`": "tests/claims/test_votes.py::"
    "test_a_change_of_stored_votes_costs_that_file_and_is_shown",
}
HERE = {
    "`results.json`": results,
    "`config.yaml`, `per_view.csv`, `point_cloud.ply` of a trial": files_of_a_trial,
    "`metrics.jsonl`, `events.jsonl`, `volume_histograms.jsonl`": curves,
    "pictures of a trial": pictures,
    "`store/`: results of stages and prepared views": store,
    "`declared.jsonl`, `plan.json`, `tuning.json`": plans,
}


def test_every_row_has_a_test():
    assert [row[0] for row in EDITS] == [*HERE, *ELSEWHERE]
    for place in ELSEWHERE.values():
        file, _, name = place.partition("::")
        assert f"def {name}(" in (PAGE.parents[1] / file).read_text()


@pytest.mark.parametrize("row", HERE)
def test_an_edit_is_noticed_as_the_page_says(row, trial, shown):
    HERE[row](trial, shown)
