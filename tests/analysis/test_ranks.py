"""Arms ranked over scenes: critical values, Friedman's test, groups, and what is left out."""

import re
from collections.abc import Callable

import numpy as np
import pytest
from scipy import stats

from gsbench.analysis.quantities import quantity
from gsbench.analysis.ranks import Ranking, critical_difference, rank_arms
from gsbench.analysis.report.build import build_report
from gsbench.analysis.report.charts import rank_plot
from gsbench.analysis.results import Experiment
from gsbench.analysis.sentences import p_text
from gsbench.claims.export import write_archive
from gsbench.cli import run
from gsbench.runs.experiments import Arm

SCENES = tuple("abcdefg")
ARMS = ("adc", "mcmc", "volumetric")
Make = Callable[..., Experiment]


@pytest.fixture
def seven(make_experiment):
    return make_experiment(
        scenes=SCENES, densifiers=ARMS, effect={"psnr": 2.0, "lpips_vgg_raw": -0.1}
    )


@pytest.mark.parametrize(
    "arms, q", [(2, 1.960), (3, 2.343), (4, 2.569), (5, 2.728), (6, 2.850), (10, 3.164)]
)
def test_the_critical_values_are_those_of_demsar(arms, q):
    """Demšar 2006, table 5a."""
    assert critical_difference(arms, 14) == pytest.approx(
        q * np.sqrt(arms * (arms + 1) / (6 * 14)), rel=5e-4
    )


@pytest.mark.parametrize("metric", ["psnr", "lpips_vgg_raw"])
def test_the_best_arm_has_rank_one(seven, metric):
    ranking = rank_arms(seven.trials, quantity(metric, seven.trials))
    assert (ranking.arms[0], ranking.ranks[0]) == (Arm("sfm", "volumetric"), 1.0)
    means = {
        arm: [
            np.mean([t.metrics[metric] for t in seven.trials if (t.scene, t.densify) == (s, arm)])
            for s in SCENES
        ]
        for arm in ARMS
    }
    assert ranking.p == pytest.approx(stats.friedmanchisquare(*means.values()).pvalue)
    assert sum(ranking.ranks) == pytest.approx(6)


def test_groups_are_the_largest_that_do_not_differ():
    assert ranked((1.0, 1.8, 2.7, 4.0, 5.5)).groups == [(0, 1), (1, 2)]
    assert ranked((1.0, 1.1, 1.2, 1.3, 5.0)).groups == [(0, 3)]
    assert ranked((1.0, 2.0, 3.0, 4.0, 5.0), critical=0.9).groups == []


def ranked(ranks, names="abcde", critical=1.2):
    arms = tuple(Arm("sfm", name) for name in names)
    return Ranking(quantity("psnr", []), arms, ranks, SCENES, critical, None)


@pytest.mark.parametrize(
    "plan",
    [{"scenes": SCENES[:5], "densifiers": ARMS}, {"scenes": SCENES, "densifiers": ("adc",)}],
    ids=["five scenes", "one arm"],
)
def test_few_scenes_or_arms_have_no_ranking(make_experiment, plan):
    experiment = make_experiment(**plan)
    assert rank_arms(experiment.trials, quantity("psnr", experiment.trials)) is None
    assert "Ranks of all arms" not in build_report(experiment)


def test_two_arms_have_a_ranking_without_friedmans_test(make_experiment):
    experiment = make_experiment(scenes=SCENES, effect={"psnr": 9.0})
    ranking = rank_arms(experiment.trials, quantity("psnr", experiment.trials))
    assert (ranking.ranks, ranking.p) == ((1.0, 2.0), None)
    assert ranking.critical == critical_difference(2, 7)


def test_a_scene_that_lacks_an_arm_is_left_out(seven):
    trials = [trial for trial in seven.trials if (trial.scene, trial.densify) != ("c", "mcmc")]
    ranking = rank_arms(trials, quantity("psnr", trials))
    assert ranking.scenes == ("a", "b", "d", "e", "f", "g")
    two = [trial for trial in trials if (trial.scene, trial.densify) != ("d", "adc")]
    assert rank_arms(two, quantity("psnr", two)) is None


def test_equal_arms_do_not_differ(make_experiment):
    noises = ("trial_noise", "residual_noise", "effect_noise", "scene_noise")
    plan = {"scenes": SCENES, "densifiers": ARMS} | dict.fromkeys(noises, 0.0)
    experiment = make_experiment(**plan)
    ranking = rank_arms(experiment.trials, quantity("psnr", experiment.trials))
    assert set(ranking.ranks) == {2.0}
    assert ranking.p == 1.0
    assert ranking.groups == [(0, 2)]


def test_report_and_site_have_the_plot_of_ranks(seven, tmp_path):
    write_archive(seven, tmp_path / "exp.zip")
    assert run(["site", str(tmp_path / "exp.zip"), "--out", str(tmp_path / "site")]) == 0
    for page in (build_report(seven), (tmp_path / "site/index.html").read_text()):
        assert page.count("ranks over 7 scenes</figcaption>") == 4  # PSNR, SSIM, LPIPS, FLIP
    ranking = rank_arms(seven.trials, quantity("psnr", seven.trials))
    svg = rank_plot(ranking)
    assert f"CD {critical_difference(3, 7):.2f}" in svg
    assert f"that no arm differs: p {p_text(ranking.p)}.</p>" in svg


def numbers(pattern, text):
    found = re.findall(pattern.replace("#", r'"([\d.]+)"'), text)
    return [[float(number) for number in np.atleast_1d(one)] for one in found]


def test_a_rank_plot_puts_arms_ranks_and_groups_where_they_belong():
    """Five arms with names of five letters: the scale is from 20 + 5 x 6.6 px to 380 - 30 px."""
    ranks = (1.0, 1.8, 2.7, 4.0, 4.5)
    svg = rank_plot(ranked(ranks))
    assert 'viewBox="0 0 401.0 204.0"' in svg
    step, rows = 297 / 4, [57, 83, 109, 135, 161]
    assert numbers("<circle cx=# cy=#", svg) == [
        [pytest.approx(53 + step * (rank - 1), abs=0.06), row]
        for rank, row in zip(ranks, rows, strict=True)
    ]
    assert numbers('"group" x1=# x2=# y1=# y2=#', svg) == [
        [364, 364, 51, 89],
        [373, 373, 77, 115],
        [382, 382, 129, 167],
    ]
    grid = numbers('"grid" x1=# x2=# y1=# y2=#', svg)
    assert grid == [[pytest.approx(53 + step * k, abs=0.06)] * 2 + [44, 174] for k in range(5)]
    assert numbers('"axis" x1=# x2=# y1=# y2=#', svg)[0] == [
        53,
        pytest.approx(53 + 1.2 * step, abs=0.06),
        12,
        12,
    ]
    assert "sfm-a 1.00, sfm-b 1.80, " in svg
    assert "Not different: sfm-a to sfm-b; sfm-b to sfm-c; sfm-d to sfm-e." in svg
    assert "Friedman" not in svg
    # Long names leave at least 160 px to the scale.
    svg = rank_plot(ranked((1.0, 2.0), ("x" * 50, "y" * 49), 0.5))
    assert [x for x, _ in numbers("<circle cx=# cy=#", svg)] == pytest.approx([376.4, 536.4])
    assert "Not different: none." in svg
