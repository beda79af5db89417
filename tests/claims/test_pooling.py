"""The mean of many studies by Student's t, refusals, and archives as studies."""

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from gsbench.analysis.statistics import Interval, t_test
from gsbench.claims.export import write_archive
from gsbench.claims.pooling import (
    PooledQuestion,
    Study,
    _arm_pairs,
    describe,
    markdown_table,
    pool,
    read_studies,
)
from gsbench.cli import run
from gsbench.runs.experiments import Arm
from tests.analysis.helpers import loaded, trials_of
from tests.helpers import change_json, refusal
from tests.trials import BUDGET, write_runs

WANTED = PooledQuestion(("volumetric", "new"), ("adc", "gaussian-splatting"), "psnr")
POOL = ("pool", "--arm", "volumetric")
EFFECTS = (0.5, 0.9, 0.4, 0.7)
STUDIES = [
    Study(f"trial {k}", effect, Interval(effect - 0.1, effect + 0.1))
    for k, effect in enumerate(EFFECTS)
]


def test_the_mean_is_tested_with_studies_as_units():
    found, expected = pool(STUDIES), stats.ttest_1samp(EFFECTS, 0)
    interval = expected.confidence_interval()
    assert found.test.mean == pytest.approx(np.mean(EFFECTS))
    assert found.test.p == pytest.approx(expected.pvalue)
    own = found.test.interval()
    assert (own.low, own.high) == pytest.approx((interval.low, interval.high))
    half = stats.t.ppf(0.975, 3) * np.std(EFFECTS, ddof=1) * (1 + 1 / 4) ** 0.5
    assert found.prediction.high - found.test.mean == pytest.approx(half)


def test_intervals_contain_the_truth_as_often_as_they_claim():
    """Studies of two or three seeds, whose errors random-effects methods would take as known."""
    rng, held = np.random.default_rng(0), 0
    for _ in range(600):
        effects = rng.normal(1.0, 0.3, 5) + rng.normal(0, rng.uniform(0.1, 0.5, 5))
        found = pool([Study(str(k), float(effect)) for k, effect in enumerate(effects)])
        held += found.test.interval().low <= 1.0 <= found.test.interval().high
    assert held / 600 > 0.95 - 3 * (0.05 * 0.95 / 600) ** 0.5


def test_studies_of_different_protocols_have_no_mean():
    studies = [Study("a", 1.0, None, "paper-1"), Study("b", 1.1, None, "standard-1")]
    found = pool(studies)
    assert found.test is None
    assert found.refusal == "the studies differ in protocol (a: paper-1; b: standard-1)"
    assert describe(found) == [f"no mean: {found.refusal}"]
    unknown = pool([studies[0], Study("c", 1.0)])
    assert "c: unknown" in unknown.refusal
    alike = pool([studies[0], Study("c", 1.0, None, "paper-1")]).test
    assert alike.mean == pytest.approx(1.0)


def test_one_study_has_no_mean_and_a_study_given_twice_is_refused():
    assert pool(STUDIES[:1]).test is None
    assert pool([]).test is None
    with refusal("twice"):
        pool([STUDIES[0], STUDIES[0]])


def test_the_mean_is_described_with_the_prediction_for_a_further_study():
    pooled, expected = pool(STUDIES), stats.ttest_1samp(EFFECTS, 0)
    mean, spread = np.mean(EFFECTS), np.std(EFFECTS, ddof=1)
    own, reach = expected.confidence_interval(), stats.t.ppf(0.975, 3) * spread * 1.25**0.5
    assert describe(pooled) == [
        f"mean {mean:+.4g} (95 % interval {own.low:+.4g} to {own.high:+.4g}, p "
        f"{expected.pvalue:.3g}) of 4 studies, each with the same weight",
        f"studies differ by a deviation of {spread:.3g}; a further one would lie between "
        f"{mean - reach:+.4g} and {mean + reach:+.4g}",
    ]


def test_studies_are_rows_of_a_table():
    _, _, first, second = markdown_table(
        pool([Study("a", 1.0, Interval(0.9, 1.25), "paper-1"), Study("b", -0.5)])
    )
    assert first == "| a | +1 | +0.9 to +1.25 | paper-1 |"
    assert second == "| b | -0.5 | – |  |"


def archive(tmp_path, name, seed=0, protocol="paper-1", budget=None, **plan):
    """Write the archive of a laboratory in which "volumetric" gains 1 dB."""
    runs = tmp_path / f"runs_{name}_{seed}"
    paths = write_runs(runs, effect={"psnr": 1.0}, random_seed=seed, **plan)
    for number, path in enumerate(paths):
        own = ("paper-1", "standard-1")["garden" in str(path)] if protocol == "both" else protocol
        # no two trainings take exactly the same time
        took = {"init": 5.0, "train": 60 + seed + number / 1000, "evaluate": 2.0}
        changes = {"protocol": own, "seconds": took, "budget": budget or BUDGET}
        change_json(path / "results.json", **changes)
    file = tmp_path / f"{name}.zip"
    write_archive(loaded(runs), file)
    return file


def test_an_archive_is_a_study_of_its_paired_differences(tmp_path):
    file = archive(tmp_path, "lab")
    ((study,), _, _) = read_studies(file, WANTED, "lab")
    trials = trials_of(tmp_path / "runs_lab_0")
    by_arm = {(one.densify, one.scene, one.seed): one.metrics["psnr"] for one in trials}
    pairs = np.array(
        [
            [by_arm["volumetric", scene, k] - by_arm["adc", scene, k] for k in range(3)]
            for scene in ("courtyard", "garden")
        ]
    )
    assert study.effect == pytest.approx(pairs.mean())
    expected = t_test(pairs).interval()
    assert study.interval.low == pytest.approx(expected.low)
    assert study.interval.high == pytest.approx(expected.high)
    assert (study.protocol, study.name) == ("paper-1", "lab")


def test_initialisers_on_different_scenes_are_one_study(tmp_path):
    both = archive(tmp_path, "both", inits=("sfm", "dataset"))
    assert [study.name for study in read_studies(both, WANTED, "both")[0]] == [
        "both (dataset)",
        "both (sfm)",
    ]
    trials = loaded(tmp_path / "runs_both_0")
    kept = [trial for trial in trials.trials if (trial.init == "sfm") == (trial.scene == "garden")]
    write_archive(replace(trials, trials=tuple(kept)), tmp_path / "one.zip")
    (study,), notes, _ = read_studies(tmp_path / "one.zip", WANTED, "one")
    by_arm = {(trial.densify, trial.scene, trial.seed): trial.metrics["psnr"] for trial in kept}
    pairs = np.array(
        [by_arm["volumetric", *key[1:]] - value for key, value in by_arm.items() if key[0] == "adc"]
    )
    assert study.effect == pytest.approx(pairs.mean())
    assert study.interval is not None
    assert [("sfm" in note, "dataset" in note) for note in notes] == [(False, True), (True, False)]


def test_trials_of_archives_can_be_chosen(tmp_path, said, refused):
    """One archive may have two initialisers, or two splits, under one name."""
    files = [
        archive(tmp_path, name, seed, inits=("sfm", "random")) for seed, name in enumerate("ab")
    ]
    out = said(*POOL, *files, "--where", "init=sfm")
    assert "of 2 studies" in out
    assert "| a |" in out
    assert out.startswith("volumetric against adc, difference in PSNR (dB), more is better\n")
    assert "caution" not in out
    refused(*POOL, *files, "--where", "init=none")


def test_different_budgets_are_named(tmp_path, said):
    steered = archive(tmp_path, "steered", budget={"max_gaussians": 20_000, "cap": "governor"})
    growing = archive(tmp_path, "growing", seed=1, budget={"max_gaussians": None, "cap": None})
    sentence = "caution: the budgets differ (steered: 20,000 Gaussians (governor); growing: none)"
    assert sentence in said(*POOL, steered, growing)


def test_an_archive_whose_arm_lacks_failed_trials_is_named(tmp_path):
    write_runs(tmp_path)
    (tmp_path / "exp/garden/sfm-volumetric/c0ffee00-seed2/results.json").unlink()
    write_archive(loaded(tmp_path), tmp_path / "a.zip")
    _, notes, _ = read_studies(tmp_path / "a.zip", WANTED, "a")
    assert any("caution, 1 trial of one arm alone failed, stopped" in line for line in notes)


def test_two_protocols_have_no_mean_and_one_can_be_chosen(tmp_path, said):
    """The protocols differ between archives or within one; every study is shown."""
    protocols = {"a": "paper-1", "b": "both", "c": "paper-1"}
    files = [archive(tmp_path, name, k, own) for k, (name, own) in enumerate(protocols.items())]
    out = said(*POOL, *files)
    assert all(name in out for name in ("| a |", "| b (paper-1) |", "| b (standard-1) |", "| c |"))
    assert "no mean: the studies differ in protocol" in out
    out = said(*POOL, *files, "--protocol", "paper-1")
    assert "of 3 studies" in out
    assert "b (standard-1): not asked for" in out


def test_each_bad_source_has_one_line_and_the_others_are_pooled(tmp_path, capsys, refused):
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
    assert "a further one would lie between" in captured.out
    lines = captured.err.splitlines()
    for name, reason in (
        ("cut.zip", "not a complete zip"),
        ("twin.zip", "would count twice"),
        ("other.zip", "has no pair of volumetric and adc (there are sfm-adc, sfm-mcmc)"),
        ("single", "has one pair"),
        ("empty", "it is a folder"),
        ("none.zip", "no such file"),
    ):
        (line,) = [line for line in lines if name in line]
        assert reason in line
    assert len(lines) == 6
    refused(*POOL, cut)


def test_archives_with_the_same_file_name_are_distinguished(tmp_path, said):
    for lab, seed in (("one", 0), ("two", 1)):
        (tmp_path / lab).mkdir()
        archive(tmp_path / lab, "results", seed)
    sources = [tmp_path / f"{lab}/results.zip" for lab in ("one", "two")]
    assert f"| {sources[1]} |" in said(*POOL, *sources)


def test_scenes_of_an_archive_under_other_conditions_are_noted(tmp_path):
    file = archive(tmp_path, "lab")
    runs = tmp_path / "runs_lab_0"
    for path in (runs / "exp/garden").glob("*/*/results.json"):
        change_json(path, iterations=7000)
    write_archive(loaded(runs), file)
    _, notes, _ = read_studies(file, WANTED, "lab")
    assert notes[1:] == [
        "lab: Scenes of sfm-adc and sfm-volumetric differ in more than the scene: iterations (2000 "
        "on courtyard, 7000 on garden)."
    ]


def test_a_name_of_an_arm_must_fit_one_arm_of_each_initialiser():
    """It is a densifier, a densifier with its variant, or the whole name."""
    plain, once, twice = (
        Arm("sfm", "volumetric", variant) for variant in ((), (("n", "1"),), (("n", "2"),))
    )
    adc, other = Arm("sfm", "adc"), Arm("dim", "adc")

    def pairs(*arms, arm="volumetric", baseline="adc"):
        trials = [
            SimpleNamespace(arm=one, init=one.init, config={}, variant=one.variant) for one in arms
        ]
        return _arm_pairs(trials, replace(WANTED, arm=(arm,), baseline=(baseline,)), Path("a.zip"))

    assert pairs(adc, other, plain) == [(adc, plain)]
    assert pairs(adc, other, Arm("dim", "volumetric"), plain)[1] == (adc, plain)
    for name in (str(twice), str(replace(twice, init=""))):
        assert pairs(adc, once, twice, arm=name) == [(adc, twice)]
        assert pairs(adc, once, twice, arm="adc", baseline=name) == [(twice, adc)]
    for names in ({}, {"arm": "adc", "baseline": "volumetric"}):
        with refusal(re.escape(f"the name fits {once} and {twice}: choose")):
            pairs(adc, once, twice, **names)


def test_a_metric_that_a_source_lacks_is_named(tmp_path, refused):
    line = refused(*POOL, archive(tmp_path, "lab"), "--metric", "lpips_alex")
    assert "can be paired in lpips_alex" in line
    assert "--arm" in refused("pool", tmp_path / "lab.zip")
