"""One question, one answer: what was done before or beside an arm never changes its verdict."""

import html
import itertools
import os
import random
import shutil
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsbench.analysis.attempts import share_of_version
from gsbench.analysis.comparison import compare
from gsbench.analysis.looks import look_levels, plan_looks
from gsbench.analysis.notes import texts
from gsbench.analysis.quantities import quantity
from gsbench.analysis.results import load_all_trials
from gsbench.analysis.statistics import t_test
from gsbench.analysis.verdict_words import sentence
from gsbench.claims.archive import unpack_archive
from gsbench.claims.export import write_archive
from gsbench.claims.site import write_site
from gsbench.claims.stopping import log_verdicts
from gsbench.launch.record import remove
from gsbench.runs.experiments import Arm, Declaration, Question, open_question, record_text
from gsbench.runs.seen import remember
from gsbench.runs.trial_folder import TrialFolder
from gsbench.tracking.comparison import description
from gsbench.verbs.plan import plan
from gsbench.verbs.results import explain_cell, tables
from tests.analysis.helpers import loaded, page_of, table_of, write_declared
from tests.conftest import script
from tests.helpers import change_json, read_json, refusal
from tests.helpers import write as write_file
from tests.trials import write_trial

OLD, NEW = "1" * 64, "2" * 64
EXAMPLES = int(os.environ.get("GSBENCH_EXAMPLES", "0"))  # of random experiments


@dataclass(frozen=True)
class Made:
    """A made-up trial: arm, place, day of January 2026, version of the user's code."""

    densify: str
    options: tuple[tuple[str, Any], ...] = ()
    init: str = "sfm"
    scene: str = "a"
    seed: int = 0
    day: int = 2
    code: str = ""

    @property
    def hash(self):
        return sha256(repr((self.options, self.code)).encode()).hexdigest()[:8]

    @property
    def key(self):
        return f"{self.scene}/{self.init}-{self.densify}/{self.hash}"

    def results(self, runs):
        return runs / f"exp/{self.key}-seed{self.seed}/results.json"


def write(runs, trials, experiment="exp"):
    for one in trials:
        rng = random.Random(repr(one))
        path = write_trial(
            runs,
            one.seed,
            one.hash,
            {f"densify.{name}": value for name, value in one.options},
            experiment=experiment,
            scene=one.scene,
            init=one.init,
            densify=one.densify,
            **{metric: 20.0 + rng.gauss(0, 0.1) for metric in ("psnr", "ssim")},
            _measured=midnight(one.day),
            _code={"sources": {"mine": one.code} if one.code else {}, "stages": {"train": 2}},
        )
        moment = 1_767_225_600 + 86_400 * one.day
        os.utime(path / "results.json", (moment, moment))


def midnight(day):
    return f"2026-01-{day:02d}T00:00:00Z"


def on_day(day, trials, metric="psnr"):
    """A command's declaration of a metric with these trials {key: seeds}."""
    return Declaration(time=midnight(day), questions=(open_question(metric),), trials=trials)


def declare(runs, *records, metric="psnr"):
    """Write a declaration for each (day, trials of the command); each repeats those before."""
    entries, trials = [], dict[str, set[int]]()
    for day, made in records:
        for one in made:
            trials.setdefault(one.key, set()).add(one.seed)
        named = {key: tuple(sorted(seeds)) for key, seeds in trials.items()}
        entries.append(on_day(day, named, metric))
    write_declared(runs, *entries)


def grid(densify, seeds=3, day=2, code="", **options):
    named = tuple(options.items())
    return [Made(densify, named, seed=seed, day=day, code=code) for seed in range(seeds)]


def answer(runs, *baseline):
    return compare(loaded(runs), *baseline)


def remarks(runs):
    return texts(answer(runs).remarks)


def against(comparison):
    return [(str(second), str(first)) for first, second in comparison.pairs]


# ---- the ways in which people work


def test_an_arm_stays_compared_when_another_is_added(tmp_path):
    write(tmp_path, [*grid("adc"), *grid("momentum", decay=0.9), *grid("momentum", decay=0.99)])
    before = answer(tmp_path)
    write(tmp_path, grid("absgs", day=3))
    after = answer(tmp_path)
    assert against(before) == [
        ("sfm-momentum[decay=0.9]", "sfm-adc"),
        ("sfm-momentum[decay=0.99]", "sfm-adc"),
    ]
    assert against(after) == [("sfm-absgs", "sfm-adc"), *against(before)]
    assert set(before.sentences) < set(after.sentences)
    rows = [row.labels[3] for row in table_of(tmp_path).rows]
    assert rows == ["–", "–", "0.9", "0.99"]  # adc and absgs have no such setting
    assert "decay=0.9" in explain_cell("exp:a:psnr:momentum[decay=0.9]", tmp_path)


def test_arms_that_one_command_added_share_the_adjustment_and_are_named(tmp_path):
    day_1, day_2 = grid("momentum", decay=0.9), [*grid("absgs", day=5), *grid("mine", day=5)]
    write(tmp_path, [*grid("adc"), *day_1, *day_2])
    declare(tmp_path, (1, [*grid("adc"), *day_1]), (4, day_2))
    found = {str(one.second): sentence(one) for one in answer(tmp_path).answers}
    for arm in ("sfm-absgs", "sfm-mine"):
        assert "adjusted for 2 tests, of sfm-absgs, sfm-mine)" in found[arm]
    assert "adjusted" not in found["sfm-momentum"]


def in_looks(*pairs, scenes="a"):
    """A sweep in looks, declared before all trials, with (baseline, arm) as lists of trials."""

    def keys(trials, scene):
        return replace(trials[0], scene=scene).key

    questions = [
        Question(
            metric="psnr",
            sign=1,
            least=0.1,
            baseline=Arm("sfm", first[0].densify),
            arm=Arm("sfm", second[0].densify),
            scenes={scene: (keys(first, scene), keys(second, scene)) for scene in scenes},
            seeds=(0, 1, 2),
        )
        for first, second in pairs
    ]
    return Declaration(time=midnight(1), questions=tuple(questions), looks=(2, 3))


def declare_looks(runs, *pairs, **scenes):
    write_declared(runs, in_looks(*pairs, **scenes))


def test_the_baseline_that_a_sweep_in_looks_declared_stays_it_if_another_arm_ended_first(tmp_path):
    first, second = grid("absgs", day=3), grid("mine", day=2)
    write(tmp_path, [*first, *second])
    declare_looks(tmp_path, (first, second))
    found = answer(tmp_path)
    assert against(found) == [("sfm-mine", "sfm-absgs")]
    assert "of at most 3 seeds. The metric was declared beforehand." in found.sentences[0]


@pytest.mark.parametrize(
    "days, seeds, doubt",
    [
        ((4,), 3, "only after 3 trials of the arm had been measured"),
        ((1, 6), 5, "4 trials were added after the arm's first result"),
    ],
)
def test_an_exploratory_question_of_a_sweep_in_looks_counts_the_looks(tmp_path, days, seeds, doubt):
    both = [
        [replace(one, day=2 + 5 * (one.seed > 2)) for one in grid(name, seeds)]
        for name in ("adc", "mine")
    ]
    write(tmp_path, [*both[0], *both[1]])
    plans = []
    for day, most in zip(days, (3, 5), strict=False):
        plan = replace(in_looks(both), time=midnight(day), looks=plan_looks(most))
        (asked,) = plan.questions
        plans.append(replace(plan, questions=(replace(asked, seeds=tuple(range(most))),)))
    write_declared(tmp_path, *plans)
    (found,) = answer(tmp_path).answers
    assert found.standing.doubt == doubt
    for one in found.verdicts:  # two metrics share 5 %
        levels = dict(zip(plan_looks(seeds), look_levels(1, plan_looks(seeds), 0.025), strict=True))
        assert one.answer.rate == levels[one.pairs.seeds]
    assert "adjusted for their number (2) and for the planned looks." in sentence(found)
    assert "with equal shares of 5 % at each look" in page_of(tmp_path)


def test_a_sweep_in_looks_gets_no_verdict_that_it_did_not_declare(tmp_path):
    """It stopped by the verdicts on its own pairs, so no other pair of its arms can be tested."""
    low, high, mine = grid("adc", cap=1), grid("adc", cap=2), grid("mine", lr=3)
    write(tmp_path, [*low, *high, *mine])
    declare_looks(tmp_path, (low, mine), (high, mine))
    pairs = [("sfm-mine", "sfm-adc[cap=1]"), ("sfm-mine", "sfm-adc[cap=2]")]
    assert against(answer(tmp_path)) == pairs
    declare_looks(tmp_path, (low, high), (low, mine), (high, mine))
    assert against(answer(tmp_path)) == [*pairs, BOTH_CAPS]


BOTH_CAPS = ("sfm-adc[cap=2]", "sfm-adc[cap=1]")
ADC_CAPS = [grid("adc", cap=cap) for cap in (1, 2)]


@pytest.mark.parametrize("missing", [["adc", "mine"], ["mine"]], ids=["not begun", "failed"])
def test_a_look_waits_for_every_scene(tmp_path, missing):
    """The scenes that have finished are not judged by themselves, as if there were no looks."""
    first, second = grid("adc"), grid("mine")
    there = [replace(one, scene="b") for one in [*first, *second] if one.densify not in missing]
    write(tmp_path, [*first, *second, *there])
    declare_looks(tmp_path, (first, second), scenes="ab")
    found = answer(tmp_path)
    words = "sfm-mine against sfm-adc: no verdict yet, not all of the first 2 seeds are there"
    assert found.sentences[0].startswith(words)
    assert "(a look waits for all of its trials)" in texts(found.unused)[0]
    assert found.answers[0].verdicts[0].question.seeds == (0, 1, 2)


def test_another_metric_declared_for_a_later_arm_keeps_the_verdict_on_an_earlier_one(tmp_path):
    early, late = [*grid("adc"), *grid("mine")], grid("more", day=6)
    write(tmp_path, early)
    first = on_day(1, {one.key: (0, 1, 2) for one in early})
    second = on_day(5, {one.key: (0, 1, 2) for one in [*early, *late]}, "ssim")
    write_declared(tmp_path, first)
    (before,) = answer(tmp_path).sentences
    write(tmp_path, late)
    write_declared(tmp_path, first, second)
    found = answer(tmp_path)
    kept, other = found.sentences
    assert kept == before
    assert "undecided in SSIM" in other
    assert other.endswith("The metric was declared beforehand.")
    said = texts(found.declared_notes)
    assert [line.partition(" (eval")[0] for line in said] == [
        "PSNR (dB) was declared beforehand",
        "SSIM was declared beforehand",
    ]


@pytest.mark.parametrize("looks", [False, True])
def test_a_baseline_that_is_chosen_later_declares_no_other_pairs(tmp_path, looks):
    first, second, third = (grid(name) for name in ("adc", "mine", "more"))
    trials = [*first, *second, *third]
    write(tmp_path, trials)
    declare(tmp_path, (1, trials))
    if looks:
        declare_looks(tmp_path, (first, second), (first, third))
    found = answer(tmp_path, "mine")
    stated = {(str(one.second), str(one.first)): one for one in found.answers}
    assert not stated["sfm-more", "sfm-mine"].beforehand
    assert "but not for this pair of arms" in sentence(stated["sfm-more", "sfm-mine"])
    turned = stated[("sfm-mine", "sfm-adc") if looks else ("sfm-adc", "sfm-mine")]
    assert turned.beforehand


@pytest.mark.parametrize("case", ["three arms", "edited", "late", "late baseline"])
def test_a_question_that_is_turned_has_the_same_answer(tmp_path, case):
    """``report --baseline`` may be chosen by what was seen."""
    days = {"late": (4, 2), "late baseline": (2, 4)}.get(case, (4, 4))
    adc, mine = (grid(name, 4, day) for name, day in zip(("adc", "mine"), days, strict=True))
    others = {
        "three arms": grid("more", 4, 4),
        "edited": [replace(one, code=OLD) for one in mine],
    }.get(case, [])
    mine = [replace(one, code=NEW, day=5) for one in mine] if case == "edited" else mine
    trials = [*adc, *mine, *others]
    write(tmp_path, trials)
    declare(tmp_path, (3, trials))
    (asked, *_), (turned, *_) = answer(tmp_path).answers, answer(tmp_path, "mine").answers
    assert (asked.first, asked.second) == (turned.second, turned.first)
    assert (asked.beforehand, asked.versions) == (turned.beforehand, turned.versions)
    for one, other in zip(asked.verdicts, turned.verdicts, strict=True):
        assert other.mean == pytest.approx(-one.mean)
        assert other.p == pytest.approx(one.p)
        assert (other.answer.level, other.family) == (one.answer.level, one.family)


def gain(runs, trials, by=5.0):
    """Raise the PSNR of trials of one view."""
    for one in trials:
        file = one.results(runs)
        metrics = read_json(file)["metrics"]
        old = metrics["psnr"]
        change_json(file, metrics=metrics | {"psnr": old + by})
        views = file.with_name("per_view.csv")
        views.write_text(views.read_text().replace(repr(old), repr(old + by)))


def test_seeds_added_to_one_arm_leave_the_others_their_family(tmp_path):
    adc, mine, third = (grid(name) for name in ("adc", "mine", "more"))
    trials = [*adc, *mine, *third]
    write(tmp_path, trials)
    declare(tmp_path, (1, trials))
    before = answer(tmp_path).sentences
    assert "adjusted for 2 tests" in before[1]
    more = [replace(one, seed=3, day=6) for one in (adc[0], mine[0])]
    write(tmp_path, more)
    declare(tmp_path, (1, trials), (5, more))
    after = answer(tmp_path).sentences
    assert "2 trials were added" in after[0]
    assert after[1] == before[1]


def drop_psnr(runs, made):
    file = made.results(runs)
    moment, metrics = file.stat().st_mtime, read_json(file)["metrics"]
    del metrics["psnr"]
    change_json(file, metrics=metrics, unavailable={"psnr": "it is not a number"})
    os.utime(file, (moment, moment))


@pytest.mark.parametrize("declared", [False, True])
def test_an_arm_gains_nothing_by_a_trial_without_a_value(tmp_path, declared):
    """It counts as a failed one, and every surface names it."""
    adc, mine = grid("adc", seeds=4), grid("mine", seeds=4)
    write(tmp_path, [*adc, *mine])
    gain(tmp_path, mine)
    if declared:
        declare(tmp_path, (1, [*adc, *mine]))
    assert "better in PSNR" in answer(tmp_path).sentences[0]
    drop_psnr(tmp_path, mine[1])
    found = answer(tmp_path)
    (verdict,) = [one for one in found.answers[0].verdicts if one.question.metric == "psnr"]
    assert verdict.favours_lacking
    assert (
        "1 trial of one arm alone failed, stopped, went missing or gave no value"
        in found.sentences[0]
    )
    line = "PSNR (dB): a seed 1 not compared: it is not a number"
    left_out = found.to_json()["left_out"]
    for told in (remarks(tmp_path), left_out, table_of(tmp_path).notes, page_of(tmp_path)):
        assert line in told
    for one in (mine[0], mine[2], mine[3]):
        drop_psnr(tmp_path, one)
    assert "PSNR (dB): sfm-mine not compared: it is not a number" in remarks(tmp_path)


@pytest.mark.parametrize("swept", [False, True])
@pytest.mark.parametrize("gone", ["adc", "mine", "adc mine"])
def test_no_arm_gains_by_declared_trials_whose_folders_are_gone(tmp_path, gone, swept):
    """Whoever deletes failed trials, or stops a sweep between two, does not help an arm."""
    arms = {"adc": grid("adc", seeds=4), "mine": grid("mine", seeds=4, decay=1)}
    trials = [*arms["adc"], *arms["mine"], *(grid("mine", seeds=4, decay=2) if swept else [])]
    write(tmp_path, trials)
    declare(tmp_path, (1, trials))
    names = gone.split()
    gain(tmp_path, arms[names[0]])
    for name in names:
        shutil.rmtree(arms[name][3].results(tmp_path).parent)
    verdict = answer(tmp_path).answers[0].verdicts[0]
    assert (bool(verdict.lacking), verdict.favours_lacking) == (len(names) == 1,) * 2


def test_a_failed_trial_without_settings_may_be_of_any_arm_that_lacks_it(tmp_path):
    adc, mine, other = grid("adc"), grid("mine", decay=1), grid("mine", decay=2)
    write(tmp_path, [*adc, *mine, *other])
    gain(tmp_path, [*mine, *other])
    mine[2].results(tmp_path).unlink()
    write_file(mine[2].results(tmp_path).with_name("config.yaml"), "")
    lacking, whole = answer(tmp_path).answers
    assert lacking.verdicts[0].favours_lacking
    assert not whole.verdicts[0].lacking
    assert whole.verdicts[0].outcome == "supported"


@pytest.mark.parametrize("seconds, answered", [(60.0, True), (None, False)])
def test_trainings_that_a_time_limit_ended_are_compared(tmp_path, seconds, answered):
    """Each ends at another iteration; without a limit that is another training."""
    trials = [*grid("adc"), *grid("mine")]
    write(tmp_path, trials)
    for number, one in enumerate(trials):
        budget = {"max_gaussians": None, "cap": None, "seconds": seconds}
        change_json(one.results(tmp_path), iterations=1000 + number, budget=budget)
    assert bool(answer(tmp_path).answers[0].verdicts) == answered
    with refusal(None if answered else "would average trials that differ in iterations"):
        page_of(tmp_path)


def test_a_metric_without_a_direction_is_named(tmp_path):
    trials = [*grid("adc"), *grid("mine")]
    write(tmp_path, trials)
    for one in trials:
        change_json(one.results(tmp_path), metrics={"psnr": 20.0, "fancy": 1.0})
    line = "fancy: in no verdict, unknown whether higher is better: set `direction` in the metric's"
    assert line in remarks(tmp_path)[0]
    declare(tmp_path, (1, trials), metric="fancy")
    assert "the declared metric fancy has no direction (unknown" in answer(tmp_path).sentences[0]


@pytest.mark.parametrize(
    "arms, pairs",
    [
        # the settings that both have decide
        ([*ADC_CAPS, grid("mine", cap=2, lr=3)], [("sfm-mine", "sfm-adc[cap=2]"), BOTH_CAPS]),
        ([ADC_CAPS[0], grid("mine", cap=2)], [("sfm-mine", "sfm-adc")]),
        # the older one is the baseline, and of initialisers the paper's
        ([grid("adc", cap=2), grid("adc", day=3, cap=1)], [BOTH_CAPS[::-1]]),
        (
            [grid("adc"), [replace(one, init="random", day=3) for one in grid("adc")]],
            [("random-adc", "sfm-adc")],
        ),
        (
            [*ADC_CAPS, grid("mine", cap=4)],
            [("sfm-mine", "sfm-adc[cap=1]"), ("sfm-mine", "sfm-adc[cap=2]"), BOTH_CAPS],
        ),
        # without a baseline: an external trainer swept over an option, and no densification
        (
            [grid("brush", grow=1), grid("brush", grow=2), grid("none")],
            [("sfm-brush[grow=2]", "sfm-brush[grow=1]"), ("sfm-none", "sfm-brush[grow=1]")],
        ),
    ],
)
def test_every_arm_is_compared_by_the_settings_that_both_have(tmp_path, arms, pairs):
    write(tmp_path, itertools.chain(*arms))
    assert against(answer(tmp_path)) == pairs


def test_an_arm_without_a_baseline_is_named_everywhere(tmp_path, capsys):
    alone = [replace(one, init="random") for one in grid("mine")]
    write(tmp_path, [*grid("adc"), *grid("mine"), *alone])
    reason = "random-mine is not compared: there is no random-adc."
    experiment = loaded(tmp_path)
    assert texts(answer(tmp_path).unused) == [reason]
    plan(["exp"], tmp_path)
    tables(["exp", "--format", "json"], tmp_path)
    said = capsys.readouterr().out
    assert said.count(reason) == 2
    write_archive(experiment, tmp_path / "exp.zip")
    write_site([tmp_path / "exp.zip"], tmp_path / "site", "title", tmp_path / "scratch")
    site = (tmp_path / "site/index.html").read_text()
    notes = "\n".join(table_of(tmp_path).notes)
    for text in (page_of(tmp_path), site, description(experiment), notes):
        assert reason in text


@pytest.mark.parametrize(
    "records, trials, doubt",
    [
        # an idea, the day after the baseline, each by its own command with eval.primary
        ([(1, "adc"), (5, "mine")], {"adc": 2, "mine": 6}, ""),
        # the baseline was not declared at all
        ([(5, "mine")], {"adc": 2, "mine": 6}, ""),
        # a further arm after the result of another
        ([(1, "adc mine"), (5, "more")], {"adc": 2, "mine": 2, "more": 6}, ""),
        ([(5, "adc mine")], {"adc": 2, "mine": 2}, "only after 3 trials of the arm"),
        # further seeds, of the arm or of both
        ([(1, "adc mine"), (5, "adc+ mine+")], {"adc+": 6, "mine": 2, "mine+": 6}, "2 trials"),
        # further seeds of the baseline, which the arm had from the start
        (
            [(1, "adc mine mine+"), (5, "adc+")],
            {"adc": 2, "adc+": 6, "mine+": 2},
            "1 trial was added",
        ),
        # a further seed of the baseline alone makes no pair
        ([(1, "adc mine"), (5, "adc+")], {"adc+": 6, "mine": 2}, ""),
    ],
)
def test_a_question_is_declared_if_it_was_fixed_before_the_first_trial_of_its_arm(
    tmp_path, records, trials, doubt
):
    def made(name, day):
        own = grid(name.rstrip("+"), seeds=4, day=day)
        return own[3:] if name.endswith("+") else own[:3]

    for name, day in trials.items():
        write(tmp_path, made(name, day))
        if name.endswith("+") and name.rstrip("+") not in trials:
            write(tmp_path, made(name.rstrip("+"), 2))
    declare(
        tmp_path,
        *((day, [t for name in names.split() for t in made(name, 2)]) for day, names in records),
    )
    found = {one.second.densify: one for one in answer(tmp_path).answers}
    standing = found["mine"].standing
    assert standing.doubt.startswith(doubt)
    assert standing.beforehand == (not doubt)
    assert sentence(found["mine"]).endswith("The metric was declared beforehand.") == (not doubt)


def test_repaired_code_leaves_no_declared_trial_missing_for_ever(tmp_path):
    adc, old, new = (grid("adc"), grid("mine", code=OLD, lr=1), grid("mine", day=6, code=NEW, lr=1))
    write(tmp_path, [*adc, *old[:1], *new])
    declare(tmp_path, (1, [*adc, *old]), (5, new))
    found = answer(tmp_path)
    assert found.answers[0].beforehand
    assert "missing" not in "\n".join(texts(found.declared_notes))
    assert "made by earlier versions of mine" in found.experiment.warnings[0]
    # the old code failed before any result: its folder has settings, but no results
    old[0].results(tmp_path).unlink()
    assert "missing" not in "\n".join(texts(answer(tmp_path).declared_notes))


def test_the_end_of_a_sweep_names_trials_of_earlier_code(tmp_path, caplog):
    write(tmp_path, [*grid("adc"), *grid("mine", code=OLD), *grid("mine", day=6, code=NEW)])
    caplog.set_level("INFO", "gsbench")
    log_verdicts([SimpleNamespace(files=SimpleNamespace(home=tmp_path / "exp"))])
    assert "3 trials of sfm-mine made by earlier versions of mine" in caplog.messages[-1]


def forget(runs):
    """Remove the trials of earlier code, as ``status --forget-superseded`` does."""
    older = loaded(runs).older
    remove(runs / "exp", [trial.path for trial in older])
    return len(older)


def test_forgotten_trials_of_earlier_code_still_count_as_seen(tmp_path):
    adc, momentum = grid("adc"), grid("momentum")
    old, new = grid("mine", code=OLD), grid("mine", day=6, code=NEW)
    failed = Made("mine", (), seed=0, code="3" * 64)
    write(tmp_path, [*adc, *momentum, *old, *new, failed])
    (tmp_path / f"exp/{failed.key}-seed0/results.json").unlink()
    declare(tmp_path, (1, [*adc, *momentum, *old, failed]), (5, new))
    before = answer(tmp_path)
    assert "2 versions of the arm's code" in before.sentences[0]
    assert forget(tmp_path) == 3
    remove(tmp_path / "exp", [tmp_path / f"exp/{failed.key}-seed0"])
    after = answer(tmp_path)
    assert after.experiment.warnings == ()
    assert after.sentences == before.sentences
    assert "missing" not in "\n".join(table_of(tmp_path).notes)
    write_archive(load_all_trials(tmp_path, "exp"), tmp_path / "exp.zip")
    there = compare(unpack_archive(tmp_path / "exp.zip", tmp_path / "back"))
    assert there.sentences == before.sentences
    # the old code came back, and was forgotten again
    write(tmp_path, old)
    assert answer(tmp_path).sentences == before.sentences
    assert forget(tmp_path) == 3
    assert answer(tmp_path).sentences == before.sentences


@pytest.mark.parametrize(
    "there, named",
    [
        (grid("mine", code=OLD), True),
        (grid("mine", code=OLD, lr=1), True),  # other settings
        (grid("mine", code=NEW), False),  # as with equal counts under another name
        ([replace(one, seed=one.seed + 5) for one in grid("mine", code=OLD)], False),
        ([replace(one, scene="b") for one in grid("mine", code=OLD)], False),
        (grid("other", code=OLD), False),
    ],
)
def test_other_code_on_the_same_seeds_under_another_name_is_named_everywhere(
    tmp_path, there, named
):
    write(tmp_path, [*grid("adc"), *grid("mine", code=NEW)])
    write(tmp_path, there, "tried")
    found = answer(tmp_path)
    line = "Also measured by other code on these scenes and seeds: sfm-mine, in tried."
    for text in (
        "\n".join(texts(found.remarks)),
        "\n".join(table_of(tmp_path).notes),
        page_of(tmp_path),
        description(found.experiment),
        found.to_json()["left_out"][0] if named else "",
    ):
        assert (line in text) == named


@pytest.mark.parametrize("looks", [False, True])
def test_a_capture_under_two_names_is_one_scene(tmp_path, looks):
    first, second = grid("adc"), grid("mine")
    trials = [*first, *second]
    write(tmp_path, [*trials, *(replace(one, scene="b") for one in trials)])
    if looks:
        declare_looks(tmp_path, (first, second), scenes="ab")
    before = answer(tmp_path).answers[0].verdicts[0]
    for file in (tmp_path / "exp/b").glob("*/*/results.json"):
        change_json(file, hashes=read_json(file)["hashes"] | {"data": "data-a"})
    found = answer(tmp_path)
    verdict, note = found.answers[0].verdicts[0], "b has the photographs of a, so it is no further"
    assert note in "\n".join(texts(found.remarks)) + found.sentences[0]
    assert len(before.pairs.rows) == 2
    assert (verdict.untestable is not None) == looks
    assert looks or verdict.pairs.scenes == ("a",)


def test_a_seed_that_only_one_of_two_verdicts_uses_is_named(tmp_path):
    write(tmp_path, [*grid("adc"), *grid("mine"), *grid("more", seeds=2)])
    line = "which other verdicts and tables use: sfm-more against sfm-adc."
    assert line in "\n".join(texts(answer(tmp_path).remarks))


@pytest.mark.parametrize("differs", [False, True])
def test_settings_without_an_effect_are_named(tmp_path, differs):
    arms = [grid("momentum", decay=decay) for decay in (0.9, 0.99)]
    write(tmp_path, [*grid("adc"), *arms[0]])
    for one in arms[0]:
        here = tmp_path / f"exp/{one.key}-seed{one.seed}"
        copied = here.with_name(f"{arms[1][0].hash}-seed{one.seed}")
        shutil.copytree(here, copied)
        change_json(
            copied / "config.yaml",
            densify=read_json(here / "config.yaml")["densify"] | {"decay": 0.99},
        )
    if differs:
        gain(tmp_path, arms[1][:1])
    note = "scene and seed: sfm-momentum[decay=0.9] and sfm-momentum[decay=0.99]."
    said = "\n".join(texts(answer(tmp_path).remarks))
    assert (note in said) != differs


def test_what_old_code_showed_before_the_declaration_was_seen(tmp_path):
    write(tmp_path, [*grid("adc"), *grid("mine", code=OLD), *grid("mine", day=6, code=NEW)])
    declare(tmp_path, (5, [*grid("adc"), *grid("mine", code=NEW)]))
    assert not answer(tmp_path).answers[0].beforehand


def fail(runs, made):
    """Make the folder of a trial that failed."""
    config = {"densify": {"name": made.densify} | dict(made.options)}
    write_file(made.results(runs).with_name("config.yaml"), config)


def test_an_archive_gives_the_same_answers(tmp_path):
    """Trials that failed and trials of earlier code matter for them."""
    adc, idea, lost = grid("adc", 4), grid("idea", day=6), grid("lost", 4, day=6)
    old, new = grid("mine", code=OLD), grid("mine", code=NEW, day=6)
    trials = [*adc, *idea, *lost[:3], *old, *new]
    write(tmp_path, trials)
    gain(tmp_path, lost[:3])
    fail(tmp_path, lost[3])
    declare(tmp_path, (5, [*adc, *idea, *lost, *new]))
    here = answer(tmp_path)
    assert [one.second.densify for one in here.answers if not one.beforehand] == ["mine"]
    assert "1 trial of one arm alone failed" in here.sentences[1]
    file = tmp_path / "exp.zip"
    write_archive(load_all_trials(tmp_path, "exp"), file)
    there = compare(unpack_archive(file, tmp_path / "back"))
    assert there.sentences == here.sentences
    assert texts(there.remarks) == texts(here.remarks)
    assert "made by earlier versions of mine" in there.to_json()["left_out"][-1]


def test_each_version_of_the_code_on_the_same_seeds_has_a_smaller_error_rate(tmp_path):
    adc, momentum = grid("adc"), grid("momentum")
    first, second, third = (
        grid("mine", day=day, code=digit * 64) for digit, day in (("1", 2), ("2", 5), ("3", 7))
    )
    write(tmp_path, [*adc, *momentum, *first])
    declare(tmp_path, (1, [*adc, *momentum, *first]))
    before = {one.second.densify: one for one in answer(tmp_path).answers}
    write(tmp_path, [*second, *third])
    declare(tmp_path, (1, [*adc, *momentum, *first]), (4, second), (6, third))
    after = {one.second.densify: one for one in answer(tmp_path).answers}
    # the other arm of the first command is still adjusted for two
    assert sentence(after["momentum"]) == sentence(before["momentum"])
    assert "adjusted for 2 tests" in sentence(after["momentum"])
    assert after["mine"].beforehand
    assert [after["mine"].primary[0].answer.rate, before["mine"].versions] == [0.05 / 6, 1]
    assert sentence(after["mine"]).endswith(
        "3 versions of the arm's code were measured on these seeds, so the error rate is 0.83 % "
        "(with other seeds under another name: 5 %)."
    )
    # however often the code is edited, the chance of a false "better" stays half of two rates
    assert sum(map(share_of_version, range(1, 999))) < 2
    # of seeds that only the newest code was trained on, nothing was seen
    for one in (*adc, *third):
        shutil.rmtree(one.results(tmp_path).parent)
    write(tmp_path, [replace(one, seed=one.seed + 7) for one in (*adc, *third)])
    assert {one.second.densify: one.versions for one in answer(tmp_path).answers}["mine"] == 1


EDITED = {"mine": ({"sources": {"mine": OLD}}, {"sources": {"mine": NEW}})}
EDITED |= {"gsbench": ({"packages": {"densify": "released"}}, {"packages": {"densify": "e" * 16}})}
UPDATED = ({"stages": {"train": 2}}, {"stages": {"train": 3}})


@pytest.mark.parametrize(
    "codes, same_bits, versions",
    [
        (EDITED["mine"], False, 2),  # chosen by its results, although the baseline has it too
        (EDITED["gsbench"], False, 2),
        (EDITED["gsbench"], True, 1),  # showed nothing new
        (UPDATED, False, 1),
    ],
)
def test_an_edit_of_any_code_is_a_version_and_an_update_is_none(
    tmp_path, codes, same_bits, versions
):
    for number, code in enumerate(codes):
        for one in (*grid("adc"), *grid("mine")):
            equal = {"metrics": {"psnr": 20.0 + one.seed + (one.densify == "adc") ** one.seed}}
            made = replace(one, code=f"{number}", day=2 + 3 * number)
            keep(tmp_path, [made], **{"code": code} | (equal if same_bits else {}))
    (found,) = answer(tmp_path).answers
    assert found.versions == versions
    assert ("versions of the arm's code" in sentence(found)) == (versions > 1)
    (told,) = answer(tmp_path).to_json()["pairs"]
    assert told["versions"] == versions
    rates = {one["error_rate"] for one in told["verdicts"]}
    assert rates == {0.05 * share_of_version(versions)}


def keep(runs, trials, arm="", **changes):
    """Write trials as a run does, which also records that they were seen.

    ``arm`` is the hash of what the arm is made of, ``changes`` are of ``results.json``.
    """
    write(runs, trials)
    for one in trials:
        file = one.results(runs)
        moment, hashes = file.stat().st_mtime, read_json(file)["hashes"] | {"arm": arm}
        change_json(file, **{"hashes": hashes} | changes)
        os.utime(file, (moment, moment))
        remember(runs / "exp", TrialFolder(file.parent).record())


def removed(runs, trials):
    for one in trials:
        shutil.rmtree(one.results(runs).parent)


HIDDEN = {
    "renamed": lambda runs, old: grid("better", code=NEW, day=5),
    "removed": lambda runs, old: removed(runs, old) or grid("mine", code=NEW, day=5),
    "both": lambda runs, old: removed(runs, old) or grid("better", code=NEW, day=5),
    "all removed": lambda runs, old: shutil.rmtree(runs / "exp") or grid("mine", code=NEW, day=5),
    # as after an edit of gsbench's source, which is not in the folder's name
    "overwritten": lambda runs, old: removed(runs, old) or [replace(one, day=5) for one in old],
    "another scene's name": lambda runs, old: [
        replace(one, scene="z") for one in grid("better", code=NEW, day=5)
    ],
}


@pytest.mark.parametrize("hide", HIDDEN)
def test_an_earlier_version_counts_however_it_was_hidden(tmp_path, hide):
    adc, old = grid("adc"), grid("mine", code=OLD)
    keep(tmp_path, adc)
    keep(tmp_path, old, arm="a", code={"sources": {"mine": OLD}})
    declare(tmp_path, (1, [*adc, *old]))
    before = answer(tmp_path).sentences
    new = HIDDEN[hide](tmp_path, old)
    of_scene = [replace(one, scene=new[0].scene) for one in adc]
    for one in of_scene:
        if not one.results(tmp_path).exists():
            keep(tmp_path, [one], hashes={"data": "data-a"})
    for one in new:
        hashes = {"data": "data-a", "arm": "a"}
        keep(tmp_path, [one], hashes=hashes, code={"packages": {"densify": "e" * 16}})
    declare(tmp_path, (1, [*adc, *old]), (4, [*of_scene, *new]))
    found = answer(tmp_path)
    by_name = {one.second.densify: one for one in found.answers}
    assert by_name[new[0].densify].versions == 2
    assert by_name[new[0].densify].primary[0].answer.rate == pytest.approx(0.05 / 3)
    if "mine" in by_name and new[0].densify != "mine":
        assert before == [sentence(by_name["mine"])]  # a later name changes no earlier verdict
    write_archive(load_all_trials(tmp_path, "exp"), tmp_path / "exp.zip")
    there = compare(unpack_archive(tmp_path / "exp.zip", tmp_path / "back"))
    assert there.sentences == found.sentences


@pytest.mark.parametrize(
    "seen",
    [
        [replace(one, seed=one.seed + 5) for one in grid("mine", code=OLD)],
        grid("mine", code=OLD, lr=1),  # other settings
        grid("later", code=OLD, day=9),
    ],
)
def test_what_says_nothing_about_the_pairs_of_an_arm_is_no_version(tmp_path, seen):
    keep(tmp_path, seen, arm="b" if seen[0].options else "a")
    removed(tmp_path, seen)
    keep(tmp_path, [*grid("adc")])
    keep(tmp_path, grid("mine", code=NEW), arm="a")
    assert answer(tmp_path).answers[0].versions == 1


def test_what_was_seen_and_removed_before_the_declaration_makes_it_late(tmp_path):
    adc, old, new = grid("adc"), grid("mine", code=OLD), grid("better", code=NEW, day=6)
    keep(tmp_path, adc)
    keep(tmp_path, old, arm="a")
    removed(tmp_path, old)
    keep(tmp_path, new, arm="a")
    declare(tmp_path, (5, [*adc, *new]))
    (found,) = answer(tmp_path).answers
    assert found.standing.doubt == "only after 3 trials of the arm had been measured"


# ---- random experiments

ARMS = [
    ("mine", ()),
    ("momentum", (("decay", 0.9),)),
    ("momentum", (("decay", 0.99),)),
    ("absgs", ()),
    ("volumetric", (("decay", 0.9), ("cap", 5))),
]


@dataclass(frozen=True)
class Experiment:
    """A made-up experiment.

    ``without`` are trials without a PSNR, ``declared`` those declared with PSNR before all results,
    and ``looks`` the pairs of arms that a sweep in looks declared.
    """

    trials: list[Made]
    without: frozenset[Made]
    declared: list[Made]
    looks: list[tuple[list[Made], list[Made]]]

    @property
    def baseline(self):
        first = self.trials[0]
        return [
            one for one in self.trials if (one.densify, one.hash) == (first.densify, first.hash)
        ]

    @property
    def last(self):
        return next(one for one in reversed(self.trials) if one.code != OLD)

    def write(self, runs, order=None):
        write(runs, order or self.trials)
        for one in self.without:
            drop_psnr(runs, one)
        if self.looks:
            declare_looks(runs, *self.looks, scenes=sorted({one.scene for one in self.trials}))
        elif self.declared:
            declare(runs, (1, self.declared))


@st.composite
def experiments(draw):
    """Arms on scenes and seeds against a baseline, with and without declarations, looks and faults."""
    places = draw(
        st.lists(
            st.tuples(st.sampled_from("abc"), st.integers(0, 3)),
            min_size=1,
            max_size=6,
            unique=True,
        )
    )
    arms = draw(st.lists(st.sampled_from(ARMS), min_size=1, max_size=4, unique=True))
    in_looks = draw(st.booleans())
    # without a baseline, arms are compared with the first one: only looks say which that is
    first = draw(st.sampled_from(["adc", "plain"] if in_looks else ["adc"]))
    swept = [(("cap", 5),), (("cap", 9),)]
    first_settings = draw(st.sampled_from([[()], swept] if first == "adc" else [[()]]))
    trials, groups = [], []
    for densify, options in [*((first, one) for one in first_settings), *arms]:
        code = draw(st.sampled_from(["", NEW]))
        own = [Made(densify, options, scene=scene, seed=seed, code=code) for scene, seed in places]
        missing = draw(st.sets(st.sampled_from(own), max_size=1 if len(own) > 1 else 0))
        day = draw(st.integers(2, 9))
        groups.append([replace(one, day=day) for one in own if one not in missing])
        trials += groups[-1]
        if code and draw(st.booleans()):
            trials.append(replace(groups[-1][0], code=OLD, day=1))
    without = draw(st.sets(st.sampled_from(trials), max_size=1))
    declared = trials[: draw(st.sampled_from([0, len(trials), len(trials) - 1]))]
    pairs = [(groups[0], one) for one in groups[len(first_settings) :]] if in_looks else []
    return Experiment(trials, frozenset(without), declared, pairs)


SEED_OF_ONE, OLD_VERSIONS = "a seed of one arm", "old versions of an arm"
ADDED = {
    "an arm": lambda made: [
        replace(one, densify="zzz", options=(), day=2) for one in made.trials[:2]
    ],
    "an arm that is sorted first": lambda made: [
        replace(one, densify="aaa", options=()) for one in made.baseline
    ],
    "a baseline": lambda made: [
        replace(one, densify="adc", options=(), code="", day=9)
        for one in made.baseline
        if made.baseline[0].densify != "adc"
    ],
    "an arm of another initialiser": lambda made: [
        replace(one, init="random", densify="mine", options=(), day=2) for one in made.trials[:2]
    ],
    "the baseline of another initialiser": lambda made: [
        replace(one, init="random", code="", day=9) for one in made.baseline
    ],
    "a scene that only one arm has": lambda made: [replace(made.trials[-1], scene="z")],
    "a setting of another arm": lambda made: [
        replace(one, densify="zzz", options=(("decay", decay), ("lr", 1)))
        for one in made.baseline
        for decay in (1, 2)
    ],
    SEED_OF_ONE: lambda made: [
        replace(one, scene=made.last.scene, seed=9, day=9) for one in (made.baseline[0], made.last)
    ],
    OLD_VERSIONS: lambda made: [replace(made.trials[-1], code=OLD, day=1)],
}


def arms_of(comparison, densify):
    return {one.arm for one in comparison.trials if one.densify == densify}


def outcomes(comparison):
    return {
        (str(one.second), str(one.first)): (
            one.beforehand,
            [(v.question.metric, v.outcome, v.interval, v.p, v.family) for v in one.verdicts],
        )
        for one in comparison.answers
    }


many_examples = settings(max_examples=EXAMPLES or 12, deadline=None)


@pytest.mark.parametrize("what", ADDED)
def test_what_is_added_never_changes_another_verdict(what):
    @many_examples
    @given(experiments(), st.booleans())
    def check(made, other_metric):
        with TemporaryDirectory() as folder:
            runs = Path(folder)
            made.write(runs)
            before = answer(runs)
            added = set(ADDED[what](made)) - set(made.trials)
            write(runs, sorted(added, key=repr))
            file = runs / "exp/declared.jsonl"
            if other_metric and file.exists():
                later = on_day(31, {one.key: (one.seed,) for one in added}, "ssim")
                file.write_text(file.read_text() + record_text([later]))
            (runs / "exp/d/sfm-mine/deadbeef-seed0").mkdir(parents=True)  # it failed
            after = answer(runs)
            assert before.pairs
            # the new seed makes a sweep of a setting that was one value for each scene: other arms
            if what == SEED_OF_ONE and len(arms_of(before, "adc")) < len(arms_of(after, "adc")):
                return
            last_arm = next(one.arm for one in before.trials if one.key == made.last.key)
            changed = outcomes(after)
            for pair, found in outcomes(before).items():
                own = what == SEED_OF_ONE and f"sfm-{made.last.densify}" in pair[0]
                own = own or (what == OLD_VERSIONS and pair[0] == str(last_arm))
                assert own or changed[pair] == found
            check_all_is_named(after)

    check()


@settings(max_examples=EXAMPLES or 8, deadline=None)
@given(experiments())
def test_forgetting_earlier_code_never_changes_a_verdict(made):
    with TemporaryDirectory() as folder:
        runs = Path(folder)
        made.write(runs)
        before = answer(runs).sentences
        forget(runs)
        assert answer(runs).sentences == before


def check_all_is_named(comparison):
    """Each trial is in a verdict, or its arm is named in a sentence with the reason."""
    used = {
        trial.path
        for one in comparison.answers
        for verdict in one.verdicts
        for trial in verdict.pairs.trials
    }
    without = {str(one.second) for one in comparison.answers if not one.verdicts}
    without |= {str(one.first) for one in comparison.answers if not one.verdicts}
    named = "\n".join(texts(comparison.unused))
    for trial in comparison.trials:
        label = f"{trial.experiment}/{trial.scene}/{trial.init}-{trial.densify}"
        known = trial.path in used or str(trial.arm) in without
        assert known or str(trial.arm) in named or label in named or " more" in named


@settings(max_examples=EXAMPLES or 8, deadline=None)
@given(experiments())
def test_all_surfaces_state_the_same(made):
    with TemporaryDirectory() as folder:
        runs = Path(folder)
        made.write(runs)
        comparison = answer(runs)
        notes, page = "\n".join(table_of(runs).notes), html.unescape(page_of(runs))
        told = description(comparison.experiment)
        pairs = comparison.to_json()["pairs"]
        assert [one["sentence"] for one in pairs] == comparison.sentences
        for sentence in comparison.sentences:
            assert f"Verdict, {sentence}" in notes
            assert f"<strong>{sentence}" in page
            assert sentence in told or len(told) > 4000  # cut to what a tag may hold
        for line in texts(comparison.remarks):
            assert line in notes
            assert line in page


@many_examples
@given(experiments())
def test_a_metric_where_lower_is_better_gives_the_mirrored_verdict(made):
    scale = quantity("flip", []).worthwhile / quantity("psnr", []).worthwhile
    with TemporaryDirectory() as folder:
        runs = Path(folder)
        replace(made, declared=[], looks=[]).write(runs)
        for file in runs.glob("exp/*/*/*/results.json"):
            data, moment = read_json(file), file.stat().st_mtime
            if "psnr" in data["metrics"]:
                data["metrics"]["flip"] = 1 - scale * data["metrics"]["psnr"]
            write_file(file, data)
            os.utime(file, (moment, moment))
        for pair in answer(runs).answers:
            by_metric = {one.question.metric: one for one in pair.verdicts}
            if "psnr" in by_metric:
                one, other = by_metric["psnr"], by_metric["flip"]
                assert (one.outcome, one.pairs.seeds) == (other.outcome, other.pairs.seeds)
                if one.interval is not None:
                    mirrored = [-scale * one.interval.high, -scale * one.interval.low]
                    assert [other.interval.low, other.interval.high] == pytest.approx(mirrored)


@many_examples
@given(experiments(), st.randoms(use_true_random=False))
def test_the_order_of_commands_does_not_matter(made, shuffler):
    found = []
    for order in (made.trials, shuffler.sample(made.trials, len(made.trials))):
        with TemporaryDirectory() as folder:
            made.write(Path(folder), order)
            found.append(outcomes(answer(Path(folder))))
    assert found[0] == found[1]


def test_the_simulation_of_a_shared_baseline_draws_what_it_says():
    shared = script("shared_baseline")
    one, some = shared.rates(shared.seen(3, 3), 1, False, 20_000, 1)
    assert one == some == pytest.approx(0.05, abs=0.006)  # Student's test is exact on one scene
    together = shared.rates(shared.seen(3, 3), 4, True, 4000, 1)
    apart = shared.rates(shared.seen(3, 3), 4, False, 4000, 1)
    assert together[1] < 0.06 < apart[1] < 0.2
    assert shared.rates(shared.seen(12, 3), 1, False, 4000, 1)[0] > 0.1
    differences = np.random.default_rng(0).normal(size=(5, 3, 3))
    expected = [t_test(one) for one in differences]
    assert shared.p_values(differences) == pytest.approx([one.p for one in expected if one])
