"""Trials of several machines or initial clouds are averaged and compared, always with a note."""

from gsbench.analysis.fairness import fairness_table
from gsbench.runs.experiments import Arm
from gsbench.verbs.results import explain_cell
from tests.analysis.helpers import page_of, table_of, trials_of
from tests.trials import write_trial

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


def test_compared_arms_with_unlike_clouds_are_marked_in_their_sheet(tmp_path):
    for densify, cloud in (("adc", A), ("volumetric", B)):
        write_trial(tmp_path, psnr=27.0, densify=densify, _hashes=hashes(cloud))
    sheet = fairness_table(trials_of(tmp_path), Arm("sfm", "adc"), Arm("sfm", "volumetric"))
    (row,) = [row for row in sheet.rows if row.labels == ("initial cloud (hash)",)]
    assert [entry.text for entry in row.entries] == [A[:12], B[:12], "≠"]
