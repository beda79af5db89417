"""Declaring the metric of a verdict: before trials run, visibly when changed, without computing."""

import json
import logging
import time
from shlex import split

import pytest

from gsbench.analysis.comparison import compare
from gsbench.analysis.declaration import active_declaration
from gsbench.analysis.judgement import judge
from gsbench.analysis.results import load_experiment
from gsbench.config.compose import Trial
from gsbench.launch.record import add_to_plan, declare, declare_questions, declared_metrics
from gsbench.runs.experiments import Declaration, Question, declared_now, read_declarations
from tests.end_to_end.conftest import SMALL
from tests.helpers import refusal, write
from tests.trials import bare_trial as trial
from tests.trials import write_trial

ARMS = ("adc", "mine")

# later words win: a trial of seconds
TINY = SMALL + split(
    "train.iterations=2 scene.views=9 scene.width=48 scene.height=36 init.count=200 "
    "raster=reference eval.lpips=[] eval.flip=false tracking=none densify=none"
)


def declaring(runs, primary, seed=0, **densify):
    """A trial of a command with this ``eval.primary``."""
    named = {"densify": {"name": "adc"} | densify, "scene": {"name": "courtyard"}, "name": "exp"}
    return trial(runs, seed, eval={"primary": primary}, **named)


def test_a_declaration_is_kept_with_its_time_and_changes_are_added(tmp_path, caplog):
    undeclared, psnr, ssim = (declaring(tmp_path, metric) for metric in (None, "psnr", "ssim"))
    declare([undeclared])
    assert read_declarations(tmp_path / "exp") == []
    for trials in ([psnr, psnr], [psnr], [undeclared]):  # repeated or left out, it stays declared
        declare(trials)
        assert [one.primary for one in read_declarations(tmp_path / "exp")] == ["psnr"]
    with caplog.at_level(logging.WARNING):
        declare([ssim])
    assert {one.primary for one in read_declarations(tmp_path / "exp")} == {"psnr", "ssim"}
    assert "ssim decides on arms that have no results yet; on the others, psnr does" in caplog.text


def test_trials_are_declared_with_the_metric_and_those_of_later_commands_are_added(
    tmp_path, caplog
):
    def say(*trials):
        declare(trials)
        lines = (tmp_path / "exp/declared.jsonl").read_text().splitlines()
        return [json.loads(line)["trials"] for line in lines]

    first_seed, second_seed = (declaring(tmp_path, "psnr", seed) for seed in (0, 1))
    (first,) = say(second_seed, first_seed, declaring(tmp_path, "psnr", name="volumetric"))
    assert sorted(first.values()) == [[0], [0, 1]]
    assert {key.rpartition("/")[0] for key in first} == {
        "courtyard/a_init-adc",
        "courtyard/a_init-volumetric",
    }
    assert say(second_seed) == [first]  # a part of it: nothing new
    assert not caplog.text
    # a further seed, by a command that declares nothing: before any result it is declared in time
    after = say(declaring(tmp_path, None, 2))
    assert sorted(after[-1].values()) == [[0], [0, 1, 2]]
    assert "first result" not in caplog.text
    # the time is that of the first declaration of the metric, which the verdict counts
    record = tmp_path / "exp/declared.jsonl"
    moments = iter(("2020-01-01", "2020-01-02"))
    lines = [
        json.loads(line) | {"time": f"{next(moments)}T00:00:00Z"}
        for line in record.read_text().splitlines()
    ]
    record.write_text("".join(json.dumps(line) + "\n" for line in lines))
    with caplog.at_level(logging.INFO):
        declare([declaring(tmp_path, None, 2)])
    assert "exp: psnr stays declared, since 2020-01-01 00:00 UTC" in caplog.messages
    # another threshold is another arm, though it has the same name
    changed = declaring(tmp_path, "psnr", name="volumetric", volume_threshold=0.1)
    assert len(say(changed)[-1]) == 3


@pytest.mark.parametrize("in_looks", [False, True])
@pytest.mark.parametrize(
    "name, seed, late", [("adc", 1, "a_init-adc"), ("adc", 0, ""), ("later", 1, "")]
)
def test_arms_that_get_seeds_after_their_first_result_are_named(
    tmp_path, caplog, in_looks, name, seed, late
):
    first, added = declaring(tmp_path, "psnr"), declaring(tmp_path, "psnr", seed, name=name)
    declare([first])
    write(first.folder / "results.json", {})
    with caplog.at_level(logging.WARNING):
        if in_looks:
            question = Question(
                metric="psnr", scenes={"courtyard": (added.files.key,) * 2}, seeds=(0, seed)
            )
            declare_questions(tmp_path / "exp", declared_now(questions=(question,), looks=(2,)))
        else:
            declare([added])
    assert f"{late}: where such an arm is compared" in caplog.text if late else not caplog.text


def test_one_command_cannot_declare_two_metrics(tmp_path, refused):
    trials = [declaring(tmp_path, metric) for metric in ("psnr", "ssim")]
    with refusal(r"trials of exp declare eval\.primary=psnr and eval\.primary=ssim"):
        declared_metrics(trials)
    assert "eval.primary does not make a different trial" in refused(
        "-m", *TINY, "eval.primary=psnr,ssim", f"runs={tmp_path}"
    )


def test_claims_are_kept_beside_declared_metrics(tmp_path, caplog):
    home = tmp_path / "exp"

    def claims(metric, year, **more):
        asked = (Question(metric=metric, name="claim"),)
        return Declaration(time=f"{year}-01-01T00:00:00Z", questions=asked, **more)

    nothing = Declaration(time="2020-01-01T00:00:00Z")
    assert declare_questions(home, nothing) is nothing
    assert not home.exists()
    first = declare_questions(home, claims("psnr", 2020))
    # the first declaration stays, with its time
    assert declare_questions(home, claims("psnr", 2021)) == first
    declare([declaring(tmp_path, "psnr")])
    assert not caplog.text
    with caplog.at_level(logging.WARNING):
        declare_questions(home, claims("ssim", 2022))
    assert "other questions were declared before" in caplog.text
    every = read_declarations(home)
    assert [one.primary for one in every if one.kind == "claims"] == ["psnr", "ssim"]
    assert [one.primary for one in every if one.kind == "sweep"] == ["psnr"]


@pytest.mark.parametrize("write", [add_to_plan, declare, lambda trials: ask(trials[0].files.home)])
def test_nothing_is_written_into_an_experiment_that_is_a_link(tmp_path, write):
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "x").symlink_to(tmp_path / "elsewhere")
    one = trial(tmp_path, eval={"primary": "psnr"})
    with refusal("is a link"):
        write([Trial(one.values, ("seed=0",))])
    assert not list((tmp_path / "elsewhere").iterdir())


def ask(home):
    questions = (Question(metric="psnr", name="claim"),)
    declare_questions(home, Declaration(time="2020-01-01T00:00:00Z", questions=questions))


@pytest.mark.slow
def test_results_keep_what_was_declared_and_a_change_computes_nothing(tmp_path, said):
    words = [*TINY, f"runs={tmp_path}", "name=exp"]
    said(*words, "eval.primary=psnr")
    (file,) = tmp_path.glob("exp/*/*/*/results.json")
    before = file.read_bytes()
    results = json.loads(before)
    (declared,) = read_declarations(tmp_path / "exp")
    assert results["declared"] == {"metric": "psnr", "time": declared.time}
    experiment = load_experiment(tmp_path, "exp")
    found = active_declaration(experiment)
    assert found.standing([], experiment.trials).beforehand
    assert experiment.trials[0].measured >= declared.moment

    time.sleep(1.1)  # moments are kept in whole seconds
    store = {path: path.stat().st_mtime_ns for path in tmp_path.glob("store/*/*")}
    said(*words, "eval.primary=ssim")
    assert file.read_bytes() == before
    assert {path: path.stat().st_mtime_ns for path in tmp_path.glob("store/*/*")} == store
    found = active_declaration(load_experiment(tmp_path, "exp"))
    standing = found.standing([], experiment.trials)  # the metric of the arm's first result
    assert (found.metric, standing.active.metric, standing.beforehand) == ("ssim", "psnr", True)

    # Another experiment gets the same numbers from the store: they were measured before its
    # declaration.
    said(*words, "name=again", "eval.primary=ssim")
    again = load_experiment(tmp_path, "again")
    found = active_declaration(again)
    assert not found.standing([], again.trials).beforehand


@pytest.mark.parametrize("in_claims", [False, True])
def test_results_that_a_wrong_clock_dated_later_than_their_declaration_were_seen(
    tmp_path, caplog, in_claims
):
    trials = [declaring(tmp_path, "psnr", seed, name=arm) for arm in ARMS for seed in range(3)]
    for number, one in enumerate(trials):
        write_trial(
            tmp_path,
            *(one.values["seed"], one.folder.name[:8]),
            **{"experiment": "exp", "scene": "courtyard", "init": "a_init"},
            **{"densify": one.values["densify"]["name"], "psnr": 20.0 + number},
            _measured="2037-01-01T00:00:00Z",
        )
    keys = tuple(dict.fromkeys(one.files.key for one in trials))
    question = Question(metric="psnr", scenes={"courtyard": keys}, seeds=(0, 1, 2), name="claim")
    with caplog.at_level(logging.WARNING):
        if in_claims:
            asked = declare_questions(tmp_path / "exp", declared_now(questions=(question,)))
        else:
            declare(trials)
    assert "results of a_init-adc, a_init-mine are dated later than now" in caplog.text
    experiment = load_experiment(tmp_path, "exp")
    if in_claims:
        assert len(judge(experiment.trials, asked)[0].seen) == 3
    else:
        (sentence,) = compare(experiment).sentences
        assert "declared, but only after 3 trials of the arm had been measured" in sentence
