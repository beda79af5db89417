"""Other programs have moved: own arms stand alone in their group, and the old names still lead somewhere."""

from __future__ import annotations

import logging
from pathlib import Path

import pytest

from gsbench.app.hydra_app import compose_trials
from gsbench.config import old_names
from gsbench.config.command_words import options
from gsbench.config.compose import compose_one
from gsbench.errors import InputError
from gsbench.system.install import conf_dir

GIVEN = ["densify.version='1'", "allow_targets=[opensplat,mine]"]


@pytest.fixture(autouse=True)
def nothing_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(old_names, "_told", set())


def test_an_old_name_is_the_new_one_with_a_word(caplog: pytest.LogCaptureFixture) -> None:
    new = compose_one(["densify=external/opensplat", *GIVEN])
    assert not caplog.records
    for _ in range(2):  # and says it once
        assert compose_one(["densify=opensplat", *GIVEN]).values == new.values
    (record,) = caplog.records
    assert record.levelno == logging.WARNING
    assert "densify=opensplat is called densify=external/opensplat now" in record.getMessage()


def test_every_old_name_leads_to_a_file() -> None:
    for old, new in old_names.RENAMED.items():
        assert Path(conf_dir(), f"{new}.yaml").is_file()
        assert not Path(conf_dir(), f"{old}.yaml").exists()


def test_in_a_sweep_and_in_a_file_of_ones_own(tmp_path: Path) -> None:
    """Also as what another file builds on, and from a folder of the user's."""
    folder = tmp_path / "densify"
    folder.mkdir()
    text = "defaults: [external, _self_]\nname: mine\nversion: '1'\ncommand: [mine, '{data}']\nresult: x.ply\n"
    (folder / "mine.yaml").write_text(text)
    (tmp_path / "experiment").mkdir()
    experiment = "# @package _global_\ndefaults: [{override /densify: opensplat}]\nname: own\n"
    (tmp_path / "experiment" / "own.yaml").write_text(experiment)
    found = [f"hydra.searchpath=['file://{tmp_path}']"]
    assert compose_one([*found, "densify=mine", GIVEN[1]]).values["densify"]["command"] == ["mine", "{data}"]
    assert compose_one([*found, "+experiment=own", *GIVEN]).values["densify"]["name"] == "opensplat"
    trials = compose_trials(["densify=external/opensplat,opensplat", *found, "+densify.version=1", GIVEN[1]], True)
    assert len(trials) == 2
    assert trials[0].values == trials[1].values


@pytest.mark.slow
def test_a_glob_takes_own_arms_alone() -> None:
    trials = compose_trials(["densify=glob(*)", "train=paper"], True)
    names = [trial.values["densify"]["name"] for trial in trials]
    assert names == [option for option in options("densify") if "/" not in option]
    assert {"adc", "volumetric", "resgs", "mrnf"} <= set(names)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["densify=external/opensplat"], r"densify\.version is not set: give it a value \(densify=opensplat\)"),
        (["densify=external/3dgs", "densify.version=1"], r"densify\.options\.code is not set.*\(densify=3dgs\)"),
        (["densify=opnsplat"], r"did you mean external/opensplat\?"),
        (["densify=3dgs", "densify.version=1"], r"densify\.options\.code is not set.*\(densify=3dgs\)"),
    ],
)
def test_messages_name_the_arm(words: list[str], said: str) -> None:
    with pytest.raises(InputError, match=said):
        compose_one(words)
