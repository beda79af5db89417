"""``gsbench ledger`` with made-up trainings: results by idea, seed and scene."""

import json
import re
from itertools import chain
from pathlib import Path
from shlex import split

import numpy as np
import pytest

from gsbench.analysis.results import read_experiment
from gsbench.claims.export import _shared_commands, without_private_words
from gsbench.claims.ledger import read_ledger
from gsbench.cli import run
from gsbench.launch import record as writing
from gsbench.runs import commands
from gsbench.runs.code import states_of, user_modules
from gsbench.runs.keys import CODE_OF_STAGE
from gsbench.runs.layout import COMMANDS
from gsbench.runs.trial_record import Code
from gsbench.verbs import ledger as verb
from tests.composed import composed
from tests.conftest import script
from tests.helpers import table, write
from tests.trials import record_of, write_results

SETTINGS = split("scene=courtyard init=random densify=adc tracking=none eval.lpips=[]")
NEW = [*split("new night --metric psnr --least 0.5"), *SETTINGS, "seed=0,1,2,3"]
ledger_rates = script("ledger_rates")
SPLIT = "densify.split_size"  # its value chooses a made-up effect


class Trainings:
    """Writes the results of trials in place of training them."""

    def __init__(self):
        self.effects = {0.01: 0.0, 0.02: 3.0, 0.03: 6.0, 0.04: -3.0, 0.05: 0.1, 0.06: 0.0}  # dB
        self.noise = 0.2
        self.fails = set()
        self.trained = []
        self.data = ""
        self.lucky = 0.0  # gain of ideas on the seeds of the ledger

    def __call__(self, trials, asks):
        assert not asks  # the questions are the ledger's, at its levels
        writing.record(trials, asks)
        code = 0
        for trial in trials:
            size, seed = trial.values["densify"]["split_size"], trial.values["seed"]
            if size in self.fails:
                code = 1
                write(trial.folder / "failed.json", {"message": "a typing error"})
            elif not (trial.folder / "results.json").exists():
                self.trained.append(trial.folder)
                noise = np.random.default_rng([seed, round(1000 * size)]).normal(0, self.noise)
                noise += self.lucky * (seed < 10 and size > 0.01)
                write_made_up(
                    trial,
                    20 + self.effects[size] + noise,
                    num_gaussians=round(1000 * (1 + size)),
                    hashes={"data": self.data or trial.values["scene"]["name"]},
                )
        return code


def write_made_up(trial, psnr, **facts):
    """Write a trial's results, by the code as it is now."""
    packages = states_of(chain(*CODE_OF_STAGE.values()))
    code = Code(sources=user_modules(trial.values), packages=packages)
    write(trial.folder / "config.yaml", trial.values)  # JSON is YAML
    record = record_of(trial.values, metrics={"psnr": psnr}, code=code, **facts)
    trial.files.write_finished(trial.values, record)
    (trial.folder / "failed.json").unlink(missing_ok=True)


def at(monkeypatch, moment):
    """Let all commands be given then: the new seeds follow from all lines before."""

    def now(words=None, **parts):
        return commands.Command(words=(), cwd="", time=moment, **parts)

    for module in (verb, writing):
        monkeypatch.setattr(module, "command_now", now)


@pytest.fixture
def trainings(monkeypatch, runs):
    made = Trainings()
    monkeypatch.setattr("gsbench.verbs.ledger.compose_trials", composed)
    monkeypatch.setattr(verb, "run_trials", made)
    at(monkeypatch, 1.0)
    monkeypatch.setattr(verb, "finished_trials", finished)
    return made


def finished(trials):
    folders = {trial.folder for trial in trials}
    homes = {trial.files.home for trial in trials}
    found = chain.from_iterable(read_experiment(home).trials for home in homes)
    return [one for one in found if one.path in folders]


@pytest.fixture
def home(trainings, tmp_path):
    assert run(["ledger", *NEW]) == 0
    return tmp_path / "runs/night"


def attempt(*words):
    return run(["ledger", "try", "night", *words])


@pytest.fixture
def not_tried(refused):
    """A function that tries an idea, which must be refused, and returns the error's line."""
    return lambda *words: refused("ledger try night", *words)


def results(home):
    book = read_ledger(home)
    return {idea: book.result(idea) for idea in book.questions}


def seeds_of(home):
    """The seeds of each test."""
    return [next(iter(one.seeds.values())) for one in read_ledger(home).tests.values()]


def test_a_good_idea_is_kept_and_a_bad_one_is_dropped(home, said, capsys):
    assert attempt(f"{SPLIT}=0.02") == 0
    assert "adc against baseline: kept: better; psnr +" in capsys.readouterr().out
    assert attempt(f"{SPLIT}=0.04") == 1
    assert "adc-2 against baseline: dropped: looks worse; psnr −" in capsys.readouterr().out
    assert results(home) == {"adc": "kept", "adc-2": "dropped"}
    first = json.loads(said("ledger show night --json"))["ideas"][0]
    assert first["gaussians"] == pytest.approx(1.02 / 1.01, abs=1e-3)


def test_an_idea_stops_at_the_first_look_that_decides(home, trainings):
    attempt(f"{SPLIT}=0.04")
    assert len(trainings.trained) == 2 * 2  # two seeds of both
    assert not read_ledger(home).tests


def test_what_looks_better_is_tested_on_new_seeds_of_both_arms(home, trainings):
    attempt(f"{SPLIT}=0.02")
    attempt(f"{SPLIT}=0.03")
    tests = read_ledger(home).tests
    # LOND with weights 1/n, which sum to 4.28 for 40 ideas; one was kept before the second test;
    # an interval has two sides
    harmonic = sum(1 / number for number in range(1, 41))
    levels = [0.5 * one.level for one in tests.values()]
    assert levels == pytest.approx([0.1 / harmonic, 2 * 0.1 / 2 / harmonic])
    seeds = [set(own) for own in seeds_of(home)]
    assert [len(own) for own in seeds] == [4, 4]
    assert not seeds[0] & seeds[1]
    assert not (seeds[0] | seeds[1]) & {0, 1, 2, 3}
    for own, verdict in zip(seeds, read_ledger(home).verdicts.values(), strict=True):
        ends = tuple(f"-seed{seed}" for seed in own)
        names = [folder.name for folder in trainings.trained if folder.name.endswith(ends)]
        assert len(names) == 2 * verdict.pairs.seeds
        assert len(set(names)) == len(names)  # of two arms


def test_luck_on_the_seeds_of_all_ideas_keeps_nothing(home, trainings):
    """The idea gains on the ledger's seeds, and on no other."""
    trainings.lucky = 5.0
    assert attempt(f"{SPLIT}=0.06") in (1, 3)
    (seeds,) = seeds_of(home)
    assert set(seeds).isdisjoint(range(4))
    assert read_ledger(home).verdicts["adc"].mean < 0.5


def test_another_ledger_on_the_same_captures_has_other_seeds(home, monkeypatch):
    attempt(f"{SPLIT}=0.02")
    at(monkeypatch, 2.0)
    run(["ledger", *split("new other --metric psnr --least 0.5"), *NEW[6:]])
    run(["ledger", "try", "other", f"{SPLIT}=0.02"])
    (first,), (second,) = (seeds_of(one) for one in (home, home.parent / "other"))
    assert not set(first) & set(second)


def test_an_equal_idea_is_neither_trained_nor_entered_twice(home, trainings):
    attempt(f"{SPLIT}=0.02")
    before = len(trainings.trained), (home / COMMANDS).read_bytes()
    assert attempt(f"{SPLIT}=0.02", "densify.name=another") == 0
    assert (len(trainings.trained), (home / COMMANDS).read_bytes()) == before


def test_a_kept_idea_may_be_the_next_baseline(home, trainings):
    trainings.noise = 0.02  # the new seeds, and so the draws, follow from the code
    attempt(f"{SPLIT}=0.02", "--as", "one")
    assert attempt(f"{SPLIT}=0.03", "--as", "two", "--against", "one") == 0
    assert read_ledger(home).verdicts["two"].mean == pytest.approx(3, abs=0.5)
    # another question, against the ledger's own baseline
    assert attempt(f"{SPLIT}=0.03", "--as", "three") == 0
    assert read_ledger(home).verdicts["three"].mean == pytest.approx(6, abs=0.5)


def test_an_idea_whose_trials_fail_does_not_count_as_tried(home, trainings, capsys):
    trainings.fails = {0.02}
    assert attempt(f"{SPLIT}=0.02", "--json") == 1
    shown = json.loads(capsys.readouterr().out)
    assert (shown["result"], shown["tried"], shown["kept"]) == ("failed", 0, [])
    assert shown["reason"] == "a typing error"
    trainings.fails = set()
    assert attempt(f"{SPLIT}=0.02") == 0
    assert results(home) == {"adc": "kept"}


def test_an_idea_that_fails_after_a_result_counts_as_tried(home, trainings, monkeypatch, capsys):
    trainings.noise = 30.0  # undecided at the first look
    whole, calls = trainings.__call__, []

    def second_look_fails(trials, asks):
        calls.append(len(trials))
        return whole(trials, asks) if len(calls) == 1 else 1

    monkeypatch.setattr(verb, "run_trials", second_look_fails)
    assert attempt(f"{SPLIT}=0.02") == 1
    assert "failed: its trials fail; to go on, give the same" in capsys.readouterr().out
    assert results(home) == {"adc": "begun"}
    assert read_ledger(home).tried == 1


def test_an_idea_may_be_tried_again_if_its_baseline_fails(home, trainings):
    trainings.fails = {0.01, 0.02}
    assert attempt(f"{SPLIT}=0.02") == 1
    # nothing was measured, so it may be tried again
    assert results(home) == {"adc": "failed"}


def test_after_all_planned_ideas_no_further_idea_is_tried(trainings, not_tried):
    run(["ledger", *NEW, "--ideas", "1"])
    assert attempt(f"{SPLIT}=0.04") == 1
    assert "all 1 planned ideas were tried" in not_tried(f"{SPLIT}=0.02")
    assert attempt(f"{SPLIT}=0.04") == 1  # it is only shown


@pytest.mark.parametrize(
    "words, reason",
    table(__file__, "ideas"),
)
def test_settings_that_are_no_idea_are_refused_and_leave_no_line(home, words, reason, not_tried):
    before = (home / COMMANDS).read_bytes()
    assert reason in not_tried(*words)
    assert (home / COMMANDS).read_bytes() == before


@pytest.mark.parametrize(
    "words, reason",
    table(__file__, "ledgers"),
)
def test_a_ledger_that_could_not_decide_is_refused(trainings, words, reason, refused):
    assert reason in refused("ledger", "new", "night", *SETTINGS, *split(words))
    assert not Path("runs/night").exists()


def test_a_ledger_is_declared_once(home, trainings, refused):
    assert run(["ledger", *NEW]) == 0
    assert "is another ledger already" in refused("ledger", *NEW, "--fdr", "0.2")
    assert "has no ledger" in refused("ledger", "show", "other")


def test_trials_that_the_ledger_does_not_know_are_refused(home, not_tried):
    attempt(f"{SPLIT}=0.02")
    whole = (home / COMMANDS).read_text().splitlines(keepends=True)
    (home / COMMANDS).write_text(whole[0])  # the end is cut off
    line = not_tried(f"{SPLIT}=0.03")
    assert "the ledger does not know 2 configurations with trials" in line


def test_a_changed_line_is_noticed(home, not_tried):
    attempt(f"{SPLIT}=0.02")
    text = (home / COMMANDS).read_text()
    (home / COMMANDS).write_text(text.replace('"rate": 0.1', '"rate": 0.2'))
    line = not_tried(f"{SPLIT}=0.03")
    assert "does not follow the one before it" in line
    assert "bring back the file as gsbench wrote it" in line


def test_edited_code_of_the_baseline_is_noticed(home, monkeypatch, not_tried):
    monkeypatch.setattr("gsbench.launch.record.digest_of", lambda values: "random-adc/ffffffff")
    assert "the code of baseline have changed" in not_tried(f"{SPLIT}=0.02")


def test_a_ledger_cannot_allow_code_to_run(home, tmp_path, not_tried):
    (tmp_path / "mine.py").write_text("from gsbench.densify import ADC\nclass Mine(ADC): pass\n")
    own = split("densify._target_=mine.Mine densify.name=mine allow_targets=[mine]")
    assert attempt(*own, f"{SPLIT}=0.02") == 0
    line = not_tried(f"{SPLIT}=0.03", "--against", "mine")
    assert "mine runs code of yours: add allow_targets=[mine]" in line
    assert attempt(f"{SPLIT}=0.03", "--against", "mine", "allow_targets=[mine]") == 0


def test_a_kill_between_any_two_lines_changes_nothing(home, monkeypatch):
    """The same command continues; the ledger is that of a night without kills."""
    write = commands._write

    def commands_of_night():
        for size in (0.02, 0.04, 0.05):
            attempt(f"{SPLIT}={size}")
        run(split("ledger confirm night scene=photos scene.path=/park seed=0,1,2"))

    kills = 0
    for allowed in range(25):
        left = [allowed]

        def killed(*arguments, left=left):
            if not left[0]:
                raise KeyboardInterrupt
            left[0] -= 1
            write(*arguments)

        monkeypatch.setattr(commands, "_write", killed)
        commands_of_night()
        if left[0]:  # no line was left to write
            break
        kills += 1
    monkeypatch.setattr(commands, "_write", write)
    commands_of_night()
    killed_night = results(home), len(read_ledger(home).tests)
    assert kills
    (home / COMMANDS).unlink()
    for folder in home.glob("*/*/*"):
        (folder / "results.json").unlink()
    run(["ledger", *NEW])
    commands_of_night()
    assert (results(home), len(read_ledger(home).tests)) == killed_night


# ---- confirmation


CONFIRM = "ledger confirm night"
PARK = split("scene=photos scene.path=/captures/park seed=5,6,7")


def test_kept_ideas_are_confirmed_on_captures_that_no_idea_has_seen(home, trainings, said):
    for size in (0.02, 0.04, 0.03):
        attempt(f"{SPLIT}={size}")
    trainings.effects[0.03] = 0.0  # its gain was luck
    trainings.noise = 0.01
    shown = said(CONFIRM, *PARK)
    assert re.search(r"^adc: kept: adc against baseline: better .*: \+[23]\.", shown, re.MULTILINE)
    assert re.search(r"^adc-3: dropped: ", shown, re.MULTILINE)
    before = len(trainings.trained), (home / COMMANDS).read_bytes()
    said(CONFIRM, *PARK)  # shown again
    assert (len(trainings.trained), (home / COMMANDS).read_bytes()) == before


@pytest.mark.parametrize(
    "words, reason",
    [
        (["seed=5,6"], "courtyard was seen by the ideas"),
        (["scene=courtyard", "seed=5,6"], "courtyard was seen by the ideas"),
    ],
)
def test_a_confirmation_that_confirms_nothing_is_refused(home, words, reason, refused):
    attempt(f"{SPLIT}=0.02")
    attempt(f"{SPLIT}=0.04")
    assert reason in refused(CONFIRM, *words)


def test_a_copy_of_a_capture_under_another_name_is_not_fresh(home, trainings, refused):
    attempt(f"{SPLIT}=0.02")
    trainings.data = "courtyard"  # the same photographs
    before = len(trainings.trained)
    assert "park was seen by the ideas" in refused(CONFIRM, *PARK)
    assert len(trainings.trained) == before + 3  # the trainings of one arm showed it


def test_a_second_confirmation_needs_other_captures(home, said, refused):
    attempt(f"{SPLIT}=0.02")
    said(CONFIRM, *PARK)
    assert "by an earlier confirmation" in refused(CONFIRM, *PARK[:2], "seed=8,9")


# ---- the report, the archive, and the simulated rule


def test_report_and_archive_have_the_ledger(home, trainings, said):
    attempt(f"{SPLIT}=0.02", "--as", "larger splits")
    said("report", "night")
    page = (home / "report.html").read_text()
    assert "gsbench ledger show night" in page
    badges = re.findall(r'class="badge [^"]*">([^<]+)<', page)
    assert badges == ["BETTER"]  # of the test; the screening is no statement
    assert ">NOT TESTED: PSNR" in page
    assert "BETTER: " in said("tables", "night")


def test_an_archived_ledger_names_no_folder_and_no_server(home, trainings, tmp_path):
    words = ["scene.path='/home/me/a b',/home/me/c", "+x.y=[/home/me/d]", "tracking.uri=http://u@h"]
    assert without_private_words(words) == ["scene.path='a b',c", "+x.y=[d]"]
    attempt(f"{SPLIT}=0.02")
    (tmp_path / COMMANDS).write_bytes(_shared_commands(home))
    shared, kept = (commands.read_history(one) for one in (tmp_path, home))
    assert not shared.faults
    assert len(shared.questions) == len(kept.questions) == 2
    assert "tracking=none" in kept.ideas["baseline"].words
    assert "tracking=none" not in shared.ideas["baseline"].words


def test_show_prints_the_rule_and_a_line_for_each_idea(home, said):
    attempt(f"{SPLIT}=0.02", "--as", "good")
    attempt(f"{SPLIT}=0.04", "--as", "bad")
    *rule, good, bad = said("ledger show night").splitlines()
    assert "2 of 40 planned ideas were tried, and 1 kept" in " ".join(rule)
    # The new seeds follow from all lines before, and so from the code: any look may decide.
    assert re.fullmatch(
        r"1\. good against baseline: kept: better; psnr \+\S+ \(.*\); [2-4] new seeds, level 2\.3 %",
        good,
    )
    assert bad.startswith("2. bad against baseline: dropped: looks worse; psnr −")
    assert bad.endswith("; 2 seeds of all ideas")
    shown = json.loads(said("ledger show night --json"))
    assert [one["result"] for one in shown["ideas"]] == ["kept", "dropped"]
    assert (shown["tried"], shown["planned"], shown["kept"]) == (2, 40, ["good"])


def test_an_undecided_idea_says_so_once(home, trainings, said):
    trainings.noise = 5.0
    assert attempt(f"{SPLIT}=0.05") == 3
    line = said("ledger show night").splitlines()[-1]
    assert line.startswith("1. adc against baseline: undecided; psnr ")
    assert line.count("undecided") == 1


def test_ideas_with_other_code_are_not_superseded(home, tmp_path, said):
    for module in ("mine1", "mine2"):
        text = f"from gsbench.densify import ADC\nclass Mine(ADC): name = {module!r}\n"
        (tmp_path / f"{module}.py").write_text(text)
        own = f"densify._target_={module}.Mine densify.name=mine allow_targets=[{module}]"
        attempt(*split(own), f"{SPLIT}=0.02")
    assert results(home) == {"mine": "kept", "mine-2": "kept"}
    assert "superseded" not in said("status night")


def test_names_of_ledgers_and_ideas_are_not_given_twice(home, trainings, refused):
    for size in (0.02, 0.04):
        attempt(f"{SPLIT}={size}", "--as", "mine")
    attempt(f"{SPLIT}=0.05", "--as", "baseline")
    assert [*read_ledger(home).questions] == ["mine", "mine-2", "baseline-3"]
    assert "'store' cannot be the name" in refused("ledger show store")
    folder = home.parent / "used/courtyard/random-adc/12345678-seed0"
    write_results(folder, composed(NEW[6:])[0].values | {"name": "used"})
    assert "used is another ledger already, or has trials" in refused("ledger new used", *NEW[2:])


@pytest.mark.parametrize("code, kind", [(1, 1), (2, 2)])
def test_nothing_is_confirmed_if_trials_fail(home, monkeypatch, code, kind, capsys):
    attempt(f"{SPLIT}=0.02")
    monkeypatch.setattr(verb, "run_trials", lambda trials, asks: code)
    assert run(split("ledger confirm night scene=photos scene.path=x")) == kind
    assert "trials fail: nothing is confirmed" in capsys.readouterr().err


def test_the_simulated_rule_decides_as_the_ledger_does(trainings, monkeypatch, tmp_path):
    """The rates in findings/simulations.md hold for the program: equal draws give equal decisions."""
    run(["ledger", *NEW[:-1], "seed=0,1,2,3,4,5"])
    draws = np.random.default_rng(1).normal(0.9, 1, (5, 2, 1, 6))
    for number, (shared, new) in enumerate(draws):
        size = 0.1 + 0.01 * number

        def training(trials, asks, size=size, shared=shared, new=new):
            for trial in trials:
                own = trial.values["densify"]["split_size"] == pytest.approx(size)
                seed = trial.values["seed"]
                psnr = 20.0
                if own and seed < 6:
                    psnr += shared[0][seed]
                elif own:
                    psnr += new[0][seed - seeds_of(tmp_path / "runs/night")[-1][0]]
                write_made_up(trial, psnr, hashes={})
            return 0

        monkeypatch.setattr(verb, "run_trials", training)
        attempt(f"{SPLIT}={size:.2f}")
    home = tmp_path / "runs/night"
    kept, tests = np.array([0]), np.array([0])
    book = read_ledger(home)
    assert 1 < len(book.tests) < len(draws)
    for (shared, new), idea in zip(draws, book.questions, strict=True):
        one = ledger_rates.Attempt(shared[None], new[None], kept, tests, least=0.5)
        decided = ledger_rates.in_tests(one)
        seeds = (decided.tested if decided.test[0] else decided.seeds)[0]
        found = book.result(idea) == "kept", book.verdicts[idea].pairs.seeds
        assert found == (decided.keep[0], seeds)
        kept, tests = kept + decided.keep, tests + decided.test
    assert tests[0] == len(book.tests)
