"""The page of a check on scenes like these, machines, clouds and initialisers."""

from dataclasses import replace

import pytest

from gsbench.analysis.judgement import judge
from gsbench.claims.check import Checked, claim_verdicts
from gsbench.claims.check_page import make_page, to_html, to_text
from gsbench.claims.file import parse_claims
from gsbench.runs.experiments import Declaration
from tests.analysis.helpers import trials_of
from tests.claims.test_check import content
from tests.trials import write_runs

EARLY = "2020-01-01T00:00:00Z"
SIZE = "nine scenes, 30,000 iterations"


def made(runs, scenes, seeds=4):
    write_runs(runs, scenes=scenes, seeds=range(seeds), scene_noise=0.0, effect={"psnr": 1.0})
    return list(trials_of(runs))


def page_of(trials):
    """The page of one claim about all scenes of the trials."""
    trials = list(trials)
    names = list(dict.fromkeys(trial.scene for trial in trials))
    file = parse_claims(
        content() | {"size": SIZE, "scenes": {name: {"scene": "courtyard"} for name in names}}
    )
    keys = {(trial.scene, trial.densify): trial.key for trial in trials}
    question = file.question(
        file.claims[0], {name: (keys[name, "adc"], keys[name, "volumetric"]) for name in names}
    )
    declared = Declaration(time=EARLY, questions=(question,), looks=file.looks)
    verdicts = claim_verdicts(file, declared, judge(trials, declared))
    return make_page(Checked(file, verdicts, declared, [declared]))


@pytest.mark.parametrize("scenes", ["abcde", "abcdef"])
def test_from_six_scenes_on_the_page_has_a_statement_about_scenes_like_these(tmp_path, scenes):
    page = page_of(made(tmp_path, tuple(scenes)))
    assert page.sections[0].verdict.word == "supported"
    assert ("scenes like these: better; it helps in 6 of 6" in to_text(page)) == (len(scenes) == 6)
    assert "A verdict is about these scenes" in to_text(page)
    assert f"The paper: {SIZE}." in to_text(page)


def test_the_page_notes_different_machines_and_clouds(tmp_path):
    trials = made(tmp_path, ("room",), seeds=2)

    def lines(cpus):
        found = []
        for trial in trials:
            cpu = cpus[trial.seed]
            machine = {"cpu": cpu, "kernels": "znver4", "torch": "AVX512", "device": "cpu"}
            hashes = trial.record.hashes | {"cloud": 64 * cpu[0]}
            record = replace(trial.record, machine=machine, hashes=hashes)
            found.append(replace(trial, record=record))
        return page_of(found).lines

    mixed, plain = lines(("Abacus", "Brain")), lines(("Abacus", "Abacus"))
    for words in ("on 2 kinds of machine", "from 2 different clouds"):
        assert any(words in line for line in mixed), words
    assert not any(words in line for line in plain for words in ("machine", "clouds"))


def test_each_initialiser_has_a_fairness_sheet_of_its_own(tmp_path):
    trials = made(tmp_path, ("courtyard", "room", "yard"), seeds=2)
    page = page_of(
        one
        if one.scene == "courtyard"
        else replace(one, record=replace(one.record, init="dataset"))
        for one in trials
    )
    (section,) = page.sections
    counts = [
        line for sheet in section.fairness for line in sheet.notes if line.startswith("Compared")
    ]
    assert [line.split()[1] for line in counts] == ["2", "4"]
    assert [seeds for _, seeds in section.trials] == ["seeds 0, 1"] * 6
    text = to_html(page)
    assert "dataset-volumetric against dataset-adc" in text
    assert "sfm-volumetric against sfm-adc" in text
