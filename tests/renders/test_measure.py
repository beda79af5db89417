"""The places at which renders may be entered."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from gsbench.errors import InputError
from gsbench.eval.pictures import Matching
from gsbench.renders.measure import (
    Destination,
    ReferenceImages,
    _lines,
    check_destination,
    find_destination,
)
from tests.analysis.synthetic import Plan, write_runs

COURTYARD = ReferenceImages(
    {}, "the test views of a trial", "0" * 64, (96, 72), {}, "courtyard", "sfm"
)
OWN = ("store", "Store", "mlartifacts")
FOLDER = ReferenceImages({}, "the pictures in a folder", "0" * 64, (96, 72), {})


@pytest.mark.parametrize(
    ("word", "scene", "seed", "truth", "said"),
    [
        ("table1:mine", "garden", 0, COURTYARD, "--scene garden: .* of the scene courtyard"),
        ("table1:mine", None, -1, COURTYARD, "--seed -1: must be 0 or more"),
        ("table1:mine", "../x", 0, FOLDER, r"--scene \.\./x: must be a plain folder name"),
        ("table1:mine", None, 0, FOLDER, "give it with --scene"),
        *((f"{own}:arm", None, 0, COURTYARD, f"{own} is gsbench's own folder") for own in OWN),
        (".jobs:arm", None, 0, COURTYARD, "is not EXPERIMENT:ARM"),
    ],
)
def test_places_that_would_mix_or_damage_results_are_refused(
    word: str, scene: str | None, seed: int, truth: ReferenceImages, said: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=said):
        find_destination(word, scene, seed, truth, tmp_path)


def test_the_scene_of_the_photographs_may_be_repeated(tmp_path: Path) -> None:
    wanted = Destination("table1", "courtyard", "sfm", "mine", 3)
    assert find_destination("table1:mine", "courtyard", 3, COURTYARD, tmp_path) == wanted
    assert find_destination("table1:mine", None, 3, COURTYARD, tmp_path) == wanted
    assert find_destination("table1:mine", "garden", 3, FOLDER, tmp_path).scene == "garden"


@pytest.mark.parametrize(
    ("data", "resolution", "refused"),
    [
        ("data-garden", (400, 300), False),
        ("data-garden", (400, 301), True),
        ("data-stump", (400, 300), True),
    ],
)
def test_renders_of_other_photographs_than_the_experiments_are_refused(
    data: str, resolution: tuple[int, int], refused: bool, tmp_path: Path
) -> None:
    write_runs(tmp_path, Plan(scenes=("garden",), seeds=(0,)))
    truth = ReferenceImages({}, "the pictures in a folder", data, resolution, {})
    destination = Destination("exp", "garden", "sfm", "mine", 0)
    if refused:
        with pytest.raises(InputError, match="tests garden on other photographs"):
            check_destination(destination, truth, tmp_path)
    else:
        check_destination(destination, truth, tmp_path)


def test_printed_lines_have_the_views_their_mean_and_the_reasons_of_missing_metrics() -> None:
    evaluator: Any = SimpleNamespace(
        protocol=SimpleNamespace(id="paper-1"),
        unavailable={"lpips_vgg_raw": "no weights", "fps": "renders alone"},
        awaited={"lpips_vgg_raw"},
        own={},
    )
    matching = Matching({}, "by their order", ("x", "y"))
    lines = _lines(
        FOLDER, evaluator, matching, {"a": {"psnr": 20.0}, "b": {"psnr": 21.0}}, Path("runs/x")
    )
    assert lines[0] == "2 views: the pictures in a folder; protocol paper-1"
    assert lines[1:3] == [
        "names matched by their order",
        "left out, without a photograph: x, y",
    ]
    assert [line.split() for line in lines[4:7]] == [
        ["a", "20.000"],
        ["b", "21.000"],
        ["mean", "20.500"],
    ]
    assert lines[7:] == ["lpips_vgg_raw: n/a, no weights", "entered as runs/x"]
