"""All answers of an experiment: badges, other questions, folded code, and what nobody asked."""

import itertools
import re
import shutil

import pytest

from gsbench.analysis.comparison import compare
from gsbench.analysis.results import load_experiment
from gsbench.analysis.tables import build_table
from tests.analysis.helpers import loaded, page_of
from tests.helpers import change_json
from tests.trials import ask_about, write_arms, write_runs, write_trial

SCHEDULE = ("densify_stop", "mcmc_stop", "opacity_reset_interval")
CLEAR = {"effect": {"psnr": 3.0, "ssim": 0.5}}


def answers(runs, **how):
    return compare(loaded(runs), **how).answers


def badges(runs):
    return {str(one.arm): one.badge for one in answers(runs)}


def write_mine(runs, version, psnr, settings=None, seeds=(0, 1, 2), scene="courtyard"):
    """Trials of a user's densifier whose module has this version."""
    sources = {"sources": {"mine": version * 64}}
    key = f"{hash((version, str(settings))) % 2**32:08x}"
    for seed in seeds:
        write_trial(
            runs,
            seed,
            key,
            settings,
            scene=scene,
            densify="mine",
            _code=sources,
            psnr=psnr + 0.01 * seed,
        )


def write_adc(runs, seeds=(0, 1, 2), scene="courtyard"):
    for seed in seeds:
        write_trial(runs, seed, scene=scene, psnr=20 + 0.02 * seed)


def of(version):
    """Trials of the baseline, and of this version of the user's module."""
    return lambda trial: trial.record.code.sources.get("mine", version * 64) == version * 64


def test_the_badge_is_that_of_the_question_and_other_metrics_are_not_tested(tmp_path):
    write_runs(tmp_path, **CLEAR)
    ask_about(tmp_path)
    (answer,) = answers(tmp_path)
    assert answer.badge == "BETTER"
    assert answer.sentence.startswith("sfm-volumetric against sfm-adc: better in PSNR (dB) on")
    assert {one.quantity.key for one in answer.metrics} == {"ssim", "lpips_vgg_raw", "flip"}
    assert {one.state for one in answer.metrics} == {"not tested"}
    assert compare(loaded(tmp_path)).risk.startswith("1 question, 1 statement;")


def test_what_nobody_asked_has_an_interval_and_no_verdict(tmp_path):
    write_runs(tmp_path, **CLEAR)
    (answer,) = answers(tmp_path)
    assert (answer.badge, answer.verdict.outcome) == ("NOT ASKED", "undecided")
    assert answer.verdict.interval.low > 2
    assert compare(loaded(tmp_path)).risk == ""


def test_arms_that_were_asked_about_are_not_shown_again_the_other_way_round(tmp_path):
    """A sweep lists its baseline first, and the folders of its arms have another order."""
    for low, key, psnr in (("0.01", "a", 21.0), ("0.005", "b", 20.0)):
        settings = {"densify": {"name": "adc", "prune_opacity": low}}
        for seed in range(3):
            write_trial(tmp_path, seed, key * 8, settings, psnr=psnr + 0.02 * seed * seed)
    ask_about(tmp_path, turned=True)
    (answer,) = answers(tmp_path)
    assert answer.badge == "BETTER"
    assert dict(answer.arm.variant) == {"densify.prune_opacity": "0.01"}


def test_another_baseline_that_is_chosen_later_is_not_tested(tmp_path):
    write_runs(tmp_path, **CLEAR)
    ask_about(tmp_path)
    (answer,) = answers(tmp_path, baseline="volumetric")
    assert (str(answer.arm), answer.badge) == ("sfm-adc", "NOT TESTED")


def test_seeds_that_are_added_until_it_pleases_cost_level(tmp_path):
    write_runs(tmp_path, scenes=("garden",), seeds=range(6))
    levels = [
        ask_about(tmp_path, lambda trial, n=n: trial.seed < n)[0].level for n in (2, 3, 4, 5, 6)
    ]
    assert levels == pytest.approx([0.05 * 2 / (n * (n + 1)) for n in range(1, 6)])
    (answer,) = answers(tmp_path)
    assert answer.verdict.question.n == 5
    assert [one.question.n for one in answer.others] == [4, 3, 2, 1]


def test_a_scene_of_the_next_day_folds_nothing_away(tmp_path):
    write_runs(tmp_path, scenes=("garden", "room"), **CLEAR)
    for scene in ("garden", "room"):
        ask_about(tmp_path, lambda trial, scene=scene: trial.scene == scene)
    experiment = loaded(tmp_path)
    assert len(experiment.trials) == 12
    (answer,) = answers(tmp_path)
    assert [*answer.verdict.question.seeds] == ["room"]
    assert [[*one.question.seeds] for one in answer.others] == [["garden"]]


def test_the_code_of_an_idea_is_that_of_its_newest_question_from_any_folder(tmp_path, monkeypatch):
    write_adc(tmp_path)
    ask_about(tmp_path)
    for version, psnr in (("1", 25.0), ("2", 15.0)):
        write_mine(tmp_path, version, psnr)
        ask_about(tmp_path, of(version))
    shown = []
    for folder, text in (("a", "x = 1"), ("b", "x = 2")):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "mine.py").write_text(text)
        monkeypatch.chdir(tmp_path / folder)
        shown.append(compare(loaded(tmp_path)).to_json())
    assert shown[0] == shown[1]
    (answer,) = answers(tmp_path)
    assert (answer.badge, answer.verdict.question.n) == ("WORSE", 2)
    assert {trial.metrics["psnr"] < 21 for trial in loaded(tmp_path).trials} == {True}


def test_after_an_edit_rows_that_were_not_trained_again_are_folded_as_earlier_code(tmp_path):
    """Edit `candidates()` and run one of three settings again: one version in the table."""
    write_adc(tmp_path)
    settings = [{"densify.decay": k} for k in (1, 2, 3)]
    for own in settings:
        write_mine(tmp_path, "1", 25.0, own)
    ask_about(tmp_path)
    write_mine(tmp_path, "2", 15.0, settings[1])
    ask_about(tmp_path, of("2"))
    experiment = loaded(tmp_path)
    assert len(experiment.older) == 9
    (line,) = experiment.versions
    assert "9 trials of sfm-mine made by earlier versions of mine" in line
    shown = [trial for trial in experiment.trials if trial.densify == "mine"]
    assert {trial.record.code.sources["mine"][0] for trial in shown} == {"2"}
    newest, *earlier = answers(tmp_path)
    assert (newest.badge, newest.verdict.question.n, newest.earlier) == ("WORSE", 2, False)
    assert len(earlier) == 3
    assert all(one.sentence.endswith(" (earlier code)") for one in earlier)


def test_what_another_experiment_asked_about_the_same_trials_is_not_asked_here(tmp_path):
    write_runs(tmp_path, **CLEAR)
    ask_about(tmp_path)
    copy = shutil.copytree(tmp_path / "exp", tmp_path / "copy")
    (copy / "commands.jsonl").unlink()
    for path in copy.glob("*/*/*/results.json"):
        change_json(path, questions=[], experiment="copy")
    (answer,) = compare(load_experiment(tmp_path, "copy")).answers
    assert answer.badge == "NOT ASKED"
    (there,) = answers(tmp_path)
    assert there.badge == "BETTER"


def test_the_page_of_an_idea_waits_for_the_trials_of_its_baseline(tmp_path):
    write_runs(tmp_path, densifiers=("volumetric",))
    ask_about(tmp_path)
    page = page_of(tmp_path)
    assert "no command has planned the others yet, such as sfm-adc" in page
    assert "nan" not in re.findall(r"\w+", page)
    assert "nothing to compare" not in page


def test_one_setting_stands_for_a_schedule(tmp_path):
    for length in (30_000, 7000):
        steps = {f"train.{key}": length // part for part, key in enumerate(SCHEDULE, 2)}
        for densify, seed in itertools.product(("adc", "mine"), (0, 1)):
            own = {"densify": densify, "_iterations": length, "psnr": 20.0 + seed}
            write_trial(tmp_path, seed, f"{length:08x}", steps, **own)
    table = build_table(loaded(tmp_path))
    assert table.row_headings == ("scene", "init", "densify", "train.iterations")
    assert "train.iterations stands for train.densify_stop, train.mcmc_stop, " in table.notes[1]


def test_a_trial_of_no_question_is_named(tmp_path):
    write_runs(tmp_path, scenes=("garden",), seeds=range(4), **CLEAR)
    ask_about(tmp_path, lambda trial: trial.seed < 3)
    remarks = [*map(str, compare(loaded(tmp_path)).remarks)]
    assert any("whose question did not name them" in line and "seed3" in line for line in remarks)


def test_arms_of_one_command_keep_their_names_among_later_settings(tmp_path):
    write_arms(tmp_path, {"adc": {}, "mine": {"decay": 1}})
    ask_about(tmp_path)
    write_arms(tmp_path / "more", {"mine": {"decay": 2}})
    for path in (tmp_path / "more").glob("exp/*/*/*"):
        path.rename(tmp_path / path.relative_to(tmp_path / "more"))
    names = {str(one.arm) for one in answers(tmp_path)}
    assert names == {"sfm-mine[decay=1]", "sfm-mine[decay=2]"}


def test_a_broken_link_among_the_commands_is_a_warning(tmp_path):
    write_runs(tmp_path, **CLEAR)
    ask_about(tmp_path)
    file = tmp_path / "exp/commands.jsonl"
    file.write_text(file.read_text() * 2)
    experiment = loaded(tmp_path)
    assert any("does not follow the one before it" in line for line in experiment.warnings)
    assert badges(tmp_path) == {"sfm-volumetric": "BETTER"}


@pytest.mark.parametrize("name", ["declared.jsonl", "ledger.jsonl"])
def test_what_an_earlier_gsbench_asked_is_not_tested(tmp_path, name):
    write_runs(tmp_path, **CLEAR)
    (tmp_path / "exp" / name).touch()
    assert badges(tmp_path) == {"sfm-volumetric": "NOT TESTED"}
    assert "not tested, since" in answers(tmp_path)[0].sentence
    assert name in answers(tmp_path)[0].sentence
