"""Archives of results: what they keep, what they never hold, and one line for every damage."""

import hashlib
import json
import os
import re
import shutil
import zipfile
from dataclasses import replace
from pathlib import Path
from shlex import split

import pytest
import yaml

from gsbench.analysis.comparison import compare
from gsbench.analysis.fairness import fairness_table
from gsbench.analysis.images import textured_error
from gsbench.analysis.results import load_experiment, read_views
from gsbench.analysis.table_formats import to_markdown
from gsbench.claims.archive import unpack_archive
from gsbench.claims.export import write_archive
from gsbench.errors import InputError
from tests.analysis.helpers import ADC, VOLUMETRIC, loaded
from tests.helpers import change_json, refusal, write
from tests.trials import ask_about, search_record, write_runs

# as many trials as Table 1 has
MANY = {"scenes": [f"scene{k}" for k in range(9)], "seeds": range(3), "views": 25}


UNSIGNED = ("archive.json",)


def export(tmp_path, **plan):
    runs = tmp_path / "runs"
    write_runs(runs, **plan)
    ask_about(runs)
    write_archive(loaded(runs), tmp_path / "exp.zip")
    return tmp_path / "exp.zip"


def members(file):
    with zipfile.ZipFile(file) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def rewrite(file, change, resigned=False):
    """Change the members of an archive; somebody who knows how also updates their checksums."""
    content = members(file)
    change(content)
    if resigned:
        manifest = json.loads(content["archive.json"])
        manifest["sha256"] = {
            name: hashlib.sha256(data).hexdigest()
            for name, data in content.items()
            if name not in UNSIGNED
        }
        content["archive.json"] = json.dumps(manifest).encode()
    with zipfile.ZipFile(file, "w") as archive:
        for name, data in content.items():
            archive.writestr(name, data)


def test_results_settings_and_views_are_read_back(tmp_path):
    file = export(tmp_path)
    there = loaded(tmp_path / "runs")
    back = unpack_archive(file, tmp_path / "other")
    assert [one.label for one in back.trials] == [one.label for one in there.trials]
    for one, other in zip(there.trials, back.trials, strict=True):
        assert replace(other.record, measured=None) == one.record
        assert other.measured == int(one.measured)
        assert other.config == one.config
        assert read_views(other) == read_views(one)
    (question,), (same,) = there.history.questions, back.history.questions
    assert same == question
    assert not back.history.faults
    assert compare(back).sentences == compare(there).sentences


@pytest.mark.parametrize("name", ["declared.jsonl", "ledger.jsonl"])
def test_an_archive_tells_that_an_earlier_gsbench_was_asked_but_not_what(tmp_path, name):
    write_runs(tmp_path / "runs")
    (tmp_path / "runs/exp" / name).write_text('{"words": ["tracking.uri=http://me:pw@host"]}')
    file = tmp_path / "exp.zip"
    write_archive(loaded(tmp_path / "runs"), file)
    assert not any(b"me:pw" in content for content in members(file).values())
    (answer,) = compare(unpack_archive(file, tmp_path / "other")).answers
    assert name in answer.sentence


def test_an_archive_is_a_runs_folder_with_a_list_of_checksums(tmp_path):
    content = members(export(tmp_path, scenes=("yard",), seeds=(0,), densifiers=("adc",)))
    manifest = json.loads(content["archive.json"])
    (folder,) = (path.parent for path in (tmp_path / "runs").glob("exp/*/*/*/results.json"))
    place = folder.relative_to(tmp_path / "runs").as_posix()
    files = {f"{place}/{name}" for name in ("results.json", "config.yaml", "per_view.csv")}
    assert set(manifest["sha256"]) == files | {"exp/commands.jsonl"}
    assert set(content) == set(manifest["sha256"]) | set(UNSIGNED)
    assert content[f"{place}/per_view.csv"] == (folder / "per_view.csv").read_bytes()
    assert all(
        hashlib.sha256(content[name]).hexdigest() == digest
        for name, digest in manifest["sha256"].items()
    )


def test_the_export_says_how_many_questions_are_open(runs, said):
    paths = write_runs(runs)
    ask_about(runs, lambda trial: trial.scene == "courtyard")
    ask_about(runs)
    assert "open" not in said("export --results exp")
    shutil.rmtree(paths[-1])
    assert said("export --results exp").endswith(", open: 1 of 2\n")


def test_an_archive_is_small_and_equal_results_give_equal_archives(tmp_path):
    file = export(tmp_path, **MANY)
    assert file.stat().st_size < 300_000
    before = file.read_bytes()
    write_archive(loaded(tmp_path / "runs"), file)
    assert file.read_bytes() == before


def test_an_archive_has_no_pixels_no_paths_and_no_passwords(tmp_path):
    runs = tmp_path / "runs"
    (path, *_) = write_runs(runs, pictures=True, views=2)
    config = yaml.safe_load((path / "config.yaml").read_text())
    config["runs"], config["scene"]["path"] = "/home/alice/runs", "/home/alice/photos/garden"
    config["tracking"] = {"uri": "http://alice:secret@there.org"}
    config["densify"] |= {
        "command": "python /home/alice/x.py",
        "a": "sqlite:////home/alice/a.db",
        "b": "https://alice:secret@a.org/c",
    }
    write(path / "config.yaml", config)
    looked = (
        "weights not found: a.pth (looked in /home/alice/weights, /home/alice/.cache/torch; "
        "switched off): get them"
    )
    unavailable = {"lpips_alex": looked, "where": "/home/alice/weights/a.pth"}
    change_json(path / "results.json", unavailable=unavailable)
    write_archive(loaded(runs), tmp_path / "exp.zip")
    content = members(tmp_path / "exp.zip")
    assert not any(name.endswith((".png", ".ply")) for name in content)
    assert b"alice" not in b"".join(content.values())
    assert b"secret" not in b"".join(content.values())
    assert b"python x.py" in b"".join(content.values())
    assert b"https://a.org/c" in b"".join(content.values())
    assert any(
        one.config.get("scene.path") == "garden"
        for one in unpack_archive(tmp_path / "exp.zip", runs / "b").trials
    )


def cut(file):
    file.write_bytes(file.read_bytes()[:-600])


def edit(name, old, new):
    def change(content):
        assert old in content[name]
        content[name] = content[name].replace(old, new)

    return lambda file: rewrite(file, change)


def drop(name):
    return lambda file: rewrite(file, lambda content: content.pop(name) and None)


def added(place, content):
    """An archive by somebody who adds a file."""
    more = {place: json.dumps(content).encode()}
    return lambda file: rewrite(file, lambda content: content.update(more), resigned=True)


def moved(old, new):
    """An archive by somebody who renames files."""

    def change(content):
        for name in [name for name in content if old in name]:
            content[name.replace(old, new)] = content.pop(name)

    return lambda file: rewrite(file, change, resigned=True)


def of_trial(name, old, new, resigned=True):
    """A change of a file of the first trial."""

    def change(content):
        place = min(one for one in content if one.endswith(f"/{name}"))
        assert old in content[place]
        content[place] = content[place].replace(old, new, 1)

    return lambda file: rewrite(file, change, resigned)


def flip_a_bit(file):
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 0x40
    file.write_bytes(bytes(data))


TRIAL = "courtyard/sfm-adc/c0ffee00-seed0"
OUTSIDE = (
    "../up/tuning.json",
    "exp/x/config.yaml",
    f"exp/{TRIAL}/renders/../../x.png",
    "exp/../../x/renders/a.png",
    f"other/{TRIAL}/renders/a.png",
    f"exp/{TRIAL}/other/a.png",
    f"exp/{TRIAL}/renders/",
    f"exp/{TRIAL}/config.txt",
    f"other/{TRIAL}/config.yaml",
    f"/exp/{TRIAL}/config.yaml",
    "exp//sfm-adc/c0ffee00-seed0/config.yaml",
    "a.png",
)


@pytest.mark.parametrize(
    "damage, message",
    [
        (cut, "not a complete zip"),
        (flip_a_bit, "exp.zip: "),
        (lambda file: file.write_bytes(b""), "not a complete zip"),
        (lambda file: file.write_text("results"), "not a complete zip"),
        (lambda file: file.unlink(), "no such file"),
        (
            of_trial("results.json", b'"psnr": 2', b'"psnr": 3', resigned=False),
            "results.json was changed after the export",
        ),
        (of_trial("per_view.csv", b"view000", b"view00x", resigned=False), "was changed"),
        (edit("archive.json", b'"version": 2', b'"version": 3'), "of version 3 of the archive"),
        (edit("archive.json", b"gsbench results", b"other"), "not one of gsbench"),
        (edit("archive.json", b'"sha256"', b'"sha255"'), "not that of an archive"),
        (edit("archive.json", b"{", b"["), "not JSON"),
        (drop("archive.json"), "lacks archive.json"),
        (drop("exp/commands.jsonl"), "lacks exp/commands.jsonl"),
        (moved("exp/courtyard/", "exp/room/"), "foreign"),
        (of_trial("results.json", b'"status": "complete"', b'"status": "well"'), "unfinished"),
        (of_trial("results.json", b"{", b"["), "not JSON"),
        (of_trial("config.yaml", b"name: adc", b"name: volumetric"), "says densify volumetric"),
        (of_trial("config.yaml", b"seed: 0", b"seed: 1"), "says seed 1, its results 0"),
        (of_trial("per_view.csv", b"view000,", b"view009,2"), "per_view.csv"),
        (edit("archive.json", b"{", b"[" * 200_000), "not JSON"),
        (added("up/tuning.json", search_record([]) | {"points": 3}), "points is 3"),
        *((added(place, {}), "cannot be a file of an archive") for place in OUTSIDE),
        (
            edit("archive.json", b'"experiment": "exp"', b'"experiment": "../up"'),
            "cannot be the name of an experiment",
        ),
    ],
)
def test_every_kind_of_damage_is_refused_in_one_line_and_leaves_no_files(tmp_path, damage, message):
    file = export(tmp_path)
    damage(file)
    with refusal(re.escape(message)) as raised:
        unpack_archive(file, tmp_path / "other")
    assert str(raised.value).startswith(str(file))
    assert {path.name for path in tmp_path.iterdir()} <= {"runs", "exp.zip", "other"}


def test_a_file_too_large_is_not_unpacked(tmp_path, monkeypatch):
    file = export(tmp_path)
    monkeypatch.setattr("gsbench.claims.archive.MAX_BYTES", 1000)
    with refusal("an archive of gsbench never has that many"):
        unpack_archive(file, tmp_path / "other")


def test_a_damaged_trial_is_left_out_by_name_and_the_rest_is_exported(
    runs, tmp_path, caplog, said, refused
):
    first, second, *_ = write_runs(runs)
    (first / "per_view.csv").write_text("view,psnr\nview000,1.0\n")
    (second / "results.json").write_text("{")
    assert said("export --results exp --out", tmp_path / "out/a.zip").startswith(
        f"{tmp_path / 'out' / 'a.zip'}: results of exp, "
    )
    assert "does not average" in caplog.text
    assert "not JSON" in caplog.text
    assert len(unpack_archive(tmp_path / "out/a.zip", tmp_path / "b").trials) == 10
    for path in runs.glob("exp/*/*/*/per_view.csv"):
        path.write_text("")
    assert "no whole trial to export" in refused("export --results exp --out", tmp_path / "b.zip")
    assert not (tmp_path / "b.zip").exists()
    for words in (
        split("--results exp exp:courtyard:adc:0"),
        ["--results", "exq"],
        ["exp:courtyard:adc:0"],
        [],
    ):
        refused("export", *words)


@pytest.mark.parametrize("config", ["kept", "unreadable"])
def test_a_trial_that_failed_forbids_the_same_verdict_in_the_archive(tmp_path, config):
    runs = tmp_path / "runs"
    *_, failed = write_runs(runs, effect={"psnr": 3.0})
    ask_about(runs)
    (failed / "results.json").unlink()
    (failed / "failed.json").write_text('{"message": "out of memory in /home/me/x"}')
    if config == "unreadable":
        (failed / "config.yaml").write_text("[1")
    there = loaded(runs)
    write_archive(there, tmp_path / "exp.zip")
    back = unpack_archive(tmp_path / "exp.zip", tmp_path / "other")
    assert compare(back).sentences == compare(there).sentences
    assert "1 trial of one arm alone failed, stopped" in compare(back).sentences[0]
    assert "failed, out of memory in x" in back.warnings[0]
    assert b"/home/me" not in b"".join(members(tmp_path / "exp.zip").values())


def test_what_a_question_asks_of_pictures_comes_with_the_results(tmp_path, monkeypatch):
    """Pictures themselves stay out; a trial whose pictures are gone has no such number."""
    runs = tmp_path / "runs"
    first, *_ = write_runs(runs, scenes=("yard",), seeds=(0,), pictures=True)
    ask_about(runs, metric="error_textured")
    there = {one.key: textured_error(one) for one in loaded(runs).trials}
    (first / "from_pixels.json").unlink(missing_ok=True)
    shutil.rmtree(first / "renders")
    write_archive(loaded(runs), tmp_path / "exp.zip")
    lost, kept = unpack_archive(tmp_path / "exp.zip", tmp_path / "other").trials
    assert textured_error(kept) == there[kept.key]
    with pytest.raises(InputError):
        textured_error(lost)


def test_trials_without_a_sound_configuration_are_left_out(tmp_path):
    runs = tmp_path / "runs"
    first, second, *others = write_runs(runs, scenes=("yard",))
    (first / "config.yaml").unlink()
    (second / "config.yaml").write_text("[1]")
    left_out, _ = write_archive(loaded(runs), tmp_path / "exp.zip")
    assert len(unpack_archive(tmp_path / "exp.zip", tmp_path / "other").trials) == len(others)
    assert len(left_out) == 2


def test_archives_of_the_first_version_are_read(tmp_path):
    file = Path(__file__).parents[2] / "findings/archives/schedule.zip"
    back = unpack_archive(file, tmp_path)
    assert len(back.trials) == 12
    assert [one.arm.densify for one in compare(back).answers if one.verdict.is_tested] == [
        "volumetric"
    ] * 2
    lines = (json.loads(line) for line in members(file)["results.jsonl"].splitlines())
    stored = {line["folder"]: line["results"]["metrics"]["psnr"] for line in lines}
    assert {"/".join(t.path.parts[-3:]): t.metrics["psnr"] for t in back.trials} == stored
    assert all(len(read_views(trial)) > 1 and trial.config for trial in back.trials)


def test_a_pipe_is_no_archive(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with refusal("it is not a regular file"):
        unpack_archive(tmp_path / "pipe", tmp_path / "other")


def test_a_search_stays_a_search_and_a_tuned_arm_stays_tuned(runs, tmp_path, said, refused):
    """Points of a search were chosen by their results: no page of its archive tests them."""
    points = [{"settings": {"densify.volume_threshold": 0.03}, "value": 26.0}]
    for name in ("vth", "search"):
        write_runs(runs, experiment=name)
    write(runs / "search" / "tuning.json", search_record(points))
    for name in ("vth", "search"):
        said("export --results", name, "--out", tmp_path / f"{name}.zip")
    opened = {
        one: unpack_archive(tmp_path / f"{one}.zip", tmp_path / one) for one in ("vth", "search")
    }
    assert compare(opened["search"]).pairs == ()
    for one in (load_experiment(runs, "vth"), opened["vth"]):
        sheet = to_markdown(fairness_table(one.trials, ADC, VOLUMETRIC))
        assert "the best of 1 point by psnr" in sheet


def test_a_time_that_only_a_file_knew_stays_the_time_of_measuring(tmp_path):
    """Results that were there before their declaration are not declared by the journey."""
    file = export(tmp_path)
    for path in (tmp_path / "runs").glob("exp/*/*/*/results.json"):
        os.utime(path, (1e9, 1e9))
    write_archive(loaded(tmp_path / "runs"), file)
    back = unpack_archive(file, tmp_path / "other")
    assert {trial.measured for trial in back.trials} == {1e9}
    assert compare(back).sentences == compare(loaded(tmp_path / "runs")).sentences
