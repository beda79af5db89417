"""Published numbers of other papers: each says where it was read, and ours are held against the printed digits."""

from __future__ import annotations

from pathlib import Path

import pytest

from gsbench.analysis.published import load_published, published_names, published_table
from gsbench.analysis.results import load_experiment
from gsbench.errors import InputError
from gsbench.eval.facts import find
from gsbench.system.install import conf_dir
from gsbench.verbs import tables
from tests.analysis.test_tables import one_trial, texts


@pytest.mark.parametrize("name", published_names())
def test_every_paper_names_its_source_and_has_sane_numbers(name: str) -> None:
    paper = load_published(name)
    assert paper.title
    assert "github.com/" in paper.source or "arxiv.org/" in paper.source
    assert paper.conventions
    assert all(find(key) is not None for key in paper.quantities)
    bounds = {"psnr": (10, 45), "ssim": (0.3, 1), "lpips_vgg_raw": (0, 1)}
    for (_, key), printed in paper.printed.items():
        low, high = bounds[key]
        assert low < printed.value < high


@pytest.mark.parametrize("name", published_names())
def test_scenes_and_methods_are_called_as_gsbench_calls_them(name: str) -> None:
    paper = load_published(name)
    assert all((conf_dir() / "scene" / f"{scene}.yaml").is_file() for scene, _ in paper.printed)
    assert (conf_dir() / "densify" / f"{paper.densify}.yaml").is_file()


def test_ours_stand_beside_the_printed_numbers(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for seed, psnr in enumerate((27.41, 27.41, 27.41)):
        one_trial(tmp_path, seed, psnr=psnr, ssim=0.9, lpips_vgg_raw=0.2)
    one_trial(tmp_path, 0, psnr=1.0, _scene="nowhere")
    table = published_table(load_experiment(tmp_path, "exp").trials, "3dgs")
    assert texts(table) == [["garden", "sfm", "adc", "27.410", "+0.000 =", "0.868", "+0.032 ≠", "0.103", "+0.097 ≠"]]
    assert any(note.startswith("Read from github.com/nerfbaselines") for note in table.notes)
    assert tables.main(["exp", "--paper", "3dgs"], tmp_path) == 0
    assert "### Difference from 3dgs" in capsys.readouterr().out


def test_what_cannot_be_compared_is_said(tmp_path: Path) -> None:
    one_trial(tmp_path, 0, psnr=1.0, _scene="nowhere")
    with pytest.raises(InputError, match="no trial here is of one of them"):
        published_table(load_experiment(tmp_path, "exp").trials, "3dgs-mcmc")
    with pytest.raises(InputError, match=r"no published numbers '3dsg'.*did you mean 3dgs"):
        load_published("3dsg")
