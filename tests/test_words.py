"""Every word on the command line is understood, or refused before any work in one line."""

import os
import sys
from pathlib import Path
from shlex import split

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from gsbench.app.command import compose_trials
from gsbench.config.schema import GROUP_SCHEMAS
from gsbench.errors import InputError
from gsbench.runs.code import config_hash
from gsbench.settings import check_values, option_fields
from tests.helpers import table
from tests.processes import completed

REFUSED = table(__file__, "refused") | {
    f"seed={'1' * 5000}": "is not a setting like key=value",
    f"name={'a' * 300}": "a plain folder name",
}
OWN = """
from dataclasses import dataclass
from gsbench.densify import ADC

@dataclass
class Own(ADC):
    patience: int = 5

class Raises(ADC):
    def __post_init__(self):
        raise KeyError("two\\nlines")
"""


@pytest.fixture(autouse=True)
def place(tmp_path, monkeypatch):
    monkeypatch.setenv("GSBENCH_RUNS", str(tmp_path / "runs"))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    (tmp_path / "own.py").write_text(OWN)
    (tmp_path / "broken.py").write_text("def (:\n")
    experiments = tmp_path / "conf/experiment"
    experiments.mkdir(parents=True)
    (experiments / "calls.yaml").write_text(
        "# @package _global_\nhydra:\n  callbacks:\n    x:\n      _target_: os.system\n"
    )
    (experiments / "typo.yaml").write_text("# @package _global_\ntrain: {iteration: 300}\n")
    (experiments / "asks.yaml").write_text(
        "# @package _global_\nquestions: [{idea: volumetric, metrik: psnr}]\n"
    )
    bomb = [
        "a0: &a0 [x]",
        *(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 10)),
    ]
    (tmp_path / "bombs/experiment").mkdir(parents=True)
    (tmp_path / "bombs/experiment/bomb.yaml").write_text(
        "\n".join(["# @package _global_", *bomb]) + "\n"
    )
    for module in ("own", "broken"):
        monkeypatch.delitem(sys.modules, module, raising=False)
    return tmp_path


@pytest.mark.parametrize("command", REFUSED)
def test_a_wrong_command_is_refused_in_one_line(command, place, refused):
    assert REFUSED[command] in refused(*split(command))
    assert not (place / "runs").exists()  # nothing was begun


@pytest.mark.parametrize("command", ["", "-m", "--multirun"])
def test_a_command_without_settings_prints_the_usage(command, place, said):
    assert "gsbench --help" in said(command)
    assert not (place / "runs").exists()


@pytest.mark.parametrize(
    "command", ["judge {} --baseline a --metric psnr", "judge --baseline a --metric psnr {}"]
)
def test_a_file_may_stand_anywhere_in_a_command(command, refused):
    assert "nosuch.csv" in refused(command.format("nosuch.csv"))


@pytest.mark.parametrize("command", ["seed=1", "status", "tables x"])
@pytest.mark.parametrize("runs", ["file", "file/below", "~nosuchuser/x", ""])
def test_a_name_that_cannot_be_a_runs_folder_is_refused(runs, command, place, monkeypatch, refused):
    (place / "file").touch()
    monkeypatch.setenv("GSBENCH_RUNS", runs)
    line = refused(command)
    assert "runs" in line
    assert "full" not in line


def test_a_runs_folder_that_cannot_be_made_is_refused(refused):
    if not Path("/proc/self").exists():
        pytest.skip("needs /proc, where nobody can make a folder")
    line = refused("runs=/proc/nowhere", "tracking=none")
    assert "/proc/nowhere cannot be the runs folder" in line


def test_errors_of_a_separate_process_are_one_line(place):
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    done = completed([sys.executable, "-m", "gsbench.cli", "+extra=1"], 2, env=environment)
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.parametrize(
    "words",
    [
        "launch=slurm 'launch.sbatch={constraint: a100}'",
        "launch=slurm launch.sbatch.constraint=a100",
        "train.iterations=1e3 densify.max_gaussians=1e5",
        "scene.max_size=1e2",
        "'name=\"größe\"'",
        "~densify.cap",
    ],
)
def test_unusual_but_right_words_are_accepted(words):
    (trial,) = compose_trials(split(words))
    assert trial.values["launch"]["sbatch"] == (
        {"constraint": "a100"} if split(words)[0] == "launch=slurm" else {}
    )


def test_glob_lists_the_options_of_a_group():
    trials = compose_trials(["densify=glob(a*)"], multirun=True)
    assert [trial.values["densify"]["name"] for trial in trials] == ["absgrad", "absgs", "adc"]


# ---- property: any value of any setting is accepted and then stays, or is refused in one line

SCHEMA_KEYS = [
    (group, entry.name)
    for group, schema in GROUP_SCHEMAS.items()
    for entry in option_fields(schema)
]
VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text("aB1./~é \n", max_size=6),
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.sampled_from("abc"), inner, max_size=2)
    ),
    max_leaves=5,
)


@settings(max_examples=150, deadline=None, suppress_health_check=list(HealthCheck))
@given(key=st.sampled_from(SCHEMA_KEYS), value=VALUES)
def test_any_value_of_any_setting_is_kept_or_refused_in_one_line(key, value):
    group, name = key
    try:
        once = check_values(GROUP_SCHEMAS[group], {name: value}, group)
    except InputError as error:
        refusal = str(error)
        assert refusal.startswith(f"{group}.{name} ")
        assert len(refusal.splitlines()) == 1
        return
    assert check_values(GROUP_SCHEMAS[group], once, group) == once


# ---- valid configurations keep their hashes: a changed hash is a trial that is computed again

HASHES = {
    (): "7e03318e5644a765fd7910202f240127bc39ac59857fa0d7baed39e401d8313b",
    (
        "scene=photos",
        "scene.path=/data/p",
        "scene.max_size=800",
        "densify=adc",
        "train=paper",
        "eval=standard",
    ): "862aaf8a2653e1b0efdd1d63121ddd631f08b7cff943f63c6f7a596ccda28903",
    (
        "train.opacity=1",
        "train.max_seconds=60",
        "train.background=[1,1,1]",
        "densify.prune_size=1",
        "eval.lpips=[vgg]",
        "train.volume_histogram=[]",
        "init.peak_threshold=1",
    ): "c4e25d2f8af3f150946e32e4c1694e0d33f979b6949602b0f2ed4883e1cfaad1",
    (
        "densify=mcmc",
        "init=random",
        "densify.max_gaussians=1e5",
        "scene.max_size=200",
        "launch=local",
        "tracking=none",
    ): "8b763bc85f0d38dbd62e18436be540ebea5f8542396411a7e6447152f07ad519",
    (
        "scene.name=2024",
        "scene.train_list=a.txt",
        "eval.weights=null",
        "threads=3",
        "seed=7",
        "densify.name=0.5",
    ): "eb8a8081a2e985e7cb13829af2e473e6ab073b173fe9b031fdd3d8e988829a62",
}


@pytest.mark.parametrize("words", HASHES)
def test_hashes_of_valid_configurations_stay(words):
    (trial,) = compose_trials(words)
    assert config_hash(trial.values) == HASHES[words]
