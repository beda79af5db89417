"""Tuning parity, with trials that take no time: what is declared, searched and chosen for arms."""

import sys
from pathlib import Path

import numpy as np
import pytest

from gsbench import cli
from gsbench.analysis.cells import with_variants
from gsbench.analysis.fairness import fairness_table
from gsbench.analysis.report.build import build_report, search_summary
from gsbench.analysis.results import load_experiment
from gsbench.analysis.tables import build_table
from gsbench.parsing import read_typed
from gsbench.runs.experiments import Arm, TuningRecord
from gsbench.runs.layout import TUNING
from tests.app.stand_ins import Trainings
from tests.helpers import read_json, write
from tests.launch.test_record import TINY

optuna = pytest.importorskip("optuna", reason="needs Optuna (extra search)")

FILE = """\
# @package _global_
name: fair
eval: {primary: psnr}
hydra:
  mode: MULTIRUN
  sweeper:
    params: {seed: "0,1"}
    grids:
      - densify: adc
        densify.gradient_threshold: tag(log, interval(1e-4, 4e-4))
      - densify: volumetric
        densify.volume_threshold: tag(log, interval(1e-3, 1e-1))
        densify.stop: tag(int, interval(300, 500))
    tune: {points: 4}
"""
WORDS = [
    *(word for word in TINY if not word.startswith(("densify=", "seed=", "name="))),
    "+experiment=fair",
]
INTERVAL, TUNE = "tag(log, interval(1e-3, 1e-1))", "hydra.sweeper.tune"
KEYS = {"adc": "gradient_threshold", "volumetric": "volume_threshold"}
BEST = {"adc": 3e-4, "volumetric": 0.01}


class Fake(Trainings):
    """Trainings whose results are best at `BEST`.

    Ctrl-C comes in the trial with the number ``stops``; those with numbers in ``fails`` fail.
    """

    def __init__(self, stops=None, fails=(), metrics=("psnr",)):
        stopped = lambda number, trial: number == stops  # noqa: E731
        super().__init__(self.psnr, stopped, lambda number, trial: number in fails, metrics)

    @staticmethod
    def psnr(values):
        arm = values["densify"]["name"]
        error = abs(np.log(values["densify"][KEYS[arm]] / BEST[arm])) if arm in KEYS else 0.0
        return 26.0 - error + 0.01 * values["seed"]

    @property
    def sizes(self):
        return [len(batch) for batch in self.batches]

    def tuning(self, arm):
        return [
            trial for trial in self.trained if trial.values["name"] == f"fair-tune-random-{arm}"
        ]

    def judged(self):
        return [trial for trial in self.trained if trial.values["name"] == "fair"]


@pytest.fixture
def sweep(runs, tmp_path, monkeypatch):
    def run(fake, *words, file=FILE):
        write(tmp_path / "conf/experiment/fair.yaml", file)
        monkeypatch.setattr("gsbench.app.command.run_batch", fake)
        return cli.run(["--config-dir", str(tmp_path / "conf"), *WORDS, *words])

    return run


def tuning(runs, arm):
    return read_typed(runs / f"fair-tune-random-{arm}/{TUNING}", TuningRecord)


def chosen(runs, arm):
    return dict(tuning(runs, arm).best.settings)


@pytest.mark.slow
def test_each_arm_gets_the_same_points_on_validation_views_and_the_sweep_gets_the_best(sweep, runs):
    fake = Fake()
    assert sweep(fake) == 0
    # a point of both arms at a time, then the sweep as a whole
    assert fake.sizes == [2, 2, 2, 2, 4]
    for arm in ("adc", "volumetric"):
        values = [trial.values for trial in fake.tuning(arm)]
        assert len(values) == 4
        assert all(one["scene"]["validation"] and one["eval"]["primary"] is None for one in values)
        assert {one["seed"] for one in values} == {100}
        points = [one["densify"][KEYS[arm]] for one in values]
        closest = min(points, key=lambda value: abs(np.log(value / BEST[arm])))
        assert chosen(runs, arm)[f"densify.{KEYS[arm]}"] == closest
        own = [trial.values for trial in fake.judged() if trial.values["densify"]["name"] == arm]
        assert [one["seed"] for one in own] == [0, 1]
        assert {one["densify"][KEYS[arm]] for one in own} == {closest}
        assert not any(one["scene"]["validation"] for one in own)
    assert all(isinstance(one.values["densify"]["stop"], int) for one in fake.tuning("volumetric"))
    # the arm's own values are the first point
    assert fake.tuning("adc")[0].values["densify"]["gradient_threshold"] == 0.0002


@pytest.mark.parametrize("stops", [3, 9])  # in the search, and in the sweep
@pytest.mark.slow
def test_a_killed_tuning_continues_and_chooses_the_same_values(
    stops, sweep, runs, tmp_path, monkeypatch
):
    whole = Fake()
    assert sweep(whole) == 0
    expected = [tuning(runs, arm) for arm in KEYS]
    monkeypatch.setenv("GSBENCH_RUNS", str(tmp_path / "again"))
    assert sweep(Fake(stops=stops)) == cli.INTERRUPTED
    rest = Fake()
    assert sweep(rest) == 0
    assert len(rest.trained) == 12 - stops  # nothing is trained twice but the one that was killed
    assert [tuning(tmp_path / "again", arm) for arm in KEYS] == expected
    again = Fake()
    assert sweep(again) == 0
    assert again.sizes == [4]  # the finished points are not launched again


@pytest.mark.parametrize(
    "strange",
    [
        {"tracking.uri": "http://theirs"},
        {"densify.volume_threshold": 7.0},
        {"densify.stop": "${oc.env:HOME}"},
    ],
)
@pytest.mark.slow
def test_settings_added_to_a_record_are_ignored(strange, sweep, runs):
    assert sweep(Fake()) == 0
    file = runs / "fair-tune-random-volumetric/tuning.json"
    record = read_json(file)
    for point in record["points"]:
        point["settings"] |= strange
    write(file, record)
    again = Fake()
    assert sweep(again) == 0
    assert all(trial.values["tracking"]["uri"] is None for trial in again.trained)
    assert strange.items().isdisjoint(chosen(runs, "volumetric").items())


@pytest.mark.slow
def test_seeds_may_be_added_to_a_tuned_sweep_and_it_may_stop_when_decided(sweep, runs):
    assert sweep(Fake(), "launch.stop_when_decided=true", "seed=0,1,2") == 0
    more = Fake()
    assert sweep(more, "launch.stop_when_decided=true", "seed=0,1,2") == 0
    assert not more.trained
    assert sweep(more, "seed=0,1,2,3") == 0
    assert {trial.values["name"] for trial in more.trained} == {"fair"}


@pytest.mark.slow
def test_a_point_is_judged_on_all_scenes_and_seeds_of_the_tuning(sweep, runs):
    fake = Fake()
    words = ["scene.sector=0,1", "scene.split=sector", f"{TUNE}.seed='7,8'", f"{TUNE}.points=2"]
    assert sweep(fake, *words) == 0
    trained = [(one.values["scene"]["sector"], one.values["seed"]) for one in fake.tuning("adc")]
    assert trained == 2 * [(0, 7), (0, 8), (1, 7), (1, 8)]
    value = 26 - np.log(1.5) + 0.075 + 1
    assert tuning(runs, "adc").points[0].value == pytest.approx(value, abs=1e-4)


@pytest.mark.slow
def test_failed_points_count_in_the_budget_and_an_arm_without_a_judged_point_ends_the_sweep(
    sweep, runs, capsys
):
    assert sweep(Fake(fails=[0])) == 1
    first, *rest = (point.value is None for point in tuning(runs, "adc").points)
    assert (first, rest) == (True, 3 * [False])
    mended = Fake()
    assert sweep(mended) == 0
    # it is tried again
    assert mended.tuning("adc")[0].values["densify"]["gradient_threshold"] == 0.0002
    assert all(point.value is not None for point in tuning(runs, "adc").points)
    assert sweep(Fake(fails=[0, 2, 4, 6]), "name=none") == 1
    words = "no point of random-adc has a psnr (gsbench status none-tune-random-adc says why)"
    assert words in capsys.readouterr().err


def test_a_typed_value_replaces_an_interval(sweep, runs):
    fake = Fake()
    assert sweep(fake, "densify.stop=200", f"{TUNE}.points=1") == 0
    assert {one.values["densify"]["stop"] for one in fake.tuning("volumetric")} == {200}
    assert chosen(runs, "volumetric").keys() == {"densify.volume_threshold"}


def test_zero_points_tune_nothing(sweep, runs):
    fake = Fake()
    assert sweep(fake, f"{TUNE}.points=0") == 0
    assert fake.sizes == [4]
    assert not list(runs.glob("*/tuning.json"))


def test_a_dry_run_says_what_will_be_tuned_and_trains_nothing(sweep, runs, capsys):
    assert sweep(Fake(), "--dry-run") == 0
    said = capsys.readouterr().out
    for words in (
        "tunes first: 4 points each for random-adc and random-volumetric, by psnr of validation "
        "views",
        "8 trainings",
        "with the values found, which are not known yet",
    ):
        assert words in said
    assert not runs.exists()


def test_an_interval_searches_one_arm(runs, monkeypatch):
    """A search is the tuning of one arm: its best is trained with the seeds of the command."""
    fake, sampler_settings = Fake(), {}
    sampler = optuna.samplers.TPESampler

    def make_sampler(**settings):
        sampler_settings.update(settings)
        return sampler(**settings)

    monkeypatch.setattr(optuna.samplers, "TPESampler", make_sampler)
    monkeypatch.setattr("gsbench.app.command.run_batch", fake)
    words = ["-m", *WORDS[:-1], "densify=volumetric", "name=fair", "seed=0,1"]
    searched = [f"densify.volume_threshold={INTERVAL}", f"{TUNE}.points=3", f"{TUNE}.at_once=2"]
    assert cli.run([*words, *searched]) == 0
    assert fake.sizes == [2, 1, 2]
    # Points that run together must know of each other, or the sampler may choose one twice.
    assert sampler_settings == {"seed": 0, "constant_liar": True}
    part = search_summary(runs / "fair-tune-random-volumetric")
    assert "no test view was looked at" in part[0]
    assert "failed" not in part[0]
    assert "<svg" in part[1]
    best = chosen(runs, "volumetric")["densify.volume_threshold"]
    assert {trial.values["densify"]["volume_threshold"] for trial in fake.judged()} == {best}


@pytest.mark.slow
def test_a_users_metric_is_optimised_in_the_direction_of_its_class(sweep, runs, monkeypatch):
    monkeypatch.setattr(sys, "path", list(sys.path))
    text = "class Mine:\n    direction = -1\n    def measure(self, *given): ...\n"
    Path("own_measure.py").write_text(text)
    own = ["eval.extra.mine._target_=own_measure.Mine", "allow_targets=[own_measure]"]
    words = [*own, "eval.primary=mine", f"{TUNE}.points=2"]
    assert sweep(Fake(metrics=("psnr", "mine")), *words) == 0
    search = tuning(runs, "adc")
    assert search.direction == -1
    assert search.best == min(search.points, key=lambda point: point.value or 0.0)


# --- what is printed


def notes(runs, *words):
    trials = with_variants(load_experiment(runs, "fair").trials)
    table = fairness_table(trials, Arm("random", "adc"), Arm("random", "volumetric"))
    return [note for note in table.notes if note.startswith("Tuning.")]


UNEVEN = FILE.replace("        densify.gradient_threshold: tag(log, interval(1e-4, 4e-4))\n", "")
SENTENCE = (
    "They were not tuned alike: random-adc none and random-volumetric 4 points of 1 seed "
    "on validation views."
)


@pytest.mark.slow
def test_unequal_tuning_is_stated_in_headline_and_tables(sweep, runs):
    assert sweep(Fake(), file=UNEVEN) == 0
    lines = notes(runs)
    assert f"Tuning. {SENTENCE}" in lines
    experiment = load_experiment(runs, "fair")
    page = build_report(experiment)
    order = '<span class="name">random-volumetric', SENTENCE, "<summary>Fairness"
    places = [page.index(part) for part in order]
    assert places == sorted(places)
    assert any(SENTENCE in note for note in build_table(experiment).notes)


# --- bad input

MISTAKES = [
    (FILE, f"{TUNE}.point=3", "did you mean points?"),
    (FILE, f"{TUNE}.seed='1,2'", "tune.seed: 1 is a seed of the sweep, too"),
    (FILE, f"{TUNE}.seed=one", "must list whole numbers"),
    (FILE, "scene.validation=true", "leave scene.validation out"),
    (FILE, "launch.wait=false", "launch.wait must be true"),
    (
        f"{FILE[: FILE.index('    tune')]}      - "
        f"{{densify: adc, densify.gradient_threshold: 0.1}}\n",
        "",
        "leave one of",
    ),
    (FILE.replace("densify.stop", "scene.max_size"), "", "belongs to what all arms share"),
    (FILE.replace("densify.stop", "seed"), "", "belongs to what all arms share"),
    (FILE.replace(INTERVAL, "tag(log, interval(0, 1e-1))"), "", "an interval begins above 0"),
    (FILE.replace(INTERVAL, "interval(1e-3"), "", "densify.volume_threshold"),
]


@pytest.mark.parametrize("file, word, part", MISTAKES)
def test_mistakes_are_one_line_before_any_work(file, word, part, sweep, runs, capsys):
    fake = Fake()
    assert sweep(fake, *([word] if word else []), file=file) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert part in line
    assert not fake.batches
    assert not runs.exists()
