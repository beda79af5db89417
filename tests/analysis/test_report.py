"""The report: one page that needs no other file, with the verdict first, usable by everybody."""

import base64
import html
import io
import itertools
import math
import re
import xml.etree.ElementTree as ElementTree
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from gsbench.analysis.images import choose_views, jpeg_uri, read_compared, texture_energy
from gsbench.analysis.pairs import Pairs, pair_trials
from gsbench.analysis.quantities import quantity
from gsbench.analysis.report.build import _forest, build_report, search_summary
from gsbench.analysis.report.charts import (
    Axis,
    forest_color,
    forest_plot,
    line_chart,
    short_number,
)
from gsbench.analysis.report.curves import (
    event_table,
    mean_by_step,
)
from gsbench.analysis.results import load_experiment
from gsbench.analysis.statistics import Interval
from tests.analysis.helpers import ADC, VOLUMETRIC, loaded, page_of, rows_of, trials_of
from tests.analysis.tables import TABLES
from tests.helpers import write
from tests.markup import Page
from tests.trials import ask_about, search_record, write_arms, write_runs, write_trial

ONE_TRIAL = {"scenes": ("a",), "seeds": (0,), "pictures": True}


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Two scenes with pictures, in which "volumetric" differs only by a clearly better LPIPS."""
    folder = tmp_path_factory.mktemp("runs")
    write_runs(folder, effect={"lpips_vgg_raw": -0.05}, views=3, pictures=True, random_seed=1)
    ask_about(folder, metric="lpips_vgg_raw")
    return folder


@pytest.fixture(scope="module")
def experiment(runs):
    return loaded(runs)


@pytest.fixture(scope="module")
def page(experiment):
    return build_report(experiment)


def test_the_page_is_well_formed_and_needs_no_other_file(page):
    elements = Page(page)
    assert elements.open == []
    for tag, attribute in (("img", "src"), ("link", "href"), ("script", "src"), ("iframe", "src")):
        assert all(
            (attrs.get(attribute) or "data:").startswith("data:") for attrs in elements.all(tag)
        )
    assert not re.search(r"url\(|@import|https?://|fetch\(|XMLHttp", page)


def test_the_page_suits_screen_readers_and_keyboards(page):
    elements = Page(page)
    assert elements.all("html") == [{"lang": "en"}]
    assert all(attrs.get("alt") for attrs in elements.all("img"))
    pictures = [attrs for attrs in elements.all("svg") if attrs.get("aria-hidden") != "true"]
    assert len(pictures) > 8
    assert all(attrs.get("role") == "img" and attrs.get("aria-label") for attrs in pictures)
    assert all(
        attrs.get("tabindex") == "0"
        for attrs in elements.all("div")
        if attrs.get("class") == "scroll"
    )
    anchors = {attrs["href"].removeprefix("#") for attrs in elements.all("a")}
    ids = [attrs["id"] for _, attrs in elements.elements if "id" in attrs]
    assert anchors <= set(ids)
    assert len(ids) == len(set(ids))


def test_the_verdict_comes_first(page):
    headings = re.findall(r"<h2[^>]*>([^<]+)", page)
    assert headings[:2] == ["Verdict", "Tables"]
    row = page.split("<summary>")[1].split("</summary>")[0]
    assert '<span class="badge better">BETTER</span>' in row
    assert "sfm-volumetric" in row
    assert re.search(r"LPIPS VGG raw −0\.\d+ \(95 % interval −", row)
    assert "sfm-volumetric against sfm-adc: better in LPIPS VGG raw on these scenes: −" in page
    metrics = page.split('aria-label="Metrics, ')[1].split("</table>")[0]
    assert metrics.count("not tested") == 3
    assert "LPIPS VGG raw" in metrics.split("</tr>")[1]
    assert "LPIPS Alex" not in metrics  # not run: no row


def test_each_idea_has_a_row_and_its_details_are_folded(tmp_path):
    write_runs(tmp_path, densifiers=("adc", "mcmc", "volumetric"), views=3)
    ask_about(tmp_path, lambda trial: trial.densify != "mcmc")
    page = Page(page_of(tmp_path))
    ideas = [attrs for attrs in page.all("details") if attrs.get("class") == "idea"]
    assert [("open" in attrs) for attrs in ideas] == [False, False]
    badges = re.findall(r'<span class="badge ?([a-z]*)">([^<]*)<', page_of(tmp_path))
    assert sorted(badges) == [("", "NOT ASKED"), ("", "UNDECIDED")]


def test_unequal_counts_and_training_times_are_stated_beside_the_verdict(page):
    """The arms have other counts, and equal trials other times."""
    headline = re.search(r'<div class="inside">\s*<p>([^<]*)</p>', page)
    assert re.search(
        r"Unequal numbers of Gaussians: sfm-volumetric \d+ % more than sfm-adc",
        headline[1],
    )


def test_the_same_files_give_the_same_page(experiment, page):
    assert build_report(experiment) == page


def test_every_trial_is_traceable(experiment, page):
    assert all(trial.label in page for trial in experiment.trials)
    assert "pycolmap 4.2.1" in page


def test_texture_energy_is_the_squared_gradient():
    ramp = np.repeat(np.arange(40, dtype=np.uint8)[None, :, None] * 3, 30, axis=0).repeat(3, axis=2)
    energy = texture_energy(ramp)  # a slope of 3 levels a pixel everywhere
    assert energy[15, 20] == pytest.approx(9.0)
    assert texture_energy(np.full((9, 9, 3), 7, dtype=np.uint8)).max() == 0


def test_the_views_with_the_least_median_and_largest_gain_are_shown(experiment):
    """The scene has three views, so each is chosen, in the order of gains."""
    trials = [trial for trial in experiment.trials if trial.scene == "garden"]
    first, second = (
        next(t.path for t in trials if (t.arm, t.seed) == (arm, 0)) for arm in (ADC, VOLUMETRIC)
    )
    folders = (first / "renders", second / "renders", first / "ground_truth")
    gains = {}
    for view in ("view000", "view001", "view002"):
        one, other, truth = (
            np.asarray(Image.open(folder / f"{view}.png")).astype(float) for folder in folders
        )
        gains[view] = np.abs(one - truth).mean() - np.abs(other - truth).mean()
    views, faults = choose_views(pair_trials(trials, ADC, VOLUMETRIC))
    assert [view.view for view in views] == sorted(gains, key=lambda view: gains[view])
    assert [view.first_error - view.second_error for view in views] == pytest.approx(
        sorted(gains.values())
    )
    assert all(view.truth.startswith("data:image/jpeg;base64,") for view in views)
    assert faults == []
    # The difference is red where the second arm is worse, as here by 20 levels of 32, else blue.
    picture = Image.open(io.BytesIO(base64.b64decode(views[0].difference.partition(",")[2])))
    shown = np.asarray(picture).astype(float)
    red = 255 + 20 / 32 * np.subtract((178, 24, 43), 255)
    assert np.abs(shown[4:36, 4:36] - red).mean() < 6
    assert (shown[80:, 100:, 2] - shown[80:, 100:, 0]).mean() > 5
    assert shown.max() > 250  # white: both are equally wrong
    both, _ = choose_views(pair_trials(experiment.trials, ADC, VOLUMETRIC))
    assert len(both) == 3


def test_one_or_two_views_are_each_shown_once(tmp_path):
    for count, named in (
        (1, ["the view with the largest gain"]),
        (2, ["the view with the least gain", "the view with the largest gain"]),
    ):
        write_runs(tmp_path / str(count), **ONE_TRIAL, views=count)
        views, _ = choose_views(pair_trials(trials_of(tmp_path / str(count)), ADC, VOLUMETRIC))
        assert [view.which for view in views] == named
        assert sorted(view.view for view in views) == [f"view00{k}" for k in range(count)]


def test_ignored_pixels_are_shown_as_stripes_of_four_pixels(tmp_path):
    for path in write_runs(tmp_path, **ONE_TRIAL, views=1):
        (path / "masks").mkdir()
        mask = np.full((120, 160), 255, np.uint8)
        mask[:20, :20] = 0
        Image.fromarray(mask).save(path / "masks/view000.png")
    one, other = trials_of(tmp_path)
    shown = read_compared(one, other, "view000")
    for image in shown:
        assert image[0, :12, 0].tolist() == [110] * 4 + [150] * 4 + [110] * 4
        assert image[3, :8].tolist() == [[110] * 3] + [[150] * 3] * 4 + [[110] * 3] * 3
        assert (image[:20, :20] == shown[0][:20, :20]).all()
    for image, name in zip(shown, ("renders", "renders", "ground_truth"), strict=True):
        own = other if image is shown[1] else one
        stored = np.asarray(Image.open(own.path / f"{name}/view000.png"))
        assert (image[20:] == stored[20:]).all()


def test_missing_or_damaged_pictures_are_named(tmp_path):
    paths = write_runs(tmp_path, views=2, pictures=True)
    (paths[0] / "renders/view001.png").write_bytes(b"\x89PNG\r\n\x1a\nhalf")
    assert "view001.png: not a readable image" in page_of(tmp_path)


def test_growth_and_pruning_by_cause_are_shown_in_a_table(page):
    events = page.split("<caption>Gaussians by cause, mean of a trial</caption>")[1].split(
        "</table>"
    )[0]
    assert '<th scope="row">split volume</th><td>0</td><td>100</td>' in events


def test_a_cause_that_an_arm_did_not_log_counts_as_zero_and_one_that_none_logged_has_no_row():
    trials = [
        SimpleNamespace(arm=arm, record=SimpleNamespace(events=events))
        for arm, events in (
            (ADC, {"cloned": 4, "pruned_size": 0}),
            (ADC, {"cloned": 2008}),
            (VOLUMETRIC, {"split_volume": 3}),
        )
    ]
    rows = rows_of(event_table(trials, [ADC, VOLUMETRIC]))
    assert rows == {"cloned": ["1,006", "0"], "split volume": ["0", "3"]}
    trials[0].record.events = {}
    assert event_table(trials[:1], [ADC]) is None


def test_mean_curves_use_common_steps():
    assert mean_by_step([[(1, 2.0), (2, 4.0), (3, 9.0)], [(2, 6.0), (1, 0.0)], []]) == [
        (1, 1.0),
        (2, 5.0),
    ]


def row_of(label, mean, interval=None):
    """A row of a forest plot."""
    return label, mean, 3, interval


CHARTS = {
    "lines": lambda title: line_chart(
        title, [("a", [(1, 1), (10, 5)]), ("b", [(2, 3)])], "x", "y", log_x=True
    ),
    "flat": lambda title: line_chart(title, [("a", [(5, 1), (5, 1)])], "x", "y", level=(5, "z")),
    "forest": lambda title: forest_plot(
        title, [row_of("s", 0.1, Interval(-0.1, 0.3)), row_of("t", 0.2)], "d", 1
    ),
}


@pytest.mark.parametrize("chart", list(CHARTS))
def test_charts_are_well_formed_and_stay_inside(chart):
    svg = next(ElementTree.fromstring(CHARTS[chart]("<&>")).iter("svg"))
    _, _, width, height = map(float, svg.attrib["viewBox"].split())
    limits = dict.fromkeys(("x", "cx", "x1"), width) | dict.fromkeys(("y", "cy", "y1"), height)
    for element in svg.iter():
        for name, limit in limits.items():
            assert 0 <= float(element.attrib.get(name, 0)) <= limit
    assert svg.attrib["aria-label"].startswith("<&>")


@pytest.mark.parametrize("log", [False, True])
@pytest.mark.parametrize(
    "values",
    [(2, 5), (3, 3), (0.3, 40), (1e-9, 1e9), (0.011, 0.012), (7000, 30000), (99.5, 101), (1, 1e6)],
)
def test_an_axis_has_round_ticks_within_its_range(values, log):
    """The range goes a little beyond the values.

    A logarithmic axis that does not contain two decades has ticks at its ends and in the
    middle.
    """
    axis = Axis(values, log, 100.0, 300.0)
    places = [axis.to_px(tick) for tick in axis.ticks]
    assert 2 <= len(places) <= 12
    assert places == sorted(set(places))
    assert 100 - 1e-9 <= places[0] < places[-1] <= 300 + 1e-9
    ends = sorted(axis.to_px(value) for value in values)
    assert ends == pytest.approx(
        [200, 200] if values[0] == values[1] else [100 + 200 / 27, 300 - 200 / 27]
    )
    assert len({axis.label(tick) for tick in axis.ticks}) == len(places)
    decades = [math.log10(tick) for tick in axis.ticks] if log else []
    if not log:
        step = axis.ticks[1] - axis.ticks[0]
        assert np.diff(axis.ticks) == pytest.approx(step)
        steps = np.divide(axis.ticks, step)
        assert steps == pytest.approx(steps.round())
    elif decades != [round(decade) for decade in decades]:
        assert places == pytest.approx([100, 200, 300])


def test_a_forest_plot_has_at_least_two_ticks_for_any_range():
    """A range of -0.09 to 0.09 once had only one, at zero."""
    for reach in (0.0886, 0.09, 0.11, 1.0, 3.3, 940.0):
        assert len(Axis([-reach, reach], False, 0.0, 1.0, ticks=3).ticks) >= 2, reach


@pytest.mark.parametrize(
    "values, log, ticks, labels",
    [
        ((2, 5), False, [2, 3, 4, 5], "2 3 4 5"),
        ((0, 10), False, [0, 2.5, 5, 7.5, 10], "0.0 2.5 5.0 7.5 10.0"),
        ((-3, 3), False, [-2, 0, 2], "−2 0 2"),
        ((7000, 30000), False, np.arange(10_000, 30_001, 5000), "10k 15k 20k 25k 30k"),
        ((0.3, 40), True, [1, 10], "1 10"),
        ((1, 1e6), True, [1, 100, 1e4, 1e6], "1 100 10k 1M"),
    ],
)
def test_ticks_are_at_round_values_with_matching_labels(values, log, ticks, labels):
    axis = Axis(values, log, 0.0, 100.0)
    assert axis.ticks == pytest.approx(ticks)
    assert " ".join(map(axis.label, axis.ticks)) == labels


@pytest.mark.parametrize(
    "value, text",
    TABLES["short numbers"],
)
def test_a_short_number_has_three_digits(value, text):
    assert short_number(value) == text


def test_a_row_of_a_forest_plot_has_the_colour_of_its_verdict():
    green, red, grey = "#1b7837", "#b2182b", "#555555"
    up, down = (0.2, Interval(0.1, 0.3)), (-0.2, Interval(-0.3, -0.1))
    colors = [forest_color(*row, side) for row in (up, down) for side in (1, -1)]
    assert colors == [green, red, red, green]
    for interval in (None, Interval(-0.1, 0.5)):
        assert forest_color(0.2, interval, 1) == grey


@pytest.mark.parametrize(
    "key, better", [("psnr", "right of zero is better"), ("flip", "left of zero is better")]
)
def test_a_forest_plot_of_a_verdict_has_its_scenes_and_from_two_on_their_mean(key, better):
    scenes = [row_of(name, mean) for name, mean in (("a", 0.5), ("b", -0.25))]
    one, two = (
        _forest(
            SimpleNamespace(
                scenes=own, mean=0.125, interval=None, quantity=quantity(key, []), pairs=Pairs(())
            )
        )
        for own in (scenes[:1], scenes)
    )
    assert f"{quantity(key, []).name}: {better}" in one
    assert "a 0.5." in one
    assert "a 0.5; b −0.25; mean of scenes 0.125." in two


def test_a_chart_with_nothing_to_draw_is_an_empty_string():
    assert line_chart("t", [("a", [])], "x", "y") == ""
    assert forest_plot("t", [], "x", 1) == ""


def test_one_trial_of_each_arm_gives_no_verdict(tmp_path):
    write_runs(tmp_path, seeds=(0,), scenes=("garden",), effect={"psnr": 9.0})
    page = page_of(tmp_path)
    assert ">garden</text>" in page
    assert "mean of scenes" not in page
    assert "NOT ASKED" in page
    assert "one pair of trainings has no interval" in page


def test_a_report_on_a_table_of_the_paper_compares_with_its_numbers(tmp_path):
    write_runs(tmp_path, experiment="table1", inits=("dim",), scenes=("garden",))
    page = build_report(load_experiment(tmp_path, "table1"))
    assert "Table 1, difference from the printed values" in page
    assert "What the paper's own numbers say" in html.unescape(page)


def test_costs_are_listed_under_the_verdict(page):
    """Means: 20,010 and 26,010 Gaussians; 51.025 and 66.025 s.

    Seeds 0 to 2 add as many seconds.
    """
    costs = page.split('aria-label="Costs and scenes">')[1].split("</ul>")[0]
    assert "<li>Gaussians +30.0% as a ratio of totals, +30.0% as the mean of 2 scenes</li>" in costs
    times = "+29.4% as a ratio of totals, +29.4% as the mean of 2 scenes"
    assert f"<li>Training time {times}; times of equal trials differ by up to 4%</li>" in costs
    assert "mean of scenes</text>" in page


def test_a_wide_picture_is_shown_smaller():
    uri = jpeg_uri(np.zeros((10, 2400, 3), dtype=np.uint8))
    with Image.open(io.BytesIO(base64.b64decode(uri.partition(",")[2]))) as shown:
        assert shown.size == (1200, 5)


def test_a_single_arm_and_bare_results_still_make_a_report(tmp_path):
    for path in write_runs(tmp_path, densifiers=("adc",), seeds=(0,), scenes=("garden",)):
        for name in ("events.jsonl", "metrics.jsonl", "config.yaml"):
            (path / name).unlink()
    text = page_of(tmp_path)
    assert "Only one arm was run" in text


def test_arms_that_never_differ_are_called_equal_and_not_undecided(tmp_path):
    for densify in ("adc", "mine"):
        for seed in range(3):
            write_trial(tmp_path, seed, densify=densify, psnr=20.0 + seed)
    ask_about(tmp_path)
    page = page_of(tmp_path)
    assert "had no effect" in page
    assert '<span class="number">PSNR (dB) +0.000 in each of 3 pairs of trainings</span>' in page
    assert "PSNR (dB): right of zero is better" in page  # it has its scenes, too


def test_a_metric_of_a_region_that_a_question_names_has_its_scenes(tmp_path):
    for densify, seed in itertools.product(("adc", "mine"), range(2)):
        values = {"psnr": 20.0 + seed, "ssim@far": 0.5 + seed / 7}
        write_trial(tmp_path, seed, densify=densify, _num_gaussians=seed, **values)
    ask_about(tmp_path, metric="ssim@far")
    ask_about(tmp_path)
    assert "SSIM far: right of zero is better" in page_of(tmp_path)


def test_points_of_a_search_are_not_compared(tmp_path):
    write_runs(tmp_path)
    assert "Metrics, " in page_of(tmp_path)
    points = [{"value": 27.5, "settings": {"densify.volume_threshold": 0.6841}}]
    write(tmp_path / "exp/tuning.json", search_record(points))
    page = page_of(tmp_path)
    assert "Metrics, " not in page
    assert "so there is no verdict" in page
    assert "densify.volume_threshold = 0.6841 (point 1)" in page


def test_a_search_is_summed_up_in_a_line_and_a_chart(tmp_path):
    def summary(*values):
        points = [{"value": value, "settings": {"a.b": k}} for k, value in enumerate(values)]
        write(tmp_path / "tuning.json", search_record(points))
        return search_summary(tmp_path)

    assert search_summary(tmp_path) is None
    line, chart = summary(27.5, None, 27.8763)
    assert line == (
        "Best PSNR (dB): 27.876 at a.b = 2 (point 3). 3 of 2 points, each 1 seed; 1 failed. "
        "Judged by validation views; no test view was looked at."
    )
    assert "each point from 27.5 at 1 to 27.9 at 3." in chart
    assert summary(27.5)[0].endswith(
        "(point 1). 1 of 2 points, each 1 seed. Judged by validation views; no test view was "
        "looked at."
    )
    assert summary(None) == ("1 of 2 points, each 1 seed; 1 failed; none has a result yet.", "")


def test_a_sweep_over_a_setting_has_a_chart_with_its_baseline(tmp_path):
    write_arms(tmp_path, {"adc": {}})
    for number, value in enumerate((0.01, 0.1, 1.0), 1):
        for seed in range(3):
            write_trial(
                tmp_path,
                seed,
                f"{number:08x}",
                {"densify": {"name": "mine", "growth": value}},
                scene="courtyard",
                densify="mine",
                psnr=20 + value + seed / 10,
            )
    page = page_of(tmp_path)
    title = "sfm-mine: PSNR (dB) by densify.growth"
    assert page.count(f"<figcaption>{title}</figcaption>") == 1
    chart = page.split(f"<figcaption>{title}</figcaption>")[1].split("</svg>")[0]
    assert ">sfm-adc</text>" in chart  # the baseline's line
    assert chart.count('<line class="axis"') == 3  # an interval for each value


def test_a_wide_interval_of_one_scene_does_not_stretch_the_axis():
    rows = [row_of(f"s{k}", 0.1, Interval(-0.1, 0.3)) for k in range(3)]
    wide = forest_plot("t", [*rows, row_of("wide", 0.1, Interval(-9.0, 9.2))], "d", 1)
    lines = re.findall(r'<line x1="([\d.]+)" x2="([\d.]+)"', wide)
    own, cut = (float(b) - float(a) for a, b in (lines[0], lines[-1]))
    assert 1 < cut / own < 6
    assert "wide 0.1, interval −9 to 9.2" in wide  # the words have it whole
