"""Settings of another program that are refused before it runs."""

import re

import pytest

from gsbench.external.settings import External
from tests.helpers import refusal, table


def external(result, **options):
    return External(command=["train", "{data}"], result=result, version="1", **options)


@pytest.mark.parametrize(
    "options, said",
    table(__file__, "an_option_is_one_value_with_a_name_of_its_own"),
)
def test_an_option_is_one_value_with_a_name_of_its_own(options, said):
    with refusal(re.escape(said)):
        external("a.ply", options=options)


@pytest.mark.parametrize(
    "settings", [{"version": ""}, {"version": "???"}, {"time_limit_minutes": 0}, {"command": 3}]
)
def test_a_setting_of_the_wrong_kind_is_refused_by_its_name(settings):
    sound = {"command": "train {data}", "result": "a.ply", "version": "1"}
    with refusal(rf"densify\.{next(iter(settings))}"):
        External(**(sound | settings))


def test_placeholders_are_known():
    for command, result in (("train {data} {lr}", "a.ply"), ("train {data}", "{lr}.ply")):
        key = "command" if "lr" in command else "result"
        with refusal(rf"densify\.{key}: unknown placeholder \{{lr\}}"):
            External(command=command, result=result, version="1")
    with refusal(r"has no \{data\}"):
        External(command=["a"], result="*.ply", version="1")


def test_the_program_is_found_on_its_own_path(tmp_path, monkeypatch):
    for place in ("one", "two"):
        (tmp_path / place).mkdir()
        (tmp_path / place / "train").touch(0o755)
    monkeypatch.setenv("PATH", str(tmp_path / "one"))
    assert external("a.ply").executable() == str(tmp_path / "one" / "train")
    own = {"PATH": str(tmp_path / "two")}
    assert external("a.ply", environment=own).executable() == str(tmp_path / "two" / "train")
    monkeypatch.setenv("HOME", str(tmp_path))
    home = External(
        command="{where}/train {data}", result="a.ply", version="1", options={"where": "~/two"}
    )
    assert home.executable() == str(tmp_path / "two" / "train")
    monkeypatch.setenv("PATH", str(tmp_path))
    with refusal("this machine has no program 'train': install it"):
        external("a.ply").executable()


SOUND = (
    "a.ply",
    "**/point_cloud.ply",
    "x/*.PLY",
    "it_{iterations}/a.ply",
    "{option}/x.ply",
    "./a.ply",
    "[ab].ply",
)
BELOW = "densify.result=.* below the program's output folder"
NO_PATTERN = "densify.result=.* not a pattern of files"


@pytest.mark.parametrize(
    "result, said",
    [
        *((result, None) for result in SOUND),
        ("**.ply", NO_PATTERN),
        ("a**/b.ply", NO_PATTERN),
        ("/home/me/a.ply", BELOW),
        ("{output}/a.ply", BELOW),
        ("{place}/a.ply", BELOW),  # the option is an absolute path
        ("../a.ply", BELOW),
        ("a/../../b.ply", BELOW),
        ("C:/a.ply", BELOW),
        (".", BELOW),
        ("a\0.ply", BELOW),
        ("x" * 300 + ".ply", NO_PATTERN),
        ("out/*/view_*.png", "must name a 3DGS model, as .*; renders .* gsbench evaluate --as"),
    ],
)
def test_a_result_is_a_pattern_below_the_output_folder(result, said):
    with refusal(said):
        assert external(result, options={"option": "deep", "place": "/abs"}).result == result
