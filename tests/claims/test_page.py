"""The page of a check: which scenes its verdicts speak of, and where its trials were run."""

from __future__ import annotations

from dataclasses import replace

import pytest

from gsbench.analysis.results import TrialResult
from gsbench.claims.page import _scope, make_page, to_html, to_markdown
from gsbench.claims.verdict import NOT_TESTABLE, judge_claim
from tests.claims.test_sweep import DECLARED
from tests.claims.test_verdict import MakePairs, claim_with

SIX = tuple("abcdef")


@pytest.mark.parametrize(("scenes", "words"), [(SIX[:5], "these scenes"), (SIX, "scenes like these, which are")])
def test_from_six_scenes_on_verdicts_speak_of_scenes_like_these(
    make_pairs: MakePairs, scenes: tuple[str, ...], words: str
) -> None:
    claim, file = claim_with()
    found = judge_claim(claim, file, make_pairs(scenes=scenes, seeds=range(4)), scenes)
    untested = replace(found, word=NOT_TESTABLE, design=replace(found.design, scenes=11 - len(scenes)))
    assert _scope([found, untested]).startswith(words)
    assert "from six on" in _scope([found, replace(untested, word="undecided")])


def test_the_page_says_where_machines_and_clouds_of_its_trials_differ(make_pairs: MakePairs) -> None:
    """As where two machines shared a check: within a pair all is one, between pairs it is not."""
    claim, file = claim_with()
    pairs = make_pairs(scenes=("room",), seeds=range(2))

    def made_on(cpu: str, trial: TrialResult) -> TrialResult:
        machine = {"cpu": cpu, "architecture": "x86_64", "kernels": "znver4", "torch": "AVX512", "device": "cpu"}
        hashes = trial.record.hashes | {"cloud": 64 * cpu[0]}
        return replace(trial, record=replace(trial.record, machine=machine, hashes=hashes))

    def lines(cpus: tuple[str, str], archives: tuple[str, ...]) -> tuple[str, ...]:
        made = {key: tuple(made_on(cpus[key[1]], trial) for trial in pair) for key, pair in pairs.items()}
        verdict = judge_claim(claim, file, made, ("room",))
        assert len(verdict.trials) == 4
        return make_page(file, [verdict], DECLARED, [DECLARED], archives).lines

    mixed, plain = lines(("Abacus", "Brain"), ("share.zip",)), lines(("Abacus", "Abacus"), ())
    for words in ("Trials from share.zip count", "on 2 kinds of machine", "from 2 different clouds"):
        assert any(words in line for line in mixed), words
    assert not any(words in line for line in plain for words in ("count beside", "machine", "clouds"))


def test_where_scenes_differ_in_the_initialiser_a_sheet_stands_for_each(make_pairs: MakePairs) -> None:
    claim, file = claim_with()
    pairs = make_pairs(scenes=("courtyard", "room", "yard"), seeds=range(2))
    other = {
        key: tuple(
            replace(trial, record=replace(trial.record, init="dataset" if key[0] != "courtyard" else trial.init))
            for trial in pair
        )
        for key, pair in pairs.items()
    }
    page = make_page(file, [judge_claim(claim, file, other, ("courtyard", "room", "yard"))], DECLARED, [DECLARED])
    (section,) = page.sections
    counts = [line for sheet in section.fairness for line in sheet.notes if line.startswith("Compared")]
    assert [line.split()[1] for line in counts] == ["2", "4"]
    assert [seeds for _, seeds in section.trials] == ["seeds 0, 1"] * 6
    folders = [folder for folder, _ in section.trials]
    assert {trial.label.rpartition("-seed")[0] for pair in other.values() for trial in pair} == {*folders}
    for text in (to_markdown(page), to_html(page)):
        assert "dataset-volumetric against dataset-adc" in text
        assert "sfm-volumetric against sfm-adc" in text
