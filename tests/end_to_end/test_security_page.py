"""docs/security.md, line by line: what each verb may run, and which edits of files are noticed."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path
from shlex import split

import pytest
import torch

from gsbench.cli import run
from gsbench.system.jit import cache_base
from gsbench.verbs import VERBS
from tests.end_to_end.conftest import FINISHED, SMALL
from tests.end_to_end.test_hydra import TINY
from tests.helpers import write

PAGE = Path(__file__).parents[2] / "docs/security.md"
pytestmark = pytest.mark.slow


def table(heading):
    """The rows of the table below a heading of the page, as lists of cells."""
    section = PAGE.read_text(encoding="utf-8").partition(f"## {heading}\n")[2].partition("\n## ")[0]
    rows = [line.strip("| ").split(" | ") for line in section.splitlines() if line.startswith("|")]
    return rows[2:]


def check_tests_are_there(*places):
    for place in places:
        file, _, name = place.partition("::")
        assert f"def {name}(" in (PAGE.parents[1] / "tests" / file).read_text()


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
        check_tests_are_there(elsewhere)
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


# ---- edits, with the tests of each row

EDIT_ROWS = {
    "`results.json`": [
        "runs/test_trial_folder.py::test_a_trial_with_changed_results_is_left_out_and_named",
        "runs/test_trial_folder.py::test_results_without_made_of_are_accepted",
    ],
    "`config.yaml`, `per_view.csv`, `point_cloud.ply`, `lineage.npz` of a trial": [
        "runs/test_trial_folder.py::test_a_trial_with_an_edited_file_counts_nowhere",
        "verbs/test_trials.py::test_verify_finds_a_large_file_that_changed_and_kept_its_time",
    ],
    "`metrics.jsonl`, `events.jsonl`": [
        "runs/test_trial_folder.py::test_changed_curves_are_not_used"
    ],
    "pictures of a trial": [
        "runs/test_trial_folder.py::test_each_change_since_the_results_were_written_is_named"
    ],
    "`store/`: results of stages and prepared views": [
        "runs/test_store.py::test_a_flipped_bit_is_found_before_a_result_becomes_an_input",
        "scene/test_load.py::test_stored_views_that_were_changed_are_prepared_again",
        "runs/test_strange_folder.py::test_a_stored_result_that_is_shown_is_as_it_was_written",
    ],
    "`commands.jsonl`": [
        "analysis/test_answers.py::test_a_broken_link_among_the_commands_is_a_warning",
        "verbs/test_ledger.py::test_trials_that_the_ledger_does_not_know_are_refused",
    ],
    "`tuning.json`": ["app/test_tuning.py::test_settings_added_to_a_record_are_ignored"],
}


def test_every_row_of_edits_has_tests():
    assert [row[0] for row in EDITS] == [*EDIT_ROWS]
    for places in EDIT_ROWS.values():
        check_tests_are_there(*places)
