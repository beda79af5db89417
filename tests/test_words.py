"""Every word on the command line is understood, or refused before any work in one line."""

import os
import shlex
import subprocess
import sys
from pathlib import Path
from shlex import split

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from gsbench.app.command import compose_trials
from gsbench.config.schema import GROUP_SCHEMAS
from gsbench.errors import InputError
from gsbench.runs.config_hash import config_hash
from gsbench.settings import check_values, option_fields

REFUSED = {  # command line: a part of the line that refuses it
    # words that nothing reads
    "=3": "names no setting",
    "tabels": "did you mean tables?",
    "densify.grad_threshold=1": "did you mean gradient_threshold?",
    "densify=volumetrik": "did you mean volumetric?",
    "train.iterations=many": "train.iterations",
    "scene=photos scene.path=/nowhere/at/all": "/nowhere/at/all",
    "scene.path=/my/fern": "add scene=photos",
    "raster=triton device=cpu": "device=cuda",
    "+extra=1": "extra is not a setting",
    "++train.extra=1": "train.extra is not a setting",
    "+scene.sede=1": "did you mean seed?",
    "+densify.grad=1": "did you mean gradient?",
    "+init.colour=red": "init.colour is not a setting",
    "SEED=1": "did you mean seed?",
    "seed.x=1": "seed.x is not a setting",
    "densify=none densify.start=4": "densify.start is not a setting",
    "+hydra.callbacks.x._target_=os.system": "allow_targets=[os]",
    "+hydra.callbacks.x.size=3": "hydra.callbacks.x names no _target_",
    "+hydra.callbacks.x._target_=own.Nothing allow_targets=[own]": "own.Nothing",
    "+experiment=calls --config-dir conf": "allow_targets=[os]",
    "hydra/launcher=nosuch": "launch=serial, local or slurm",
    "hydra/launcher=basic": "add -m",
    "-m hydra/launcher=basic launch=local seed=0,1": "two launchers",
    "-m hydra/launcher=basic train.iterations=2.5": "a whole number of at least 0, got 2.5",
    "hydra/sweeper=nosuch": "choose: basic, gsbench",
    "hydra.sweeper.parms=1": "did you mean params?",
    "hydra.nosuch=1": "hydra.nosuch is not a setting",
    "+hydra.sweeper.params.seed=1": "add -m",
    "hydra.searchpath=[file:///nosuch]": "no such folder",
    "--dry-rum": "did you mean --dry-run?",
    "tabels x": "did you mean tables?",
    # choices
    "train": "train is a group: choose one by train=NAME (7k, ",
    "photos": "did you mean scene=photos?",
    "path=/x": "did you mean scene.path?",
    "densify._target_=${densify.name}": "write the name itself here",
    "densify=adc densify.volume_threshold=1": "it belongs to densify=volumetric",
    "-m densify=adc,volumetric densify.volme_threshold=1": "did you mean volume_threshold? it "
    "belongs to densify=volumetric",
    "densify=adc densify.max_gausians=1": "did you mean max_gaussians? (densify has: ",
    f"seed={'1' * 5000}": "is not a setting like key=value",
    "+experiment=typo --config-dir conf": "train.iteration is not a setting in "
    "experiment/typo.yaml; did you mean it",
    "+experiment=asks --config-dir conf --dry-run": "did you mean metric?",
    "declare --config-dir conf +experiment=asks": "did you mean metric?",
    "+experiment=bomb --config-dir bombs": "it has more than 100,000 values",
    "+experiment=tabel1": "tabel1 does not exist; did you mean table1?",
    "densify._target_=mine.X densify.own=1": "+densify.own=",
    "launch.parallel=0": "launch.parallel must be a whole number above 0",
    "densify=vol": "densify=vol does not exist",
    "densify=calm": "densify=calm does not exist; a class of your own is named by densify._target_",
    "train=2k": "train=2k does not exist (choose: ",
    # sweeps
    "-sc": "-sc takes install=bash",
    "-sc install=bash install=zsh": "-sc takes install=bash",
    "seed=1,2": "add -m",
    "-m seed=interval(0,1)": "belongs to what all arms share",
    "-m densify.volume_threshold=interval(nan,1)": "from a number to a larger one",
    "-m densify.volume_threshold=interval(0,inf)": "from a number to a larger one",
    "-m densify=adc densify.volume_threshold=interval(0,1)": "it belongs to densify=volumetric",
    "-m hydra.sweeper.tune.seed=-1 densify.volume_threshold=interval(0,1)": "seed must be a whole "
    "number in [0,",
    "-m hydra.sweeper.tune.at_onec=2 seed=0,1": "did you mean at_once?",
    "-m hydra/sweeper=nosuch seed=0,1": "a search is an interval and hydra.sweeper.tune.points",
    "-m hydra.sweeper.params=x seed=0,1": "must map settings to values",
    "hydra.sweeper.params.seed=1": "type seed=… itself, with -m",
    "-m seed=0,-1": "seed must be a whole number",
    "-m device=cpu,cuda": "does not make a different trial",
    # values
    "seed=-1": "seed must be a whole number in [0,",
    "seed=true": "got true",
    "seed=1e30": "seed must be",
    "seed=${nosuch}": "Interpolation key 'nosuch' not found",
    "seed=${": "is not a setting like key=value",
    "seed=": "got ''",
    "name=größe": 'name="größe"',
    "name=../up": "a plain folder name",
    "name=a:b": "a plain folder name",
    f"name={'a' * 300}": "a plain folder name",
    "densify.name=a/b": "densify.name must be a plain folder name",
    "threads=true": "threads must be",
    "runs=": "runs must be a path",
    "train.opacity=inf": "train.opacity must be a number above 0, got inf",
    "train.ssim_weight=nan": "got nan",
    "train.background=[0,0]": "train.background must be a list of 3",
    "train.iterations=2.5": "a whole number of at least 0, got 2.5",
    "train.iterations=null": "got null",
    "train.densify_stop=100": "densify.stop must be above densify.start",
    "eval.lpips=[nosuch]": "eval.lpips must be a list of",
    "eval.lpips=[vgg,vgg]": "at most once",
    "eval.weights=nosuch": "no such folder",
    "init=dim init.weights=": "init.weights must be a path",
    "tracking.uri=nosuch": "an address such as http://HOST:PORT",
    "launch=slurm launch.sbatch=3": "a mapping {key: value}",
    "scene.downscale=4000 scene.max_size=100": "leaves 1x1 px",
    "scene.width=1e9": "scene.width must be",
    "scene=photos": "scene.path is not set",
    "scene=photos scene.path=nosuch": "does not exist",
    "scene=transforms scene.path=nosuch": "does not exist",
    "scene=photos scene.path=~/x": "their own quotes inside",
    "init=ply": "init.path is not set",
    # components
    "densify.start=-1": "densify.start must be a whole number of at least 0, got -1",
    "densify.volume_interval=150": "a multiple of densify.interval (100)",
    "-m densify.volume_threshold=0.03,-1": "densify.volume_threshold must be a number above 0, "
    "got -1",
    "--dry-run densify.volume_threshold=-1": "densify.volume_threshold must be",
    "densify._target_=gsbench.errors.InputError": "not a class for densify",
    "densify._target_=os.system": "allow_targets=[os]",
    "densify._target_=own.Own allow_targets=[own]": "remove it by ~densify.volume_threshold, or "
    "start",
    "densify._target_=nosuch.X allow_targets=[nosuch]": "No module named 'nosuch'",
    "densify._target_=broken.X allow_targets=[broken]": "SyntaxError",
    "densify=adc densify._target_=own.Raises allow_targets=[own]": "own.Raises cannot be made "
    "(KeyError",
    "densify=adc densify._target_=own.Own allow_targets=[own] +densify.patiense=1": "did you mean "
    "patience?",
    "densify=adc densify._target_=own.Own allow_targets=[own] +densify.patience=x": "must be a "
    "whole number, got 'x'",
    "init._target_=5": "the import path of a class",
    # verbs and questions
    "tables x --format pdf": "invalid choice: 'pdf'",
    "tables x --metrics psnr,psnr": "must be different names",
    "tables nosuch": "no experiment 'nosuch'",
    "report x --out ''": "is not a path",
    "retry x foo": "no experiment 'x'",
    "view x --port 99999": "a whole number in [0, 65535]",
    "view .": "is not a trial's folder",
    "ui --uri nosuch": "is not an address",
    "bench --size 999999999x999999999": "a size is WIDTHxHEIGHT",
    "bench --raster auto": "name those to time",
    "--cfg job nosuch=1": "nosuch is not a setting",
    "--cfg job -m seed=1": "unrecognized arguments: -m",
    "tables x --fromat csv": "unrecognized arguments: --fromat csv; did you mean --format?",
    "tables x --fromat=csv": "did you mean --format?",
    "tables x --zzz": "unrecognized arguments: --zzz (see",
    "--cfg nosuch": "invalid choice",
    "--resolve": "ask one thing",
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
    for command in ("+extra=1", "=3"):
        argv = [sys.executable, "-m", "gsbench.cli", *shlex.split(command)]
        done = subprocess.run(
            argv, capture_output=True, text=True, env=environment, timeout=120, check=False
        )
        assert (done.returncode, len(done.stderr.splitlines())) == (2, 1), done.stderr


@pytest.mark.parametrize(
    "words",
    [
        "launch=slurm 'launch.sbatch={constraint: a100}'",
        "launch=slurm launch.sbatch.constraint=a100",
        "train.iterations=1e3 densify.max_gaussians=1e5",
        "scene.downscale=4 scene.max_size=100",
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
    (): "5d22c1eb5b01c596bf63f3ceb611993fb93c1bcf46321749d4d28c8441057b03",
    (
        "scene=photos",
        "scene.path=/data/p",
        "scene.max_size=800",
        "densify=adc",
        "train=paper",
        "eval=standard",
    ): "3161888b01db31858824b804afcfb73d9c6eebca194e8276ecf9ecc14dae0fad",
    (
        "train.opacity=1",
        "train.max_seconds=60",
        "train.background=[1,1,1]",
        "densify.prune_size=1",
        "eval.lpips=[vgg]",
        "train.volume_histogram=[]",
        "init.peak_threshold=1",
    ): "055d6dd09c551427b427de86a7da6b93202a6ab8289dc64c7d17bd18f4b134b8",
    (
        "densify=mcmc",
        "init=random",
        "densify.max_gaussians=1e5",
        "scene.downscale=2",
        "launch=local",
        "tracking=none",
    ): "9cf12f152de05c002f1bcb5729ff5265d6c8a6ece7083aac0a668483e5a7fd38",
    (
        "scene.name=2024",
        "scene.train_list=a.txt",
        "eval.weights=null",
        "threads=3",
        "seed=7",
        "densify.name=0.5",
    ): "80462abdd59134af2ff9adb5757f51c6321ac79306a26a0e6b666808daa2a783",
}


@pytest.mark.parametrize("words", HASHES)
def test_hashes_of_valid_configurations_stay(words):
    (trial,) = compose_trials(words)
    assert config_hash(trial.values) == HASHES[words]
