"""The same trials give the same answer by a sweep, a check, a gate and a ledger, on each surface."""

import html
import os
import tempfile
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsbench.analysis.comparison import compare, unused_trials
from gsbench.analysis.looks import plan_looks
from gsbench.analysis.notes import texts
from gsbench.analysis.verdict_words import in_words, numbers
from gsbench.claims import gate as gates
from gsbench.claims import ledger as rules
from gsbench.claims import stopping
from gsbench.claims.check import Checked, claim_verdicts
from gsbench.claims.check_page import make_page, to_html, to_text
from gsbench.claims.file import parse_claims
from gsbench.claims.stopping import SequentialTest
from gsbench.runs.experiments import Arm, Declaration, Question
from gsbench.runs.ledger import Ledger, Opened, Promoted, Started
from gsbench.tracking.comparison import description
from gsbench.verbs.results import tables
from tests.analysis.helpers import EARLY, loaded, page_of, table_of, trials_of, write_declared
from tests.claims.test_check import content
from tests.helpers import read_json
from tests.trials import write_trial

LEAST = 0.1
EXAMPLES = int(os.environ.get("GSBENCH_EXAMPLES", "12"))


@st.composite
def experiments(draw):
    """Trials of two arms {(arm, scene, seed): PSNR}, of which some are missing."""
    scenes, seeds = draw(st.sampled_from(["a", "ab"])), draw(st.integers(2, 4))
    effect = draw(st.sampled_from([-1.0, -0.05, 0.0, 0.02, 0.3, 1.0]))
    noise = draw(st.sampled_from([0.0, 0.003, 0.05, 0.5]))
    rng = np.random.default_rng(draw(st.integers(0, 99)))
    places = [
        (arm, scene, seed) for arm in ("adc", "mine") for scene in scenes for seed in range(seeds)
    ]
    missing = draw(st.sets(st.sampled_from(places), max_size=2))
    values = {one: 25 + effect * (one[0] == "mine") + rng.normal(0, noise) for one in places}
    return scenes, seeds, {one: value for one, value in values.items() if one not in missing}


def write(runs, seeds, scenes, values):
    """Write the trials, and their declaration as a sweep that stops when decided."""
    for (arm, scene, seed), psnr in values.items():
        measured = "2021-01-01T00:00:00Z"
        write_trial(runs, seed, scene=scene, densify=arm, psnr=psnr, _measured=measured)
    question = Question(
        metric="psnr",
        least=LEAST,
        baseline=Arm("sfm", "adc"),
        arm=Arm("sfm", "mine"),
        scenes={scene: keys(scene) for scene in scenes},
        seeds=tuple(range(seeds)),
    )
    declared = Declaration(time=EARLY, questions=(question,), looks=plan_looks(seeds))
    write_declared(runs, declared)


def keys(scene):
    return f"{scene}/sfm-adc/c0ffee00", f"{scene}/sfm-mine/c0ffee00"


def by_check(scenes, seeds, trials):
    own = content(least=LEAST) | {"seeds": seeds, "scenes": dict.fromkeys(scenes)}
    file = parse_claims(own | {"scenes": {name: {"scene": "courtyard"} for name in scenes}})
    question = file.question(file.claims[0], {scene: keys(scene) for scene in scenes})
    declared = Declaration(time=EARLY, questions=(question,), looks=file.looks)
    judged = SequentialTest(declared, lambda: trials).verdicts()
    verdicts = claim_verdicts(file, declared, judged)
    checked = Checked(file, verdicts, declared, [declared], unused_trials(trials, judged))
    page = make_page(checked)
    return judged[0], {"text": to_text(page), "page": html.unescape(to_html(page))}


def by_gate(scenes, seeds, trials):
    declared = gates.declare_gate(
        "psnr",
        str(LEAST),
        dict.fromkeys(scenes, ("sfm-adc", "sfm-mine")),
        range(seeds),
        {"eval": {}},
    )
    sides = ([one for one in trials if one.densify == arm] for arm in ("adc", "mine"))
    old, new = (lambda own=own: own for own in sides)
    asked = gates.ask_gate(Declaration(**vars(declared) | {"time": EARLY}), old, new)
    (verdict,) = asked.verdicts()
    left_out = texts(unused_trials([*asked.read()], [verdict]))
    return verdict, {"text": "\n".join([gates.describe(verdict), *left_out])}


def by_ledger(scenes, seeds, trials):
    baseline, idea = ({scene: keys(scene)[side] for scene in scenes} for side in (0, 1))
    opened = Opened(
        time=EARLY,
        metric="psnr",
        sign=1,
        least=LEAST,
        ideas=4,
        rate=0.1,
        words=(),
        keys=baseline,
        seeds=tuple(range(seeds)),
    )
    started = Started(time=EARLY, idea="mine", against="baseline", identity="", words=(), keys=idea)
    # one side of 2.5 % is an interval of 95 %
    test = Promoted(time=EARLY, idea="mine", level=0.025, seeds=tuple(range(seeds)))
    book = Ledger((opened, started, test), "")
    asked = rules.ask_idea(rules.test_of(book, "mine"), lambda: trials)
    (verdict,) = asked.verdicts()
    ended = rules.end_of("mine", verdict, EARLY)
    return verdict, {"text": "\n".join([ended.reason, *texts(rules.unused(book, trials))])}


def facts(verdict):
    """All that an answer is made of."""
    return verdict.outcome, verdict.mean, verdict.interval, verdict.pairs.seeds, verdict.equal


@settings(max_examples=EXAMPLES, deadline=None)
@given(experiments())
def test_each_verb_gives_the_same_answer_and_names_each_trial(made):
    scenes, seeds, values = made
    with tempfile.TemporaryDirectory() as folder:
        runs = Path(folder)
        (runs / "exp").mkdir()
        write(runs, seeds, scenes, values)
        experiment = loaded(runs)
        trials = list(experiment.trials)
        comparison = compare(experiment)
        found = {
            verb: ask(scenes, seeds, trials)
            for verb, ask in (("check", by_check), ("gate", by_gate), ("ledger", by_ledger))
        }
        answers = [one.verdicts[0] for one in comparison.answers if one.verdicts]
        check = found["check"][0]
        for verb, (verdict, said) in found.items():
            assert facts(verdict) == facts(check), verb
            for trial in trials:
                used = trial.path in {one.path for one in verdict.pairs.trials}
                assert used or trial.seed >= verdict.pairs.seeds, verb
            if len(verdict.pairs.trials) < len(trials):
                assert "In no verdict: " in said["text"], verb
        if check.untestable is None and check.interval is not None:
            assert [facts(one) for one in answers] == [facts(check)]
            shown = numbers(check)
            assert all(
                shown in said for verb in ("check", "gate") for said in found[verb][1].values()
            )
            surfaces(runs, experiment, comparison, in_words(check))


def surfaces(runs, experiment, comparison, words):
    """Check that each surface of the sweep states a verdict in these words."""
    assert words in comparison.sentences[0]
    assert words in "\n".join(table_of(runs).notes)
    assert words in html.unescape(page_of(runs))
    assert words in description(experiment)
    with pytest.MonkeyPatch.context() as monkeypatch:
        lines = []
        monkeypatch.setattr(stopping.log, "info", lambda form, *facts: lines.append(form % facts))
        stopping.log_verdicts([SimpleNamespace(files=SimpleNamespace(home=runs / "exp"))])
    assert words in next(line for line in lines if " against " in line)
    assert tables(["exp", "--format", "json", "--out", str(runs / "verdicts")], runs) == 0
    (file,) = (runs / "verdicts").glob("*.json")
    (pair,) = read_json(file)["pairs"]
    assert words in pair["sentence"]


@pytest.mark.parametrize("verb", [by_check, by_gate, by_ledger])
def test_a_trial_after_the_look_that_decided_is_named_with_the_reason(tmp_path, verb):
    values = {
        (a, "a", k): 25.0 + (a == "mine") + 0.001 * k * (a == "adc")
        for a in ("adc", "mine")
        for k in range(4)
    }
    (tmp_path / "exp").mkdir()
    write(tmp_path, 4, "a", values)
    trials = list(trials_of(tmp_path))
    verdict, said = verb("a", 4, trials)
    assert verdict.pairs.seeds == 2
    assert "(the question was decided with 2 seeds)" in said["text"]
