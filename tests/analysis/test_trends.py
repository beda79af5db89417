"""The trend of a difference: against polyfit, SciPy's t tests and the plain words of the definition."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from gsbench.analysis.quantities import quantity
from gsbench.analysis.results import load_experiment
from gsbench.analysis.trends import Trend, trend
from gsbench.claims.archive import write_archive
from gsbench.errors import InputError
from gsbench.verbs import trend as verb
from tests.analysis.synthetic import Plan, trial_data, write_trial

SIZES = (120, 160, 320, 480)
SCENES, SEEDS = ("a", "b"), (0, 1, 2)


def write_sizes(runs: Path, sizes: tuple[float, ...] = SIZES, random_seed: int = 0, **changes: object) -> np.ndarray:
    """Write trials of two arms at each size; returns the differences in PSNR [scenes, seeds, sizes]."""
    rng = np.random.default_rng(random_seed)
    differences = rng.normal(0.5, 0.3, (len(SCENES), len(SEEDS), len(sizes)))
    for s, scene in enumerate(SCENES):
        for seed in SEEDS:
            for k, size in enumerate(sizes):
                for arm, value in (("adc", 26.0), ("volumetric", 26.0 + differences[s, seed, k])):
                    plan = Plan(experiment="exp")
                    data = trial_data(plan, scene, "sfm", arm, seed, {"psnr": np.full(2, value)}) | changes
                    settings = {"scene__max_size": size}
                    write_trial(runs, data, {"psnr": np.full(2, value)}, f"{k:08x}", **settings)
    return differences


def holm(p_values: list[float]) -> list[float]:
    """Holm (1979), step by step: p of rank k, from 0, times the number of those that are not smaller."""
    ranked = sorted(p_values)
    return [min(1.0, max((len(ranked) - k) * q for k, q in enumerate(ranked) if q <= p)) for p in p_values]


def found(runs: Path, **changes: str) -> Trend:
    trials = load_experiment(runs, "exp").trials
    return trend(trials, "adc", "volumetric", "scene.max_size", quantity("psnr", trials), **changes)


def test_slope_bend_and_line_are_those_of_polyfit(tmp_path: Path) -> None:
    differences = write_sizes(tmp_path)
    doublings = np.log2(SIZES)
    result = found(tmp_path)
    slopes = [np.polyfit(doublings, pair, 1)[0] for scene in differences for pair in scene]
    bends = [2 * np.polyfit(doublings, pair, 2)[0] for scene in differences for pair in scene]
    assert result.doubling.mean == pytest.approx(np.mean(slopes))
    assert result.bend.mean == pytest.approx(np.mean(bends))
    for answer, values in ((result.doubling, slopes), (result.bend, bends)):
        test = stats.ttest_1samp(values, 0)
        assert answer.p == pytest.approx(test.pvalue)
        interval = test.confidence_interval(0.95)
        assert (answer.interval.low, answer.interval.high) == pytest.approx((interval.low, interval.high))
    assert result.line == pytest.approx(np.polyval(np.polyfit(doublings, differences.mean(axis=(0, 1)), 1), doublings))
    assert result.pairs == 6


def test_differences_and_changes_to_the_largest(tmp_path: Path) -> None:
    differences = write_sizes(tmp_path)
    result = found(tmp_path)
    assert [step.value for step in result.steps] == list(SIZES)
    p_values = [stats.ttest_1samp(differences[..., k].ravel(), 0).pvalue for k in range(len(SIZES))]
    adjusted = holm(p_values)
    for k, step in enumerate(result.steps):
        assert step.difference.mean == pytest.approx(differences[..., k].mean())
        assert step.difference.p == pytest.approx(adjusted[k])
        assert dict(step.by_scene) == pytest.approx(dict(zip(SCENES, differences[..., k].mean(axis=1), strict=True)))
        signs = np.sign(differences.mean(axis=1))
        assert step.same_sign == (signs[:, k] == signs[:, -1]).sum()
    assert result.steps[-1].to_largest is None
    moved = result.steps[0].to_largest
    assert moved.mean == pytest.approx((differences[..., -1] - differences[..., 0]).mean())
    changes = [stats.ttest_1samp((differences[..., -1] - differences[..., k]).ravel(), 0).pvalue for k in range(3)]
    assert moved.p == pytest.approx(holm(changes)[0])


def test_false_slopes_are_as_rare_as_they_should_be() -> None:
    from gsbench.analysis.trends import _fit

    rng = np.random.default_rng(3)
    values, few = np.array(SIZES, float), 0
    for _ in range(2000):
        matrices = [rng.normal(0.4, 1, (2, len(SIZES))) for _ in range(3)]  # three scenes, two seeds, no trend
        few += _fit(values, ["a", "b", "c"], matrices, ()).doubling.p < 0.05
    assert stats.binomtest(few, 2000, 0.05).pvalue > 1e-3


def test_pairs_that_lack_a_value_are_left_out_and_named(tmp_path: Path) -> None:
    write_sizes(tmp_path)
    (tmp_path / "exp" / "b" / "sfm-adc" / "00000001-seed2" / "results.json").unlink()
    result = found(tmp_path)
    assert result.pairs == 5
    assert result.left_out == tuple(
        f"scene.max_size={size}: b, seed 2, since other values lack it" for size in SIZES if size != 160
    )


@pytest.mark.parametrize(
    ("sizes", "message"),
    [((120, 160), r"2 values here \(120, 160\)"), ((0, 120, 160), "is 0"), (("big", 120, 160), "is 'big'")],
)
def test_what_is_no_line_is_refused(tmp_path: Path, sizes: tuple[float, ...], message: str) -> None:
    write_sizes(tmp_path, sizes)
    with pytest.raises(InputError, match=message):
        found(tmp_path)


def test_another_setting_that_varies_is_refused(tmp_path: Path) -> None:
    write_sizes(tmp_path)
    plan = Plan(experiment="exp")
    for arm in ("adc", "volumetric"):
        data = trial_data(plan, "a", "sfm", arm, 5, {"psnr": np.full(2, 20.0)}) | {"iterations": 7}
        write_trial(tmp_path, data, {"psnr": np.full(2, 20.0)}, "ffffffff", scene__max_size=120)
    with pytest.raises(InputError, match=r"train\.iterations|iterations"):
        found(tmp_path)


def test_the_verb_says_it_of_folders_and_archives_alike(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_sizes(tmp_path)
    words = ["--along", "scene.max_size", "--arm", "volumetric", "--where", "iterations=2000"]
    assert verb.main(["exp", *words, "--out", str(tmp_path / "page.html")], tmp_path) == 0
    out = capsys.readouterr().out
    assert re.search(r"\| 480 \| [+−]\d\.\d+ \([+−]", out)
    assert "6 pairs of scene and seed on 2 scenes" in out
    page = (tmp_path / "page.html").read_text()
    assert page.count("<polyline") == 4  # the mean, the line, two scenes
    assert page.count('stroke-width="1.5"') == len(SIZES)
    write_archive(load_experiment(tmp_path, "exp"), tmp_path / "exp.zip")
    assert verb.main([str(tmp_path / "exp.zip"), *words], tmp_path) == 0
    assert capsys.readouterr().out == out.removesuffix(f"{tmp_path / 'page.html'}\n")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--arm", "volumetrik"], "no scene and seed"),
        (["--arm", "volumetric", "--metric", "psn"], "unknown metric"),
        (["--arm", "volumetric", "--where", "iterations"], "KEY=VALUE"),
        (["--arm", "volumetric", "--where", "iterations=3"], "no trial has"),
        (["--arm", "volumetric", "--init", "dim"], "0 values"),
        (["--arm", "adc"], "against itself"),
        (["--arm", "volumetric", "--along", "scene.max_sise"], "no trial has a setting"),
        (["--arm", "volumetric", "--along", "iterations"], r"1 value here \(2000\)"),
    ],
)
def test_bad_input_is_refused(tmp_path: Path, words: list[str], message: str) -> None:
    write_sizes(tmp_path)
    with pytest.raises(InputError, match=message):
        verb.main(["exp", "--along", "scene.max_size", *words], tmp_path)
