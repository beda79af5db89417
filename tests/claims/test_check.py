"""A check from its file to its page: questions, runs at each look, and repeated checks."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
import yaml

from gsbench.analysis.judgement import Verdict
from gsbench.analysis.notes import Note, texts
from gsbench.analysis.pairing import Pairs
from gsbench.analysis.quantities import asked_quantity
from gsbench.analysis.statistics import Answer, StudentT
from gsbench.claims.check import (
    Checked,
    ClaimVerdict,
    prepare,
)
from gsbench.claims.check_page import _number, make_page, to_html
from gsbench.claims.file import parse_claims
from gsbench.claims.stopping import sequential_test
from gsbench.config.compose import with_seed
from gsbench.runs.experiments import read_declarations
from gsbench.runs.trial_folder import TrialFolder
from gsbench.verbs.check import describe
from tests.claims.test_file import CLAIM, changed
from tests.helpers import read_json, refusal, write
from tests.launch.test_declare import TINY
from tests.trials import write_as

SENTENCE = (
    "volumetric against adc: better in PSNR (dB) on this scene: +1.000 (interval +0.996 to +1.004), "
    "with 2 of at most 4 seeds"
)
EFFECT = 1.0  # dB, of "volumetric" in the made-up trials


def content(**changes):
    claims = [CLAIM | {"metric": "psnr", "direction": "higher", "least": 0.3} | changes]
    return changed("settings", {"scene.max_size": 160}) | {
        "scenes": {"courtyard": None},
        "claims": claims,
    }


def check_of(tmp_path, **changes):
    return prepare(parse_claims(content(**changes)), tmp_path, lambda trials: [])


class FakeRunner:
    """Writes made-up results instead of training; ``fails`` names a seed that fails."""

    def __init__(self, noise, fails=None):
        self.noise, self.fails = noise, fails
        self.batches = []

    def __call__(self, trials):
        self.batches.append(len(trials))
        for trial in trials:
            folder, values = TrialFolder.of(trial.values), trial.values
            if values["seed"] == self.fails:
                folder.path.mkdir(parents=True)
                (folder.path / "failed.json").write_text(
                    '{"error": "InputError", "message": "no room\\nat all"}'
                )
                continue
            arm = values["densify"]["name"]
            rng = np.random.default_rng([values["seed"], arm == "adc"])
            write_as(trial, psnr=26 + EFFECT * (arm != "adc") + rng.normal(0, self.noise))


def looked(check, runner):
    """Go through the looks; trials that are done are not run again."""

    def run(planned):
        trials = check.to_run(planned)
        if left := [
            one for one in trials if not (TrialFolder.of(one.values).path / "results.json").exists()
        ]:
            runner(left)

    check = replace(check, declaration=replace(check.declaration, time="2020-01-01T00:00:00Z"))
    return list(check.checked(sequential_test(check).answer(run)).verdicts)


def test_a_clear_effect_ends_at_the_first_look_and_a_repeated_check_runs_nothing(tmp_path):
    check, runner = check_of(tmp_path), FakeRunner(noise=0.001)
    first = looked(check, runner)
    assert [verdict.word for verdict in first] == ["supported"]
    assert runner.batches == [4]
    again = looked(check, runner)
    assert runner.batches == [4]
    assert [one.verdict.interval for one in again] == [one.verdict.interval for one in first]


def test_seeds_are_added_look_by_look_up_to_the_largest_number(tmp_path):
    runner = FakeRunner(noise=2.0)
    (verdict,) = looked(check_of(tmp_path), runner)
    assert verdict.word == "undecided"
    assert runner.batches == [4, 2, 2]


def test_a_claim_waits_for_a_failed_seed_and_is_decided_once_it_succeeds(tmp_path):
    check, runner = check_of(tmp_path), FakeRunner(noise=0.001, fails=1)
    (verdict,) = looked(check, runner)
    assert (verdict.word, runner.batches) == ("undecided", [4])
    assert "the next look waits for trials that are missing; failed: " in verdict.sentence
    assert verdict.sentence.endswith("no room")  # once, since both arms failed for the same reason
    runner.fails = None
    for failed in list(tmp_path.rglob("failed.json")):
        shutil.rmtree(failed.parent)
    (verdict,) = looked(check, runner)
    assert (verdict.word, runner.batches) == ("supported", [4, 2])


def test_scenes_that_cannot_be_tested_are_named_and_not_run(tmp_path):
    file = parse_claims(content() | {"scenes": {"courtyard": None, "garden": None}})
    check = prepare(
        file, tmp_path, lambda trials: ["no data"] * (trials[0].values["scene"]["name"] == "garden")
    )
    assert list(check.declaration.questions[0].scenes) == ["courtyard"]
    (verdict,) = looked(check, FakeRunner(noise=0.001))
    assert verdict.word == "supported"
    assert texts(verdict.verdict.notes) == ["garden: no data"]
    nothing = prepare(file, tmp_path / "b", lambda trials: ["no data"])
    assert looked(nothing, FakeRunner(0.1))[0].sentence == "courtyard, garden: no data"
    assert "not testable here  lpips: courtyard, garden: no data" in describe(nothing)
    # the hash depends on what can be tested here
    assert nothing.declaration.hash != check.declaration.hash


def test_settings_that_do_not_compose_are_refused_with_claim_scene_and_arm(tmp_path):
    for bad, message in (
        (
            changed("arms.adc", {"densify": "adcc"}),
            "claim lpips, scene courtyard, arm adc: .*did you mean adc",
        ),
        (changed("settings", {"scene.max_siz": 160}), "did you mean max_size"),
        (changed("arms.volumetric", {"densify": "adc"}), "the same trial on courtyard"),
        (changed("arms.adc", {"densify.cap": "soft,hard"}), "several values"),
    ):
        bad["scenes"] = {"courtyard": None}
        with refusal(message):
            prepare(parse_claims(bad), tmp_path, lambda trials: [])


def test_another_seed_has_another_folder_and_the_same_settings(tmp_path):
    trial = next(iter(check_of(tmp_path).first_trials.values()))
    other = with_seed(trial, 7)
    assert yaml.safe_load(other.yaml)["seed"] == other.values["seed"] == 7
    assert yaml.safe_load(other.yaml) | {"seed": 0} == yaml.safe_load(trial.yaml)
    assert TrialFolder.of(other.values).path.name == TrialFolder.of(trial.values).path.name.replace(
        "seed0", "seed7"
    )
    assert "seed=7" in other.overrides


def test_the_page_has_verdicts_looks_and_declarations(tmp_path):
    check = check_of(tmp_path, says="it is <better> | by far")
    verdicts = looked(check, FakeRunner(noise=0.001))
    older = replace(check.declaration, time="2019-01-01T00:00:00Z", error_rate=0.1)
    declared = check.declaration
    page = make_page(Checked(check.file, verdicts, declared, [older, declared]))
    text = to_html(page)
    words = "Earlier declarations under this name: 1.", "looks planned at 2, 3, 4 seeds"
    for part in (*words, "supported", "PSNR", "courtyard", "abstract", "<svg"):
        assert part in text
    assert "<better>" not in text
    alone = text.replace("http://www.w3.org", "").replace("http-equiv", "")
    assert "http" not in alone  # one file, no network


def judged(outcome, mean=0.0, error=0.0, direction="higher", **more):
    """A verdict on a claim with a least effect of 0.3.

    With an ``error`` of 0, its interval is the mean.
    """
    file = parse_claims(content(direction=direction))
    answer = Answer(mean, StudentT(mean, error, 1e6), 0.05, 0.05, 0.05)
    question = file.question(file.claims[0], {})
    verdict = Verdict(
        question, asked_quantity("psnr"), Pairs(()), outcome=outcome, answer=answer, **more
    )
    return ClaimVerdict(file.claims[0], verdict)


@pytest.mark.parametrize(
    "one, said",
    [
        (judged("supported", 1.0), "better"),
        (judged("supported", 0.3), "better"),
        (judged("supported", 0.29), "better; by 0.3 or more is not shown"),
        (judged("supported", 0.5, 0.15), "better; by 0.3 or more is not shown"),
        (judged("supported", -0.3, direction="lower"), "lower"),
        (judged("supported", -0.29, direction="lower"), "lower; by 0.3 or more is not shown"),
        (judged("supported", 0.0, direction="same"), "too small to matter"),
        (judged("too small to matter", 0.1), "too small to matter, though better"),
        (judged("too small to matter", -0.1), "too small to matter, though worse"),
        (judged("too small to matter", 0.1, 0.1), "too small to matter"),
        (judged("refuted", -1.0), "worse"),
        (judged("refuted", -1.0, direction="lower"), "higher"),
        (judged("refuted", 1.0, direction="same"), "different by more than 0.3"),
        (judged("undecided"), "undecided"),
        (
            judged("undecided", rests_on_outlying=True),
            "undecided, since it depends on trials far outside the others",
        ),
        (
            judged("undecided", final=False),
            "undecided; the next look waits for trials that are missing",
        ),
    ],
)
def test_each_verdict_has_its_sentence(one, said):
    word, _, more = said.partition("; ")
    start, end = f"volumetric against adc: {word} in PSNR (dB) on ", "of at most 4 seeds"
    assert one.sentence.startswith(start)
    assert one.sentence.rpartition(end)[2] == ("; " * bool(more)) + more
    assert one.word == one.verdict.outcome


def test_what_cannot_be_tested_says_why():
    one = judged("undecided", untestable=Note.of("as given", text="no data"))
    assert (one.word, one.sentence) == ("not testable here", "no data")


def test_the_page_shows_short_numbers_and_late_trials():
    shown = [_number(value) for value in (1000.0, -1000.0, 999.94, 0.5)]
    assert shown == ["1,000", "-1,000", "999.9", "0.5"]
    two = Note.of("seen", trials=2)
    assert str(two).startswith("2 trials had been measured before this was declared")


def test_check_judges_made_up_trials_and_their_archive_alike(
    runs, tmp_path, monkeypatch, said, refused
):
    runner = FakeRunner(noise=0.001)
    monkeypatch.setattr("gsbench.verbs.check.run_batch", runner)
    path, archive, page = tmp_path / "claims.yaml", tmp_path / "a.zip", tmp_path / "page.html"
    write(path, content())
    out = said("check", path, "--dry-run")
    assert "1 claim to be tested" in out
    words = "4 trials until the first look, 8 at most; each test may err in 5 % of such sweeps"
    assert words in out
    own = runs / "check_it/claims.html"
    assert said("check", path) == f"supported            lpips: {SENTENCE}\n{own}\n"
    assert runner.batches == [4]
    assert "supported" in own.read_text()
    said("export --results check_it --out", archive)
    out = said("check", path, "--from", archive)
    assert f"supported            lpips: {SENTENCE}" in out
    assert "judged on 4 trials: 1 scene, 2 seeds, two arms; looks planned at 2, 3, 4 seeds" in out
    said("check", path, "--from", archive, "--out", page)
    assert page.read_text().count("supported") == own.read_text().count("supported")
    for changes, message in (
        ({"least": 0.2}, "its least was 0.3 when it was declared"),
        ({"direction": "lower"}, "its sign was 1"),
        ({"metric": "ssim"}, "its metric was psnr"),
        ({"baseline": "volumetric", "arm": "adc"}, "other arms were declared"),
        ({"id": "other"}, "the file lacks claims that were declared: lpips"),
    ):
        write(path, content(**changes))
        assert message in refused("check", path, "--from", archive)
    for words, message in (
        (["--from", str(archive), "--dry-run"], "runs nothing"),
        (["--from", str(archive), "--out", "page.txt"], "a page ends in .html"),
        (["--out", "page.html"], "--out goes with --from"),
        (["train.iterations=5"], "settings of a check are in its file of claims"),
    ):
        assert message in refused("check", path, *words)


@pytest.mark.slow
def test_check_declares_before_it_runs_trials_and_repeats_its_page(runs, tmp_path, said):
    words = dict(word.split("=", 1) for word in TINY)
    settings = {key: yaml.safe_load(value) for key, value in words.items()}
    arms = {"few": {"init.count": 200}, "many": {"init.count": 300, "train.opacity": 0.03}}
    claim = content()["claims"][0] | {"baseline": "few", "arm": "many"}
    claims = [
        claim | {"id": "points"},
        claim | {"id": "size", "not_testable": "too large", "metric": "ssim"},
        claim | {"id": "texture", "metric": "error_textured", "direction": "lower", "least": "2%"},
    ]
    path = tmp_path / "claims.yaml"
    write(path, content() | {"settings": settings, "arms": arms, "claims": claims, "seeds": 2})
    assert "4 trials until the first look" in said("check", path, "--dry-run")
    assert not (runs / "check_it").exists()
    out = said("check", path)
    assert "  points: " in out
    assert "not testable here    size: too large" in out
    home = runs / "check_it"
    (declared,) = read_declarations(home)
    measured = [read_json(file)["measured"] for file in home.glob("*/*/*/results.json")]
    assert len(measured) == 4
    assert min(measured) >= declared.time
    first = (home / "claims.html").read_text()
    assert "opacity=0.03] differs from" in first
    assert "by init.count and learning rates" in first
    assert first.index("Fairness sheet: ") < first.index("what would refute it")
    assert '<th scope="row">init.count</th><td>200</td><td>300</td><td>≠</td>' in first
    said("check", path)
    assert (home / "claims.html").read_text() == first
    assert read_declarations(home) == [declared]


@pytest.mark.parametrize("key", ["allow_targets", "+allow_targets"])
def test_a_file_of_claims_allows_no_code(tmp_path, key, monkeypatch):
    """A stranger's claims may name a class; only the user who types the command may allow it."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "stranger.py").write_text(
        "from gsbench.densify import ADC\n\n\nclass Mine(ADC):\n    pass\n"
    )
    with refusal(r"no file can allow code to run: type allow_targets=\[…\]"):
        parse_claims(content() | {"settings": {key: ["stranger"]}})
    mine = {"densify": "adc", "densify._target_": "stranger.Mine", "densify.name": "mine"}
    file = parse_claims(content() | {"arms": {"adc": None, "volumetric": mine}})
    with refusal(r"stranger\.Mine is not gsbench's own"):
        prepare(file, tmp_path, lambda trials: [])
    check = prepare(file, tmp_path, lambda trials: [], ["allow_targets=[stranger]"])
    assert check.trials(2)[1].values["densify"]["_target_"] == "stranger.Mine"
