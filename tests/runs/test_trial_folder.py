"""The files of a finished trial are compared with their recorded hashes, and changes are named."""

import json
import os
import re
from dataclasses import replace

import pytest

from gsbench import cli
from gsbench.analysis.results import load_experiment
from gsbench.errors import InputError
from gsbench.launch.states import states_of_experiment
from gsbench.parsing import DamagedError
from gsbench.runs import freshness
from gsbench.runs.code import config_hash
from gsbench.runs.configuration import sha256_of
from gsbench.runs.trial_folder import TrialFolder
from gsbench.view.trials import find_trial, model_file
from tests.fuzz.records import EXPERIMENT, write_trial
from tests.helpers import read_json, refusal, write


@pytest.fixture
def trial(tmp_path, monkeypatch):
    monkeypatch.setenv("GSBENCH_RUNS", str(tmp_path))
    write_trial(tmp_path, "adc", 1)
    return write_trial(tmp_path, "adc", 0)


def edit(path, old, new):
    """Change a file and keep its time, as somebody does who wants to hide the change."""
    state = path.stat()
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new))
    os.utime(path, ns=(state.st_atime_ns, state.st_mtime_ns))


def test_a_trial_with_changed_results_is_left_out_and_named(trial, capsys):
    edit(trial / "results.json", "26.5", "43.2")
    experiment = load_experiment(trial.parents[3], EXPERIMENT)
    assert [one.seed for one in experiment.trials] == [1]
    (line,) = experiment.warnings
    assert "results.json was changed after it was written" in line
    assert f"gsbench retry {EXPERIMENT}" in line
    assert TrialFolder(trial).state() == "damaged"
    assert cli.run(["tables", EXPERIMENT]) == 0
    said = capsys.readouterr()
    assert "43.2" not in said.out
    assert f"left out: {line}" in said.err
    assert cli.run(["status", EXPERIMENT]) == 1
    shown = capsys.readouterr().out
    assert "damaged" in shown
    assert "results.json was changed after it was written" in shown
    assert "2 trials: 1 done, 1 damaged" in shown


def test_white_space_and_time_are_no_change_of_results(trial):
    path = trial / "results.json"
    write(path, read_json(path))
    os.utime(path, (1, 1))
    assert TrialFolder(trial).record().metrics == {"psnr": 26.5}
    assert TrialFolder(trial).state() == "done"


def test_results_without_made_of_are_accepted(trial):
    path = trial / "results.json"
    content = read_json(path)
    del content["made_of"]
    write(path, content)
    edit(trial / "results.json", "26.5", "43.2")
    assert TrialFolder(trial).record().metrics == {"psnr": 43.2}


@pytest.mark.parametrize("name", ["per_view.csv", "config.yaml", "point_cloud.ply", "lineage.npz"])
@pytest.mark.parametrize("is_large", [False, True])
def test_a_trial_with_an_edited_file_counts_nowhere(trial, name, is_large, monkeypatch):
    runs, folder = trial.parents[3], TrialFolder(trial)
    for made in ("point_cloud.ply", "lineage.npz"):
        (trial / made).write_text("25.5")
    if is_large:
        monkeypatch.setattr(freshness, "MAX_HASHED_BYTES", 4)
    folder.write_finished(folder.settings(), folder.record())
    before = len(load_experiment(runs, EXPERIMENT).trials)
    assert TrialFolder(trial).state() == "done"
    edit(trial / name, "25.5" if name != "config.yaml" else "0.03", "0.04")
    os.utime(trial / name)
    found = load_experiment(runs, EXPERIMENT)
    assert len(found.trials) == before - 1
    assert f"damaged, {name} was changed after results.json was written" in "".join(found.warnings)
    (state,) = (one for one in states_of_experiment(trial.parents[2]) if one.folder == trial)
    assert (state.state, name in state.note) == ("damaged", True)
    with pytest.raises(InputError):
        find_trial(str(trial), runs)
    (trial / name).unlink()  # models are deleted to make room
    assert TrialFolder(trial).state() == "done"


def test_a_large_file_with_its_old_size_and_time_is_compared_before_it_is_exported(
    trial, monkeypatch
):
    monkeypatch.setattr(freshness, "MAX_HASHED_BYTES", 4)
    model, folder = trial / "point_cloud.ply", TrialFolder(trial)
    model.write_bytes(b"ply 25.5")
    folder.write_finished(folder.settings(), folder.record())
    one = find_trial(str(trial), trial.parents[3])
    assert model_file(one) == model
    state = model.stat()
    model.write_bytes(b"ply 26.5")
    os.utime(model, ns=(state.st_atime_ns, state.st_mtime_ns))
    with refusal(r"point_cloud\.ply was changed"):
        model_file(one)


def test_changed_curves_are_not_used(trial, caplog):
    edit(trial / "metrics.jsonl", "20.2", "40.2")
    one = find_trial(str(trial), trial.parents[3])
    assert one.folder.curves() == []
    assert "metrics.jsonl was changed after it was written" in caplog.text
    assert len(one.folder.curves("events.jsonl")) == 10


def test_a_trial_folder_knows_its_runs_folder_key_and_label(trial):
    folder = TrialFolder(trial)
    values = folder.settings()
    assert TrialFolder.of(values).path == trial
    assert (folder.runs, folder.home) == (trial.parents[3], trial.parents[2])
    hash8 = trial.name.partition("-")[0]
    assert folder.key == f"courtyard/sfm-adc/{hash8}"
    assert folder.label == f"courtyard/sfm-adc seed 0 ({hash8})"
    assert folder.lock == trial / ".lock"


def test_the_state_of_a_trial_follows_from_its_files(tmp_path):
    folder = TrialFolder(tmp_path / "x/s/a-b/01234567-seed0")
    folder.path.mkdir(parents=True)
    assert (folder.state(), folder.has_failed()) == ("missing", False)
    (folder.path / "config.yaml").touch()
    assert (folder.state(), folder.has_failed()) == ("partial", False)
    assert folder.failure().message == "failed.json cannot be read"
    (folder.path / "failed.json").write_text('{"error": "E", "message": "why"}')
    assert (folder.state(), folder.has_failed(), folder.failure().reason) == ("failed", True, "why")
    (folder.path / "results.json").write_text("{}")
    assert folder.state() == "damaged"


def test_the_stage_and_the_last_iteration_are_read_from_the_files_of_a_training(tmp_path):
    folder = TrialFolder(tmp_path)
    assert folder.stage_and_step() == ("", 0)
    write(tmp_path / "building.json", {"stage": "train", "folder": str(tmp_path / "built")})
    assert folder.stage_and_step() == ("train", 0)
    (tmp_path / "built").mkdir()
    rows = "".join(json.dumps({"step": step, "loss": 0.1}) + "\n" for step in range(1000))
    (tmp_path / "built/metrics.jsonl").write_text(rows + '{"step": 10')
    assert folder.stage_and_step() == ("train", 10)
    # only the end of a large file is read
    (tmp_path / "built/metrics.jsonl").write_text('{"step": 7' + " " * 5000)
    assert folder.stage_and_step() == ("train", 0)


def test_a_configuration_that_cannot_be_used_is_refused(trial):
    assert TrialFolder(trial).configuration()["allow_targets"] == []
    edit(trial / "config.yaml", '"seed": 0', '"seed": "0"')
    with pytest.raises(DamagedError, match="seed is '0'"):
        TrialFolder(trial).configuration()
    (trial / "config.yaml").unlink()
    with refusal("give the command of the trial again"):
        TrialFolder(trial).configuration()


def test_equal_results_keep_their_time_and_others_do_not(trial):
    folder, path = TrialFolder(trial), trial / "results.json"
    values, record = folder.settings(), folder.record()
    finished = folder.made_of().finished
    os.utime(path, ns=(1, 1))  # a copy of the folder has other times of its files
    assert folder.write_finished(values, record)
    assert path.stat().st_mtime_ns == 1
    assert folder.made_of().finished == finished
    assert not folder.write_finished(values, replace(record, iterations=record.iterations + 1))
    assert path.stat().st_mtime_ns > 1
    assert folder.made_of().finished > finished
    path.unlink()
    assert not folder.write_finished(values, record, entries={"train": trial})
    assert path.read_text().startswith('{\n "status": "complete",\n')
    made_of = folder.made_of()
    assert made_of.entries == {"train": str(trial)}
    assert set(made_of.published) == {
        "config.yaml",
        "per_view.csv",
        "metrics.jsonl",
        "events.jsonl",
    }
    assert set(made_of.digests) == set(made_of.published)


def test_only_small_files_and_those_that_tables_read_have_digests(trial, monkeypatch):
    folder = TrialFolder(trial)
    values, record = folder.settings(), folder.record()
    for name, size in (("small.png", 4), ("large.png", 5)):
        (trial / name).write_bytes(bytes(size))
    monkeypatch.setattr(freshness, "MAX_HASHED_BYTES", 4)
    folder.write_finished(values, record, published=[trial / "small.png", trial / "large.png"])
    made_of = folder.made_of()
    assert made_of.published.keys() - made_of.digests.keys() == {"large.png"}


def test_views_are_checked_and_empty_values_are_left_out(trial):
    (trial / "results.json").unlink()
    path = trial / "per_view.csv"
    path.write_text("view,psnr,ssim\na,1e30,\nb,-2,0.5\n")
    assert TrialFolder(trial).views() == {"a": {"psnr": 1e30}, "b": {"psnr": -2.0, "ssim": 0.5}}
    for value in ("1.1e30", "-1.1e30", "nan", "inf", "much"):
        path.write_text(f"view,psnr\na,{value}\n")
        with pytest.raises(DamagedError, match="is damaged"):
            TrialFolder(trial).views()


def test_a_changed_file_is_found_even_if_the_results_were_not_read_before(trial):
    edit(trial / "per_view.csv", "25.5", "24.5")
    with pytest.raises(DamagedError, match=r"per_view\.csv was changed after it was written"):
        TrialFolder(trial).views()


def test_pictures_are_sorted_by_name(trial):
    (trial / "renders").mkdir()
    for name in ("b.png", "a.png", "c.txt"):
        (trial / f"renders/{name}").touch()
    assert [path.name for path in TrialFolder(trial).pictures("renders")] == ["a.png", "b.png"]


@pytest.mark.parametrize(
    "place, value, reason",
    [
        (("hashes", "config"), "0", "of another configuration"),
        (("made_of", "config"), "0", "of another configuration"),
        (("made_of", "stages", "train"), 1, r"stage train was 1, it is now \d"),
        (("made_of", "stages", "gone"), 3, "stage gone was 3, it is now none"),
        (("made_of", "stages"), {}, "stage scene was none, it is now 2"),
        (("code",), {"packages": {"train": "0" * 16}}, "gsbench's train was 00000000, it is now "),
        (("made_of", "pycolmap"), "0.1", r"pycolmap was 0\.1, it is now \d"),
        (("made_of", "sources"), {"/nowhere/a.png": [1, 2, 3]}, r"/nowhere/a\.png cannot be read"),
        (("made_of", "folders"), {"/nowhere": 1}, "files were added to /nowhere, or removed"),
        (("made_of", "published", "per_view.csv"), [1, 2], r"per_view\.csv has changed"),
        (("made_of", "digests", "per_view.csv"), "0", r"per_view\.csv has changed"),
        (
            ("made_of", "entries"),
            {"train": "/nowhere"},
            "its stage train in the store is damaged or gone",
        ),
    ],
)
def test_each_change_since_the_results_were_written_is_named(trial, place, value, reason):
    folder, path = TrialFolder(trial), trial / "results.json"
    values = folder.settings()
    folder.write_finished(values, replace(folder.record(), hashes={"config": config_hash(values)}))
    assert folder.why_not_done(values) is None
    content = read_json(path)
    inner = content
    for key in place[:-1]:
        inner = inner[key]
    inner[place[-1]] = value
    content["made_of"]["results"] = sha256_of(
        {key: own for key, own in content.items() if key != "made_of"}
    )
    write(path, content)
    assert re.search(reason, str(folder.why_not_done(values)))


def test_a_missing_metric_that_can_be_computed_now_is_a_reason_to_run(trial):
    folder = TrialFolder(trial)
    values = folder.settings() | {"eval": {"primary": "x"}}
    asked = []
    unavailable = lambda options: asked.append(options) or {"flip"}  # noqa: E731
    record = replace(folder.record(), hashes={"config": config_hash(values)})
    folder.write_finished(values, record)
    assert (folder.why_not_done(values, unavailable), asked) == (None, [])  # asking loads torch
    folder.write_finished(values, replace(record, awaited=["flip"]))
    assert (folder.why_not_done(values, unavailable), asked) == (None, [values["eval"]])
    folder.write_finished(values, replace(record, awaited=["lpips_vgg", "flip"]))
    reasons = folder.why_not_done(values, unavailable), folder.why_not_done(values)
    assert [*map(str, reasons)] == [
        "it lacks lpips_vgg, which can be computed now",
        "it lacks lpips_vgg, flip",
    ]
    content = read_json(trial / "results.json")
    del content["made_of"]
    for found, reason in (
        (content, "results.json does not say what it was made of"),
        (content | {"seed": "0"}, "results.json is damaged: seed is '0'"),
        ("{", "results.json is not JSON"),
        (content | {"status": "running"}, "results.json is not there, or not complete"),
    ):
        write(trial / "results.json", found)
        assert str(folder.why_not_done(values)).startswith(reason)
