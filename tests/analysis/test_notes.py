"""Notes below tables, word for word, for made-up trials with known numbers."""

import itertools
from types import SimpleNamespace

import pytest

from gsbench.analysis.fairness import counts_notes, equal_counts_advice
from gsbench.analysis.notes import Note, texts
from gsbench.analysis.table_notes import doubt_notes, held_out_notes, origin_notes, points_notes
from gsbench.runs.experiments import Arm
from gsbench.runs.trial_record import (
    FROM_MODEL,
    FROM_RENDERS,
    ExternalTrainer,
    Oddity,
)
from gsbench.verbs.results import explain_cell
from tests.analysis.helpers import ADC, VOLUMETRIC, loaded, page_of, table_of
from tests.analysis.tables import TABLES
from tests.helpers import read_json, write
from tests.trials import with_record, write_runs, write_trial

EQUAL = "To compare at equal ones: "


def trials_of(tmp_path, **plan):
    write_runs(tmp_path, **plan)
    return loaded(tmp_path).trials


@pytest.mark.parametrize(
    "counts, said",
    TABLES["unequal counts"],
)
def test_unequal_counts_are_stated_over_the_scenes_that_both_arms_have(tmp_path, counts, said):
    made = trials_of(tmp_path, scenes=list(counts))
    trials = []
    for trial in made:
        count = counts[trial.scene][trial.densify == "volumetric"]
        trials.append(with_record(trial, num_gaussians=count, num_init_points=50))
    notes = texts(counts_notes(trials, [(ADC, VOLUMETRIC)]))
    if said:  # no limit can be below the initial cloud
        larger = [with_record(trial, num_init_points=10_000) for trial in trials]
        words = f"{EQUAL}start all arms with fewer than 10,000 points"
        assert words in str(*counts_notes(larger, [(ADC, VOLUMETRIC)]))
    least = min(filter(None, itertools.chain(*counts.values())))
    words = f"give all arms densify.cap=governor densify.max_gaussians={least} and another name."
    line = f"Unequal numbers of Gaussians: sfm-volumetric {said} than sfm-adc. {EQUAL}{words}"
    assert notes == ([line] if said else [])
    assert counts_notes(trials, [(ADC, Arm("sfm", "mcmc"))]) == []


def test_one_sentence_names_all_arms_with_unequal_counts(tmp_path):
    arms = {"a": 150, "adc": 100, "b": 60, "equal": 101}
    made = trials_of(tmp_path, scenes=["garden"], densifiers=[*arms])
    trials = [with_record(one, num_gaussians=arms[one.densify], num_init_points=50) for one in made]
    pairs = [(ADC, Arm("sfm", name)) for name in arms if name != "adc"]
    (note,) = texts(counts_notes(trials, pairs))
    assert note.startswith(
        "Unequal numbers of Gaussians: sfm-a 50 % more and sfm-b 40 % fewer than sfm-adc. "
    )
    assert note.endswith(
        "give all arms densify.cap=governor densify.max_gaussians=60 and another name."
    )


def test_arms_that_the_governor_did_not_make_equal_need_a_longer_training():
    def advice(*budgets):
        keys = ("densify.cap", "densify.max_gaussians")
        record = SimpleNamespace(num_init_points=5, num_gaussians=9)
        return equal_counts_advice(
            [
                SimpleNamespace(config=dict(zip(keys, b, strict=True)), record=record)
                for b in budgets
            ]
        )

    assert advice(("governor", 9), ("governor", 9)).startswith("train longer, since the governor")
    for others in ((("governor", 9), ("governor", 8)), (("soft", 9), ("soft", 9))):
        assert advice(*others).startswith("give all arms densify.cap=governor")


@pytest.mark.parametrize("rounds, warns", [(0, True), (1, True), (4, True), (5, False)])
def test_a_table_warns_of_too_few_rounds(tmp_path, rounds, warns):
    (trial,) = trials_of(tmp_path, scenes=["garden"], densifiers=("adc",), seeds=(0,))
    config = read_json(trial.path / "config.yaml")
    config["densify"]["interval"] = 100
    write(trial.path / "config.yaml", config)
    (trial.path / "events.jsonl").write_text('{"step": 100, "cloned": 1}\n' * rounds)
    words = f"sfm-adc: {rounds} round{'s' * (rounds != 1)} of refinement in 2000 iterations"
    page = page_of(tmp_path)
    notes = table_of(tmp_path).notes
    assert any(note.startswith(words) for note in notes) == warns
    assert (words in page) == warns


def test_each_way_of_holding_views_out_is_stated_with_scenes_if_there_are_several(tmp_path):
    made = trials_of(tmp_path, seeds=(0, 1))
    alike = [
        with_record(trial, held_out="every 8th image", test_views=6, train_views=42)
        for trial in made
    ]
    (note,) = held_out_notes(alike)
    assert str(note) == "Held out: every 8th image; 6 of 48 views."
    unlike = [
        with_record(trial, held_out="by lists", test_views=5) if trial.scene == "garden" else trial
        for trial in alike
    ]
    assert texts(held_out_notes(unlike)) == [
        "Held out, garden: by lists; 5 of 47 views.",
        "Held out, courtyard: every 8th image; 6 of 48 views.",
    ]
    one_scene = [trial for trial in unlike if trial.scene == "garden"]
    one_scene[0] = with_record(one_scene[0], held_out="by hand")
    assert [(note["rule"], note["scenes"]) for note in held_out_notes(one_scene)] == [
        ("by lists", ""),
        ("by hand", ""),
    ]
    uneven = [with_record(trial, test_views=6 + trial.seed) for trial in alike]
    assert held_out_notes(uneven)[0]["views"] == "6 of 48 views and 7 of 49 views"
    assert held_out_notes([with_record(trial, held_out="") for trial in made]) == []


def test_the_views_behind_initial_points_are_stated_once_per_initialiser(tmp_path):
    for path in write_runs(
        tmp_path, inits=("sfm", "dim", "random"), seeds=(0,), scenes=("garden",)
    ):
        config = read_json(path / "config.yaml")
        config["init"] |= {"sfm": {"points_from": "all"}, "dim": {"points_from": "train"}}.get(
            config["init"]["name"], {}
        )
        write(path / "config.yaml", config)
    made = loaded(tmp_path).trials
    some, every = points_notes(made)
    assert some == Note.of("points of some", init="dim", choice="train")
    assert every == Note.of("points of all", init="sfm", choice="all")
    observed = [with_record(trial, init_report={"mean_track_length": 3.1}) for trial in made]
    assert Note.of("points of all", init="random", choice="all") in points_notes(observed)
    assert points_notes([trial for trial in made if trial.init == "random"]) == []


def test_results_that_are_worth_little_or_may_surprise_are_noted_once(tmp_path):
    made = trials_of(tmp_path, seeds=(0, 1), scenes=("garden",), densifiers=("adc",))
    odd = [
        Oddity(rule="near-twins", line="1 of 6 test views have a near twin", value=1.0),
        Oddity(rule="panorama", line="3 photographs are panoramas", value=3.0, refused=True),
    ]
    changes = {
        "one_color_psnr": made[0].metrics["psnr"],
        "raster_passed_over": ["raster=triton is not used: alpha is off"],
        "oddities": odd,
    }
    psnr = f"{made[0].metrics['psnr']:.2f}"
    second = with_record(made[1], **{**changes, "one_color_psnr": made[1].metrics["psnr"] - 0.1})
    assert texts(doubt_notes([with_record(made[0], **changes), second])) == [
        f"(!) {made[0].label} is not better than one colour: PSNR {psnr} dB, the training views' "
        f"mean colour has {psnr}.",
        "raster=triton is not used: alpha is off.",
        "garden sfm: 1 of 6 test views have a near twin.",
        "garden sfm, accepted by scene.accept=[panorama]: 3 photographs are panoramas.",
    ]
    assert doubt_notes(made) == []
    both = [with_record(one, one_color_psnr=99.0) for one in made]
    (line,) = texts(doubt_notes(both))
    assert line.startswith(f"(!) {made[0].label} is not better than one colour: ")
    assert line.endswith("; the same holds for 1 more trial.")


@pytest.mark.parametrize("lost, rest", [(1, ""), (3, ""), (4, " and 1 more"), (5, " and 2 more")])
def test_up_to_three_left_out_trials_are_named_and_all_are_counted(tmp_path, lost, rest):
    paths = write_runs(tmp_path)
    for path in paths[:lost]:
        (path / "results.json").unlink()
    (note,) = [note for note in table_of(tmp_path).notes if note.startswith("Left out")]
    assert note.startswith(f"Left out ({lost}): exp/courtyard/")
    assert note.count("unfinished") == min(lost, 3)
    assert note.endswith(f"{rest}.")
    assert ("more" in note) == bool(rest)


def test_who_trained_an_arm_and_what_was_measured_is_said(tmp_path):
    first, second, third = trials_of(tmp_path, scenes=("yard",), densifiers=("adc",))
    program = ExternalTrainer(program="brush", version="1.2")
    here = with_record(first, trained_by=program, evaluated_from=FROM_MODEL)
    assert origin_notes([first]) == []
    assert texts(origin_notes([here, with_record(second, evaluated_from=FROM_RENDERS)])) == [
        "Trained here by another program, its model rendered by gsbench (its time is that of the "
        "whole program, and it sets its own budget): sfm-adc (version 1.2).",
        "Renders of another program, measured as they are (its conditions are not known): sfm-adc.",
    ]
    renders = with_record(first, trained_by=program, evaluated_from=FROM_RENDERS)
    own, elsewhere = origin_notes([renders, with_record(third, evaluated_from=FROM_MODEL)])
    assert (own.kind, own["arms"]) == ("program's renders", ("sfm-adc (version 1.2)",))
    assert (elsewhere.kind, elsewhere["arms"]) == ("foreign model", ("sfm-adc",))


# ---- several machines and clouds

XEON = {"cpu": "Xeon", "kernels": "skylake-avx512", "torch": "AVX512", "device": "cpu"}
RYZEN = XEON | {"cpu": "Ryzen", "kernels": "znver3", "torch": "AVX2"}
A, B = "a" * 64, "b" * 64


def notes_of(runs):
    return list(table_of(runs, "psnr").notes)


def hashes(cloud, init="init1"):
    return {"data": "d", "init": init} | ({} if cloud is None else {"cloud": cloud})


def test_trials_of_several_machines_are_averaged_and_the_table_says_so(tmp_path):
    for seed, machine in enumerate((XEON, RYZEN, XEON, None)):
        write_trial(tmp_path, seed, psnr=27.0, _machine=machine)
    (note,) = (note for note in notes_of(tmp_path) if "machine" in note)
    assert "2 kinds of machine" in note
    kinds = (
        "Xeon (skylake-avx512, torch AVX512): 2 trials; Ryzen (znver3, torch AVX2): 1 trial; "
        "not recorded: 1."
    )
    assert kinds in note
    assert "2 kinds of machine" in page_of(tmp_path)
    assert "machine   Ryzen (znver3, torch AVX2)" in explain_cell("exp:garden:psnr:adc", tmp_path)


def test_one_kind_of_machine_or_none_recorded_gives_no_note(tmp_path):
    write_trial(tmp_path, psnr=27.0, _machine=XEON)
    write_trial(tmp_path, 1, psnr=27.0)
    assert not any("machine" in note for note in notes_of(tmp_path))


def test_two_clouds_of_one_initialiser_are_noted(tmp_path):
    for seed, densify, cloud in ((0, "adc", A), (1, "adc", B), (0, "volumetric", A)):
        write_trial(tmp_path, seed, psnr=27.0, densify=densify, _hashes=hashes(cloud))
    assert (
        "garden: trials of init sfm started from 2 different clouds (aaaaaaaa: adc seed 0; "
        "volumetric seed 0; bbbbbbbb: adc seed 1)."
    ) in notes_of(tmp_path)
