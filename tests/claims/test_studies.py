"""Pooling what others hand over: effects and errors by hand; sources that are damaged, double or of two protocols."""

from __future__ import annotations

import base64
import json
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsbench.analysis.results import load_experiment
from gsbench.analysis.statistics import student
from gsbench.claims.archive import write_archive
from gsbench.claims.studies import Wanted, _result, file_mark, read_source
from gsbench.cli import run
from gsbench.errors import InputError
from tests.analysis.synthetic import Plan, write_runs

KNOWN_MARK = "0705c835f23f8aeabd8d476f6841da66d2f76384e68e1417f379d2bf067f9248"
WANTED = Wanted(("volumetric", "new"), ("adc", "gaussian-splatting"), "psnr")


def archive(
    tmp_path: Path,
    name: str,
    seed: int = 0,
    protocol: str = "paper-1",
    budget: dict[str, Any] | None = None,
    **plan: Any,
) -> Path:
    """A lab's archive, in which volumetric gains 1 dB."""
    runs = tmp_path / f"runs_{name}_{seed}"
    paths = write_runs(runs, Plan(effect={"psnr": 1.0}, random_seed=seed, **plan))
    for number, path in enumerate(paths):
        results = json.loads((path / "results.json").read_text())
        results["protocol"] = protocol if protocol != "both" else ("paper-1", "standard-1")["garden" in str(path)]
        results["budget"] = budget or results["budget"]
        results["seconds"]["train"] += seed + number / 1000  # no two trainings take one and the same time
        (path / "results.json").write_text(json.dumps(results))
    file = tmp_path / f"{name}.zip"
    write_archive(load_experiment(runs, "exp"), file)
    return file


def nerfbaselines_file(folder: Path, method: str, scene: str, psnr: list[float], **changes: Any) -> Path:
    """As its ``evaluate`` writes it (nerfbaselines 1.2, io.serialize_evaluation_results)."""
    raw = {"psnr": psnr, "lpips": [0.1 for _ in psnr]}
    content = {
        "nb_info": {"method": method},
        "render_dataset_metadata": {"id": "mipnerf360", "scene": scene},
        "metrics": {name: round(float(np.mean(np.float32(values))), 5) for name, values in raw.items()},
        "metrics_raw": {
            name: base64.b64encode(b"".join(struct.pack("<f", value) for value in values)).decode()
            for name, values in raw.items()
        },
        "metrics_sha256": file_mark({name: np.array(values) for name, values in raw.items()}),
        "evaluation_protocol": "nerf",
    }
    file = folder / method / f"{scene}.json"
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(content | changes))
    return file


def test_an_archive_is_a_study_of_its_pairs(tmp_path: Path) -> None:
    file = archive(tmp_path, "lab")
    (study,) = read_source(file, WANTED).studies
    trials = load_experiment(tmp_path / "runs_lab_0", "exp").trials
    by_arm = {(one.densify, one.scene, one.seed): one.metrics["psnr"] for one in trials}
    pairs = np.array(
        [
            [by_arm["volumetric", scene, k] - by_arm["adc", scene, k] for k in range(3)]
            for scene in ("courtyard", "garden")
        ]
    )
    assert study.effect == pytest.approx(pairs.mean())
    test = student(pairs)
    assert test is not None
    assert study.interval is not None
    assert (study.interval.low, study.interval.high) == pytest.approx((test.interval().low, test.interval().high))
    assert study.conditions == {"protocol": "paper-1", "metric": "psnr"}
    assert study.name == "lab"


def test_where_each_scene_has_one_initialiser_they_are_one_study(tmp_path: Path) -> None:
    both = archive(tmp_path, "both", inits=("sfm", "dataset"))
    assert [study.name for study in read_source(both, WANTED).studies] == ["both (dataset)", "both (sfm)"]
    trials = load_experiment(tmp_path / "runs_both_0", "exp")
    kept = [trial for trial in trials.trials if (trial.init == "sfm") == (trial.scene == "garden")]
    write_archive(replace(trials, trials=tuple(kept)), tmp_path / "one.zip")
    found = read_source(tmp_path / "one.zip", WANTED)
    (study,) = found.studies
    by_arm = {(trial.densify, trial.scene, trial.seed): trial.metrics["psnr"] for trial in kept}
    pairs = np.array([by_arm["volumetric", *key[1:]] - value for key, value in by_arm.items() if key[0] == "adc"])
    assert study.effect == pytest.approx(pairs.mean())
    assert study.interval is not None
    assert [("sfm" in note, "dataset" in note) for note in found.notes] == [(False, True), (True, False)]


def test_trials_of_archives_can_be_chosen(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """As where one archive holds two initialisers, or two splits, under one name."""
    files = [str(archive(tmp_path, name, seed, inits=("sfm", "random"))) for seed, name in enumerate("ab")]
    assert run(["pool", *files, "--arm", "volumetric", "--where", "init=sfm"]) == 0
    out = capsys.readouterr().out
    assert "of 2 studies" in out
    assert "| a |" in out
    assert out.startswith("volumetric against adc, difference in PSNR (dB), more is better\n")
    assert "caution" not in out
    (tmp_path / "nb").mkdir()
    command = ["pool", *files, str(tmp_path / "nb"), "--arm", "volumetric", "--where", "init=sfm"]
    assert run(command) == 1
    assert "hold no settings to choose by" in capsys.readouterr().err
    assert run(["pool", *files, "--arm", "volumetric", "--where", "init=none"]) == 2


def test_unlike_budgets_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    steered = archive(tmp_path, "steered", budget={"max_gaussians": 20_000, "cap": "governor"})
    growing = archive(tmp_path, "growing", seed=1, budget={"max_gaussians": None, "cap": None})
    assert run(["pool", str(steered), str(growing), "--arm", "volumetric", "--out", str(tmp_path / "p.html")]) == 0
    sentence = "caution: unlike budgets (steered: 20,000 Gaussians (governor); growing: none)"
    assert sentence in capsys.readouterr().out
    assert sentence in (tmp_path / "p.html").read_text(encoding="utf-8")


def test_result_files_of_nerfbaselines_are_a_study_of_their_scenes(tmp_path: Path) -> None:
    for scene, base, gain in (("garden", 27.0, 0.5), ("room", 31.0, 0.7), ("stump", 26.0, 0.3)):
        nerfbaselines_file(tmp_path / "nb", "gaussian-splatting", scene, [base, base + 1])
        nerfbaselines_file(tmp_path / "nb", "new", scene, [base + gain, base + 1 + gain])
    nerfbaselines_file(tmp_path / "nb", "new", "bicycle", [1.0])  # no partner
    nerfbaselines_file(tmp_path / "nb", "zipnerf", "garden", [1.0])
    (study,) = read_source(tmp_path / "nb", WANTED).studies
    assert study.effect == pytest.approx(0.5, abs=1e-5)
    assert study.interval is not None
    assert study.interval.high - study.effect == pytest.approx(4.3027 * 0.2 / np.sqrt(3), abs=1e-3)
    assert study.conditions["protocol"] == "nerfbaselines nerf"
    with pytest.raises(InputError, match="nerfbaselines measures psnr, ssim, lpips_alex"):
        read_source(tmp_path / "nb", Wanted(("new",), ("gaussian-splatting",), "flip"))


def test_the_mark_of_a_file_of_nerfbaselines(tmp_path: Path) -> None:
    """Its own function (io.get_metrics_hash of nerfbaselines 1.2.7) gives these for the values."""
    assert file_mark({"psnr": np.array([2.0, 1.0])}) == file_mark({"psnr": np.array([1.0, 2.0])})
    assert file_mark({"psnr": np.array([1.5, 20.25]), "ssim": np.array([0.5, 0.75])}) == KNOWN_MARK


@pytest.mark.parametrize(
    "change",
    [
        {"metrics": {"psnr": 99.0}},
        {"metrics_sha256": "0" * 64},
        {"metrics_raw": {"psnr": "AAAA"}},
        {"metrics_raw": {"psnr": "no base64!"}},
        {"metrics_raw": {"psnr": ""}},
        {"nb_info": {}},
        {"render_dataset_metadata": {"id": "x"}},
        {"metrics_raw": [1]},
    ],
    ids=str,
)
def test_a_changed_file_of_nerfbaselines_is_named_and_the_others_count(tmp_path: Path, change: dict[str, Any]) -> None:
    for scene in ("garden", "room", "stump"):
        nerfbaselines_file(tmp_path / "nb", "adc", scene, [20.0 + len(scene)])
        nerfbaselines_file(tmp_path / "nb", "new", scene, [21.0 + 2 * len(scene)])
    nerfbaselines_file(tmp_path / "nb", "new", "room", [5.0, 6.0], **change)
    found = read_source(tmp_path / "nb", WANTED)
    assert "2 scenes (mipnerf360/garden, mipnerf360/stump)" in found.notes[1]
    assert "room.json" in found.notes[0]


def test_three_labs_make_a_mean_and_a_page(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files = [str(archive(tmp_path, f"lab{k}", k)) for k in range(3)]
    assert run(["pool", *files, "--arm", "volumetric", "--out", str(tmp_path / "page.html")]) == 0
    out = capsys.readouterr().out
    assert "| lab0 | +" in out
    assert "of 3 studies" in out
    assert "a further one would lie between" in out
    page = (tmp_path / "page.html").read_text()
    assert "<svg" in page
    assert "all together" in page
    assert "http" not in page.replace("http://www.w3.org", "")


def test_two_protocols_have_no_mean_and_one_can_be_chosen(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Between archives and within one: every study is shown, and none is lost."""
    files = [str(archive(tmp_path, "a", 0)), str(archive(tmp_path, "b", 1, "both")), str(archive(tmp_path, "c", 2))]
    assert run(["pool", *files, "--arm", "volumetric"]) == 0
    out = capsys.readouterr().out
    assert all(name in out for name in ("| a |", "| b (paper-1) |", "| b (standard-1) |", "| c |"))
    assert "no mean: the studies differ in protocol" in out
    assert run(["pool", *files, "--arm", "volumetric", "--protocol", "paper-1"]) == 0
    out = capsys.readouterr().out
    assert "of 3 studies" in out
    assert "b (standard-1): not asked for" in out


def test_bad_sources_are_a_line_each_and_the_others_are_pooled(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    good = [archive(tmp_path, "good", 0), archive(tmp_path, "fine", 1)]
    cut = archive(tmp_path, "cut", 2)
    cut.write_bytes(cut.read_bytes()[:-500])
    twin = tmp_path / "twin.zip"
    twin.write_bytes(good[0].read_bytes())
    other = archive(tmp_path, "other", 3, densifiers=["adc", "mcmc"])
    single = archive(tmp_path, "single", 4, scenes=["garden"], seeds=[0])
    empty = tmp_path / "empty"
    empty.mkdir()
    sources = map(str, [*good, cut, twin, other, single, empty, tmp_path / "none.zip"])
    assert run(["pool", *sources, "--arm", "volumetric"]) == 1
    captured = capsys.readouterr()
    assert "of 2 studies" in captured.out
    lines = captured.err.splitlines()
    for name, reason in (
        ("cut.zip", "no whole zip"),
        ("twin.zip", "would count twice"),
        ("other.zip", "has no pair of volumetric and adc (there are sfm-adc, sfm-mcmc)"),
        ("single", "has one pair"),
        ("empty", "no result files of nerfbaselines"),
        ("none.zip", "no such file"),
    ):
        (line,) = [line for line in lines if name in line]
        assert reason in line
    assert len(lines) == 6
    assert run(["pool", str(cut), "--arm", "volumetric"]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_labs_that_name_their_files_alike_are_told_apart(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for lab, seed in (("one", 0), ("two", 1)):
        (tmp_path / lab).mkdir()
        archive(tmp_path / lab, "results", seed)
    sources = [str(tmp_path / lab / "results.zip") for lab in ("one", "two")]
    assert run(["pool", *sources, "--arm", "volumetric"]) == 0
    assert f"| {sources[1]} |" in capsys.readouterr().out


def test_a_metric_that_a_source_lacks_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["pool", str(archive(tmp_path, "lab")), "--arm", "volumetric", "--metric", "lpips_alex"]) == 2
    assert "can be paired in lpips_alex" in capsys.readouterr().err
    assert run(["pool", str(tmp_path / "lab.zip")]) == 2
    assert "--arm" in capsys.readouterr().err


@pytest.mark.parametrize("content", ["[" * 200_000, '{"nb_info": 1}', "text"])
def test_what_is_no_result_file_of_nerfbaselines_is_one_line(tmp_path: Path, content: str) -> None:
    good = nerfbaselines_file(tmp_path / "nb", "new", "garden", [1.0])
    (tmp_path / "nb" / "bad.json").write_text(content)
    with pytest.raises(InputError, match=r"bad\.json") as caught:
        _result(tmp_path / "nb" / "bad.json")
    assert "\n" not in str(caught.value)
    data = json.loads(good.read_text())
    good.write_text(json.dumps(data | {"metrics": {"psnr": "high"}}))
    with pytest.raises(InputError, match="no result file of nerfbaselines"):
        _result(good)
