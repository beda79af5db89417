"""``gsbench judge``: tables of other trainers' results, questions before and after the training."""

import zipfile
from shlex import split

import numpy as np
import pandas as pd
import pytest

from gsbench.cli import run
from tests.analysis.test_frames import FRAME

ASKED = "--baseline base --methods mine,other --scenes garden,room --seeds 0,1,2 --least .1"


@pytest.fixture
def table(tmp_path):
    FRAME.to_csv(tmp_path / "r.csv", index=False)
    return tmp_path / "r.csv"


def test_a_table_gets_its_verdicts_with_their_condition_and_a_report(table, said):
    out = said("judge", table, *split("--baseline base --out"), table.with_suffix(".html"))
    assert "- BETTER: mine against base: better in PSNR (dB) on these scenes: +" in out
    assert out.count("It holds if metric, scenes and seeds were chosen before") == 2
    assert "| mean of 2 scenes | mine | **" in out
    assert '<span class="badge better">BETTER' in table.with_suffix(".html").read_text()


def test_a_question_written_before_takes_the_condition_away(table, said, refused):
    file = table.parent / "q.json"
    assert said("judge", "--declare", file, *split(ASKED)) == f"{file}: 2 questions, 18 trainings\n"
    out = said("judge", table, "--declared", file)
    assert "- BETTER: mine against base: better in PSNR (dB)" in out
    assert "It holds if" not in out
    assert "is there already" in refused("judge", "--declare", file, *split(ASKED))
    assert "0.1 was declared" not in out
    assert ".1 was declared" in refused("judge", table, "--declared", file, "--least", "0.2")


def test_a_declared_question_waits_for_all_its_trainings(table, said):
    file = table.parent / "q.json"
    said("judge", "--declare", file, *split(ASKED))
    frame = pd.read_csv(table)
    frame[~((frame.method == "mine") & (frame.seed == 2))].to_csv(table, index=False)
    out = said("judge", table, "--declared", file)
    assert "- STOPPED 10/12: mine against base: no verdict without all its trials" in out


def test_a_training_without_a_value_favours_no_method(table, said):
    frame = pd.read_csv(table)
    frame.loc[(frame.method == "mine") & (frame.seed == 2), "psnr"] = np.nan
    frame.to_csv(table, index=False)
    out = said("judge", table, "--baseline", "base")
    assert "- UNDECIDED: mine against base: undecided, since 2 trials of one arm alone" in out
    # notes name methods as the table does
    assert "measured as they are (its conditions are not known): base, mine, other." in out
    assert "r/garden/mine/row-seed2" in out


@pytest.mark.parametrize(
    "words, message",
    [
        ("", "needs --baseline"),
        ("--baseline bas", "did you mean base"),
        ("--baseline base --metric ssim", "no column 'ssim'"),
        ("--baseline base --metric blur", "say whether more is better"),
        ("--baseline base scene=garden", "for a folder of renders"),
        ("--declared nowhere.json", "no such file"),
    ],
)
def test_bad_words_are_refused_in_one_line(table, refused, words, message):
    assert message in refused("judge", table, *split(words))


def test_what_is_no_table_is_refused(tmp_path, refused):
    (tmp_path / "a.csv").write_bytes(b"\x00\xff\x80")
    assert "is no table" in refused("judge", tmp_path / "a.csv", "--baseline", "x")
    assert "no such file" in refused("judge", tmp_path / "b.csv", "--baseline", "x")
    assert run(["judge", str(tmp_path), "--baseline", "x"]) == 2


def test_an_archive_is_named_with_what_shows_it(tmp_path, refused):
    with zipfile.ZipFile(tmp_path / "demo.zip", "w") as archive:
        for number in range(100):
            archive.writestr(f"demo/garden/sfm-adc/aaaaaaaa-seed{number}/results.json", "{}")
    line = refused("judge", tmp_path / "demo.zip", "--baseline", "x")
    assert "`gsbench site` shows archives" in line
    assert len(line) < 500


def test_a_column_of_counts_decides_and_fewer_is_better(table, said):
    FRAME.assign(gaussians=1000 - FRAME.psnr).to_csv(table, index=False)
    out = said("judge", table, "--baseline", "base", "--metric", "gaussians")
    assert "- BETTER: mine against base: better in Gaussians on these scenes: −" in out
