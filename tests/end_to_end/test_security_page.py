"""docs/security.md, line by line: what each verb may run, and which edits of files are noticed."""

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from shlex import split

import pytest
import torch

from gsbench.cli import run
from gsbench.errors import InputError
from gsbench.runs.store import read_manifest
from gsbench.runs.trial_folder import TrialFolder
from gsbench.system.jit import cache_base
from gsbench.verbs import VERBS
from gsbench.view.trials import find_trial, model_file
from tests.end_to_end.conftest import FINISHED, SMALL
from tests.end_to_end.test_hydra import TINY
from tests.helpers import write
from tests.trials import search_record

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


# Imported by each Python below: it writes down which programs start, who is called, and which files
# are written.
WATCH = """
import os, sys
seen = os.open(os.environ["WATCHED"], os.O_WRONLY | os.O_APPEND | os.O_CREAT)
def watch(event, words):
    if event in ("subprocess.Popen", "os.posix_spawn", "os.exec", "os.system"):
        line = "run " + os.path.basename(os.fsdecode(words[0] or words[1][0]))
    elif event == "socket.connect" and not str(words[1][0]).startswith(("127.", "/")):
        line = f"call {words[1]}"
    elif event == "open" and isinstance(words[0], str | bytes) and (words[2] or 0) & os.O_ACCMODE:
        line = "write " + os.path.abspath(os.fsdecode(words[0]))
    else:
        return
    os.write(seen, (line + "\\n").encode())
sys.addaudithook(watch)
"""
SECRET = "do-not-tell-it"
ON_GPU = {"nvidia-smi"} | ({"cc", "gcc", "clang"} if torch.cuda.is_available() else set())
COMMIT = {"git", *ON_GPU}  # of gsbench's checkout
CLIENT = {"uname", *COMMIT}  # MLflow's asks for the machine
TRIAL = f"{FINISHED}:courtyard:adc:0"
GATE = [*split("gate a.zip --metric psnr --least 5"), *SMALL, "densify=adc", "tracking=none"]
RENDERS = "runs/finished/courtyard/random-adc/*/"
# By the row's first cell: its commands, the programs that they start, and where its permissions
# are tested.
VERB_ROWS = {
    "trials, `ablate`, `declare`": (
        [["-m", *TINY, "name=tiny", "seed=0,1"]],
        COMMIT,
        "config/test_trust.py::test_code_that_a_file_names_is_not_run",
    ),
    "`ledger`, `retry`": (
        [["retry", FINISHED]],
        COMMIT,
        "config/test_permissions.py::test_no_file_of_a_stranger_decides_what_runs_and_where_results_go",
    ),
    "`gate`": ([GATE], COMMIT, ""),
    "`tables`, `report`, `explain`, `plan`, `judge`, `site`": (
        [
            ["tables", FINISHED],
            ["report", FINISHED],
            ["explain", f"{FINISHED}:courtyard:psnr:adc"],
            ["plan", FINISHED],
            ["site", "a.zip", "--out", "site"],
        ],
        set(),
        "",
    ),
    "`status`": (
        [["status", FINISHED]],
        set(),
        "launch/test_states.py::test_the_queue_is_asked_for_the_users_and_is_unknown_if_slurm_fails",
    ),
    "`evaluate`": (
        [["evaluate", f"{RENDERS}renders", "--truth", f"{RENDERS}ground_truth", "eval.lpips=[]"]],
        ON_GPU,
        "",
    ),
    "`export`, `clean`": (
        [["export", TRIAL, "--out", "m.ply"], ["clean", "--dry-run"]],
        set(),
        "",
    ),
    "`view`": ([["view", TRIAL, "--port", "0"]], ON_GPU, ""),
    "`sync`, `ui`": (
        [["sync", FINISHED]],
        CLIENT,
        "tracking/test_address.py::test_sync_sends_nothing_to_a_tracker_that_was_not_typed",
    ),
    "`fetch`": (
        [["fetch", "--list"]],
        set(),
        "datasets/test_fetch.py::test_names_that_lead_out_of_the_folder_are_refused",
    ),
    "`bench`, `doctor`": (
        [["bench", "--raster", "reference", "--size", "32x24", "--count", "9"], ["doctor"]],
        COMMIT,
        "",
    ),
}


RUN = """
import json, sys
from gsbench.cli import run
for words in json.loads(sys.argv[1]):
    assert run(words) in (0, 1, 2), words
"""


def seen_of(commands, place, environment):
    """What commands are seen to do, as lines of `WATCH`; a server is ended once it says where."""
    with subprocess.Popen(
        [sys.executable, "-P", "-c", RUN, json.dumps(commands)],
        cwd=place.parent,
        env=environment | {"WATCHED": str(place.parent / "watched")},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    ) as program:
        said = ""
        for line in program.stdout:
            said += line
            if line.startswith("http://"):
                program.terminate()
    assert program.returncode in (0, 143), said
    assert "Traceback" not in said
    assert SECRET not in said
    return set((place.parent / "watched").read_text().splitlines())


@pytest.mark.parametrize("row", VERB_ROWS)
def test_a_verb_runs_and_writes_what_the_page_says(row, place, environment, tmp_path):
    commands, programs, elsewhere = VERB_ROWS[row]
    if elsewhere:
        file, _, name = elsewhere.partition("::")
        assert f"def {name}(" in (PAGE.parents[1] / "tests" / file).read_text()
    hook = write(tmp_path / "hook" / "sitecustomize.py", WATCH).parent
    own = environment | {
        "GSBENCH_RUNS": str(place),
        "PYTHONPATH": os.pathsep.join([str(hook), str(PAGE.parents[1] / "src")]),
        "TMPDIR": str(tmp_path / "scratch"),
        "AWS_SECRET_ACCESS_KEY": SECRET,
        "PYTHONDONTWRITEBYTECODE": "1",
    }
    (tmp_path / "scratch").mkdir()
    assert run(["export", "--results", FINISHED, "--out", "a.zip"]) == 0
    seen = seen_of(
        [
            [str(next(tmp_path.glob(word))) if "*" in word else word for word in words]
            for words in commands
        ],
        place,
        own,
    )
    started = {line.removeprefix("run ") for line in seen if line.startswith("run ")}
    # gsbench's own child processes are not named in the page
    assert started <= programs | {Path(sys.executable).name}
    assert not [line for line in seen if line.startswith("call ")]
    strange = [line for line in seen if line.startswith("write ")]
    allowed = (str(tmp_path), "/dev/", "/proc/self/", str(cache_base()))
    assert not [line for line in strange if not line[6:].startswith(allowed)]
    for file in tmp_path.rglob("*"):
        if file.is_file() and file.stat().st_size < 1 << 22:
            assert SECRET.encode() not in file.read_bytes(), file


def test_every_row_of_verbs_has_a_test():
    assert [row[0] for row in RUNS] == [*VERB_ROWS]


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
    for name in ("config.yaml", "per_view.csv", "point_cloud.ply", "lineage.npz"):
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
    assert not list(Path().glob("edited*"))


def commands(trial, shown):
    """Each trial that ends adds a line, so there are at least two."""
    file = trial.parents[2] / "commands.jsonl"
    assert "commands.jsonl" not in "".join(shown().values())
    first, *others = file.read_text().splitlines()
    file.write_text("\n".join([first.replace("cwd", "CWD"), *others, ""]))
    texts = shown()
    assert all("commands.jsonl" in texts[verb] for verb in ("tables", "report")), texts


def search(trial, shown):
    home = trial.parents[2]
    point = {"settings": {"densify.volume_threshold": 0.03}, "value": 20.0}
    sweep = {"sweep": home.name, "ranges": {"densify.volume_threshold": "0.01,0.03"}}
    file = write(home / "tuning.json", search_record([point]) | sweep)
    before = shown()
    file.write_text(file.read_text().replace("20.0", "21.0"))
    assert shown().keys() == before.keys()
    assert not any("tuning.json" in text for text in shown().values())


HERE = {
    "`results.json`": results,
    "`config.yaml`, `per_view.csv`, `point_cloud.ply`, `lineage.npz` of a trial": files_of_a_trial,
    "`metrics.jsonl`, `events.jsonl`": curves,
    "pictures of a trial": pictures,
    "`store/`: results of stages and prepared views": store,
    "`commands.jsonl`": commands,
    "`tuning.json`": search,
}


def test_every_row_has_a_test():
    assert [row[0] for row in EDITS] == [*HERE]


@pytest.mark.parametrize("row", HERE)
def test_an_edit_is_noticed_as_the_page_says(row, trial, shown):
    HERE[row](trial, shown)
