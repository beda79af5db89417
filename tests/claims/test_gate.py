"""The gate on made-up trials: results of the new version, and refused questions."""

from dataclasses import replace
from shlex import split

import numpy as np
import pytest

from gsbench.analysis.pairs import Pairs
from gsbench.analysis.quantities import asked_quantity
from gsbench.analysis.results import load_experiment
from gsbench.analysis.statistics import StudentT
from gsbench.analysis.verdicts import Verdict
from gsbench.claims.export import write_archive
from gsbench.cli import run
from gsbench.errors import InputError
from gsbench.runs.trial_record import Code
from gsbench.verbs.gate import (
    NOT_DECIDED,
    PASSED,
    WORSE,
    ask_gate,
    declare_gate,
    describe,
    deviations,
    result_of,
)
from tests.analysis.helpers import loaded
from tests.helpers import refusal, table
from tests.trials import with_record, write_as, write_runs, write_trial

VALUES = {"eval": {"extra": {}}}
SCENES = ("courtyard", "garden")


def asked(metric="psnr", least="0.1", seeds=4):
    return declare_gate(metric, least, SCENES, range(seeds), VALUES)


def trials(runs, effect, noise, seeds=4, scenes=SCENES):
    """Trials of one version, whose PSNR is 26 + ``effect`` with that noise (dB)."""
    for scene in scenes:
        for seed in range(seeds):
            rng = np.random.default_rng([seed, len(scene), int(1000 * abs(effect))])
            psnr = 26 + effect + rng.normal(0, noise)
            write_trial(runs, seed, experiment="gate", scene=scene, psnr=psnr, flip=0.1)
    return load_experiment(runs, "gate").trials


def gate(tmp_path, effect, noise, declared=None):
    """The verdict on a version with that effect, and the most seeds that were asked for."""
    old, new = (trials(tmp_path / str(k), k * effect, noise) for k in (0, 1))
    most = [0]

    def run_them(planned):
        most[0] = max(seed for *_, seed in planned) + 1

    found = ask_gate(
        declared or asked(), lambda: old, lambda: [one for one in new if one.seed < most[0]]
    )
    (verdict,) = found.answer(run_them)
    return verdict, most[0]


@pytest.mark.parametrize(
    "effect, noise, result, words, seeds",
    [
        (-1.0, 0.01, WORSE, "worse: worse in PSNR (dB) on these scenes: −0.99", 2),
        (1.0, 0.01, PASSED, "passed: better in PSNR", 2),
        (0.01, 0.002, PASSED, "passed: too small to matter in PSNR (dB)", 2),
        (-0.3, 1.0, NOT_DECIDED, "undecided in PSNR", 4),
        (0.0, 1.0, PASSED, "equal to the last bit in all 4 pairs of trials", 2),
    ],
)
def test_the_gate_passes_fails_or_stays_undecided_by_effect_and_noise(
    tmp_path, effect, noise, result, words, seeds
):
    verdict, most = gate(tmp_path, effect, noise)
    assert (result_of(verdict), most) == (result, seeds)
    assert words in describe(verdict)


def test_a_version_that_is_shown_not_to_be_worse_passes_even_if_undecided(tmp_path):
    verdict, most = gate(tmp_path, 0.05, 0.05, asked(least="0.35"))
    assert (verdict.outcome, result_of(verdict)) == ("undecided", PASSED)
    assert "not worse by 0.35" in describe(verdict)
    assert most < 4


@pytest.mark.parametrize(
    "sign, mean, result",
    [
        (1, -0.1, NOT_DECIDED),
        (1, -0.09, PASSED),
        (-1, 0.1, NOT_DECIDED),
        (-1, 0.09, PASSED),
        (1, -0.2, NOT_DECIDED),
    ],
)
def test_an_interval_that_reaches_the_least_loss_that_matters_does_not_pass(sign, mean, result):
    question, test = replace(asked(), sign=sign), StudentT(mean, 0.0, 3.0)
    undecided = Verdict(question, asked_quantity("psnr"), Pairs(()), "answered", 0.05, test=test)
    assert result_of(undecided) == result


def test_a_look_waits_for_every_scene_even_if_the_first_is_equal(tmp_path):
    old = trials(tmp_path, 0, 0.1)
    garden = [one for one in old if one.scene == "garden"]
    (verdict,) = ask_gate(asked(), lambda: old, lambda: garden).verdicts()
    assert not verdict.final
    assert result_of(verdict) == NOT_DECIDED


def test_the_code_may_differ_and_the_baseline_may_be_older_than_the_question(tmp_path):
    def made_by(own, state, year):
        made = {"code": Code(packages={"densify": state}), "measured": f"{year}-01-01T00:00:00Z"}
        return [with_record(one, **made) for one in own]

    old = made_by(trials(tmp_path / "a", 0, 0.01), "one", 2019)
    new = made_by(trials(tmp_path / "b", -1, 0.01), "two", 2021)
    (verdict,) = ask_gate(asked(), lambda: old, lambda: new).verdicts()
    assert result_of(verdict) == WORSE
    mixed = [*new[:1], *made_by(new[1:], "three", 2021)]
    (refused,) = ask_gate(asked(), lambda: old, lambda: mixed).verdicts()
    assert "different versions" in str(refused.untestable)
    assert result_of(refused) == NOT_DECIDED


def test_deviations_name_machines_and_libraries(tmp_path):
    own = trials(tmp_path, 0, 0.1)
    assert deviations(own, own) == []
    machine = {"cpu": "Ours", "kernels": "znver4", "torch": "AVX512", "device": "cpu"}
    versions = own[0].record.versions | {"torch": "9.9", "gsbench": "9.9"}
    other = [with_record(one, machine=machine, versions=versions) for one in own]
    first, second = map(str, deviations(own, other))
    assert (
        "another kind of machine (not recorded) than the new trials (Ours (znver4, torch AVX512))"
        in first
    )
    assert "with torch 2.13.0, the new trials with 9.9" in second


def test_questions_that_cannot_be_judged_are_refused():
    for words, message in (
        (("psn", None), "did you mean psnr"),
        (("gaussians", None), "give --least"),
        (("gaussians", "100"), "must be a part, such as 10%"),
        (("psnr", "0"), "above 0"),
        (("psnr", "much"), "above 0"),
    ):
        with refusal(message):
            asked(*words)
    with refusal("needs at least 2 seeds, and there is 1"):
        asked(seeds=1)
    assert asked("gaussians", "10%").sign == -1
    assert asked(least=None).least == 0.1


@pytest.mark.parametrize(
    "words, message",
    table(__file__, "bad input"),
)
def test_bad_input_of_gate_is_refused(runs, tmp_path, refused, words, message):
    write_runs(tmp_path / "made", densifiers=("adc", "volumetric"))
    write_archive(loaded(tmp_path / "made"), tmp_path / "exp.zip")
    given = not words or " scene=" in words or " densify=" in words
    words = words if given else f"{words} densify=adc init=sfm"
    assert message in refused("gate", *split(words))


@pytest.fixture
def gated(runs, tmp_path, monkeypatch):
    """Run the verb against an archive of four trials; ``write`` stands for a training.

    As without weights, trials lack a metric: they are done only if what can be computed now is not
    asked for.
    """

    def lacking(files, values, unavailable_now=None):
        return "" if unavailable_now else "it lacks flip"

    def run_gate(words, write):
        trained = []

        def train(planned, asks):
            for trial in planned:
                trained.append(trial.values["seed"])
                write(trial)
            return 0

        monkeypatch.setattr("gsbench.verbs.gate.run_trials", train)
        monkeypatch.setattr("gsbench.runs.trial_folder.TrialFolder.why_not_done", lacking)
        trials(tmp_path / "old", 0, 0.01, scenes=("courtyard",))
        write_archive(load_experiment(tmp_path / "old", "gate"), tmp_path / "exp.zip")
        return run(split(f"gate exp.zip init=sfm densify=adc {words}")), trained

    return run_gate


@pytest.mark.parametrize(
    "effect, code, words", [(-1.0, 1, "worse in PSNR"), (1.0, 0, "passed: better in PSNR")]
)
def test_the_exit_code_of_gate_is_its_result(gated, capsys, effect, code, words):
    def write(trial):
        write_as(trial, psnr=26 + effect + 0.001 * trial.values["seed"])

    # the first look decides
    assert gated("scene=courtyard --seeds 3", write) == (code, [0, 1])
    assert words in capsys.readouterr().out


def test_one_training_shows_that_the_sides_cannot_be_compared(gated, capsys):
    def write(trial):
        write_as(trial, psnr=26, _resolution=[640, 480])

    assert gated("scene=courtyard", write) == (2, [0])
    said = capsys.readouterr().err
    assert "courtyard: the arms differ in resolution" in said
    assert "cannot be read" not in said  # of the folder that the gate makes itself


@pytest.mark.parametrize(
    "words, effect, code",
    table(__file__, "exit codes"),
)
def test_exit_codes_under_git_bisect_run(gated, words, effect, code):
    def write(trial):
        if effect is None:
            raise InputError("densify._target_=mine.Mine cannot be imported")
        write_as(trial, psnr=26 + effect + 0.01 * trial.values["seed"])

    assert gated(f"{words} --bisect", write)[0] == code
