"""Nothing that a configuration or the current folder names is run unless the user allows it.

Every case tries to leave a mark: a module that writes a file when it is imported, or a call that
makes a folder.
"""

import importlib.util
import re
from copy import deepcopy
from itertools import product
from pathlib import Path
from shlex import split

import pytest
from omegaconf import OmegaConf

from gsbench import cli
from gsbench.app.command import compose_trials
from gsbench.config.build import build
from gsbench.config.command_words import typed_permissions
from gsbench.config.compose import Trial, check_permitted, compose_one, composed_once
from gsbench.config.schema import check, plain
from gsbench.config.trust import ALLOWED, foreign_variables, load_class
from gsbench.runs.code import module_digest
from gsbench.system.programs import allow_modules
from tests.helpers import refusal, table, write
from tests.strange import BOMB, ask, experiment, nested
from tests.strange import place as place

pytestmark = pytest.mark.usefixtures("place")


# settings of a file, and a part of the line that refuses them
STRANGE = table(__file__, "strange")
MODES = {
    "run": [],
    "dry run": ["--dry-run"],
    "question": ["--cfg", "job"],
    "info": ["--info", "config"],
}


SOME = ("a callback", "made of a text", "a module of a package", "logging", "a launcher")
# those that take more than a look at the configuration, or of which Hydra makes another one
WHOLE = [case for case, (own, _) in STRANGE.items() if {"defaults", "hydra", "hydra.mode"} & {*own}]
WHOLE += ["help", "a line break in a name"]


@pytest.mark.parametrize("case", [case for case in STRANGE if case not in WHOLE])
def test_code_in_a_configuration_is_refused(case):
    """All cases stand in one composition, as a file of an experiment changes it."""
    settings, said = STRANGE[case]
    config = deepcopy(composed_once(()))
    OmegaConf.set_struct(config, False)
    config.merge_with(nested(settings))
    with refusal(re.escape(said)):
        check_permitted(config, [])
        Trial(check(plain(config)), ())
    assert not Path("exploded").exists()


@pytest.mark.parametrize(
    "case, mode",
    [
        *product(WHOLE, ["run"]),
        *product(SOME, ["run", "question"]),
        (SOME[0], "dry run"),
        (SOME[0], "info"),
    ],
)
def test_code_that_a_file_names_is_not_run(case, mode, capsys, monkeypatch):
    settings, said = STRANGE[case]
    assert said in ask([*experiment(settings), *MODES[mode]], capsys, monkeypatch)
    assert not Path("exploded").exists()


JOBS = table(__file__, "jobs")


@pytest.mark.parametrize("launcher, place_of_words", [("gsbench", "params"), ("basic", "grids")])
@pytest.mark.parametrize("case", JOBS)
def test_code_that_only_jobs_of_a_sweep_name_is_not_run(
    case, launcher, place_of_words, capsys, monkeypatch
):
    words, said = JOBS[case]
    words = words | {"seed": "0,1"}
    node = {"params": words} if place_of_words == "params" else {"grids": [words]}
    run = [
        *experiment({"hydra": {"mode": "MULTIRUN", "sweeper": node}}),
        f"hydra/launcher={launcher}",
    ]
    assert said in ask(run, capsys, monkeypatch)
    assert not Path("exploded").exists()


@pytest.mark.parametrize(
    "variables", [{"PYTHONPATH": "/strange"}, {"OMP_NUM_THREADS": "2"}, "${launch.sbatch}"]
)
def test_a_file_cannot_set_environment_variables(variables, capsys, monkeypatch):
    line = ask(experiment({"hydra.job.env_set": variables}), capsys, monkeypatch)
    assert "hydra.job.env_set can change what runs" in line


@pytest.mark.parametrize("sweeper", ["gsbench", "basic"])
def test_code_from_a_single_choice_of_a_sweep_is_not_run(sweeper, capsys, monkeypatch):
    """Hydra configures the logging of a job before gsbench sees the job."""
    experiment(
        {"hydra.job_logging.handlers.x.class": "bomb.Bomb", "scene.name": "x"}, group="scene"
    )
    words = split("-m --config-dir conf hydra/launcher=basic init=random scene=courtyard,strange")
    line = ask([*words, f"hydra/sweeper={sweeper}"], capsys, monkeypatch)
    assert "class=bomb.Bomb" in line
    assert not Path("exploded").exists()


def test_a_launcher_in_a_strangers_file_is_not_run(capsys, monkeypatch):
    """The file may have the name of an installed launcher."""
    for group, name in product(("launcher", "sweeper"), ("basic", "own")):
        write(Path("conf/hydra", group, f"{name}.yaml"), "_target_: hydra_plugins.bomb.Bomb\n")
        words = ["-m", "--config-dir", "conf", f"hydra/{group}={name}", "seed=0,1"]
        assert "allow_targets=[hydra_plugins]" in ask(words, capsys, monkeypatch)
    assert not Path("exploded").exists()


SECRET = "${oc.env:KEY}"


@pytest.mark.parametrize(
    "value",
    [
        SECRET,
        "a${oc.env:'KEY'}",
        "${oc.env:NO,${oc.env:KEY}}",
        "${oc.env:GSBENCH_NO,${oc.env: KEY,b}}",
        "${oc.select:no,${oc.env:KEY}}",
        "${oc.env:${init.name}}",
    ],
)
@pytest.mark.parametrize("how", ["experiment", "params", "job"])
def test_no_file_reads_a_variable_into_results(value, how, capsys, monkeypatch):
    monkeypatch.setenv("KEY", "secret")
    settings = {
        "experiment": {"scene.name": value},
        "params": {"hydra": {"mode": "MULTIRUN", "sweeper": {"params": {"scene.name": value}}}},
        "job": {"hydra.job.name": value},
    }
    said = ask(experiment(settings[how]), capsys, monkeypatch)
    assert "which may be secret; if you want its value in results, add " in said
    assert "secret/" not in said


@pytest.mark.parametrize(
    "value, name",
    [
        (SECRET, None),
        ("${oc.env:GSBENCH_X}", "own"),
        ("${oc.env:NO,b}", None),
        ("${oc.env:USER}", "me"),
    ],
)
def test_variables_of_places_and_those_that_are_typed_are_read(value, name, monkeypatch):
    """What a typed word reads, and what ``allow_targets`` names, every file may read."""
    for variable, text in {"KEY": "secret", "GSBENCH_X": "own", "USER": "me"}.items():
        monkeypatch.setenv(variable, text)
    words = experiment({"scene.name": value})
    words = ["hydra.searchpath=[conf]", *words[2:]]
    if name is None:
        with refusal("reads the variable"):
            compose_one(words)
        variable, name = ("KEY", "secret") if value == SECRET else ("NO", "b")
        assert (
            compose_one([*words, f"allow_targets=[env:{variable}]"]).values["scene"]["name"] == name
        )
        with refusal("reads the variable"):
            compose_one([*words, f"allow_targets=[{variable}]"])
        words.append(f"init.name=a${{oc.env:{variable},b}}")
    assert compose_one(words).values["scene"]["name"] == name


VARIABLES = """
PATH PYTHONPATH PYTHONSTARTUP PYTHONHOME PYTHONUSERBASE PYTHONINSPECT LD_PRELOAD LD_LIBRARY_PATH LD_AUDIT
DYLD_INSERT_LIBRARIES GIT_SSH_COMMAND GIT_CONFIG_GLOBAL GIT_EXTERNAL_DIFF BASH_ENV ENV NUMBA_CACHE_DIR MPLBACKEND
MPLCONFIGDIR NUMBA_ENABLE_CUDASIM TRITON_CACHE_DIR TRITON_PTXAS_PATH TORCH_EXTENSIONS_DIR TORCH_HOME CC CXX CUDA_HOME
TORCHINDUCTOR_CACHE_DIR CUDA_INJECTION64_PATH OMP_TOOL_LIBRARIES GCONV_PATH HOME TMPDIR SHELL BROWSER
MLFLOW_TRACKING_URI MLFLOW_PLUGIN SSL_CERT_FILE HTTPS_PROXY IFS PERL5LIB NODE_OPTIONS JAVA_TOOL_OPTIONS GSBENCH_RUNS
GSBENCH_WEIGHTS path
"""


def test_only_variables_that_choose_threads_and_devices_need_no_permission(monkeypatch):
    """These are variables for another trainer. All others could start code."""
    assert foreign_variables({"OMP_NUM_THREADS": "2", "CUDA_VISIBLE_DEVICES": "1"}, []) == {}
    names = VARIABLES.split()
    assert list(foreign_variables(dict.fromkeys(names, "/strange"), [])) == names
    monkeypatch.setenv("MINE", "as it is")
    assert foreign_variables({"MINE": "as it is", "PATH": "other"}, []) == {"PATH": "other"}


@pytest.mark.parametrize(
    "word, said",
    [
        ("hydra.searchpath=[pkg://bombs]", "allow_targets=[bombs]"),
        ("hydra.searchpath=[file://conf,pkg://bombs/sub]", "allow_targets=[bombs]"),
        ("hydra.searchpath=[nosuch://bombs]", "neither a folder"),
        ("hydra.searchpath=[pkg://gsbench_other]", "allow_targets=[gsbench_other]"),
    ],
)
@pytest.mark.parametrize("mode", MODES)
def test_a_search_path_without_permission_imports_nothing(word, said, mode, capsys, monkeypatch):
    Path("conf").mkdir()
    assert said in ask([*MODES[mode], word], capsys, monkeypatch)
    assert not Path("exploded").exists()


def test_completion_does_not_import_the_search_path(monkeypatch):
    line = "gsbench hydra.searchpath=[pkg://bombs] densify="
    monkeypatch.setenv("COMP_LINE", line)
    assert cli.run(["-sc", "query=bash"]) == 2
    assert not Path("exploded").exists()


def test_an_allowed_search_path_is_read(place):
    write(place / "bombs/scene/own.yaml", "defaults: [courtyard, _self_]\nname: own\n")
    words = ["hydra.searchpath=[pkg://bombs]", "scene=own", "allow_targets=[bombs]"]
    assert compose_trials(words)[0].values["scene"]["name"] == "own"
    write(place / "bombs/scene/secret.yaml", f"defaults: [courtyard, _self_]\nname: {SECRET}\n")
    with refusal("reads the variable KEY, which may be secret"):
        compose_trials([*words, "scene=secret"])


# ---- permissions and what they cover


@pytest.mark.parametrize(
    "word",
    [
        "allow_targets=os",
        "allow_targets=[[os]]",
        "allow_targets={os: 1}",
        "allow_targets=['${name}']",
        "allow_targets=[null]",
        "allow_targets=[1]",
        "allow_targets=[a,'']",
    ],
)
def test_permissions_must_be_a_list_of_names(word):
    with refusal("a list of names"):
        typed_permissions([word])


def test_the_last_permission_counts():
    words = ["allow_targets=[a]", "seed=1", "++allow_targets=[b,c.D]"]
    assert typed_permissions(words) == ("b", "c.D")
    assert typed_permissions([words[0], "allow_targets=[b],[c]"]) == ("a",)
    assert typed_permissions(["seed=1"]) == ()


def test_a_typed_permission_also_covers_classes_in_files(capsys):
    run = experiment({"allow_targets": ["os"], "densify._target_": "mine.Mine"})
    (trial,) = compose_trials(["hydra.searchpath=[conf]", *run[2:], "allow_targets=[mine]"])
    assert trial.values["allow_targets"] == ["mine"]  # and not what the file says


@pytest.mark.parametrize(
    "target, said",
    [
        ("mine.os.mkdir", "cannot be imported"),
        ("mine.os", "is not a class for densify"),
        ("mine.Mime", r"cannot be imported: mine has no Mime; did you mean Mine\?"),
        ("mine.Popen", r"is subprocess\.Popen.*allow_targets=\[mine,subprocess\]"),
    ],
)
def test_permission_for_a_module_does_not_cover_its_imports(target, said):
    allow_modules(["mine"])
    with refusal(said):
        build("densify", {"_target_": target, "name": "x"}, ["mine"])


def test_permission_for_a_module_covers_gsbenchs_classes_in_it():
    allow_modules(["mine"])
    assert load_class("mine.ADC", "densify", ["mine"]).__module__.startswith("gsbench.")
    assert load_class("mine.Mine", "densify", ["mine"]).__name__ == "Mine"


@pytest.mark.parametrize(
    "settings, said",
    table(__file__, "callbacks"),
)
def test_callbacks_must_be_classes_of_an_allowed_module(settings, said, capsys, monkeypatch):
    run = [*experiment({"hydra.callbacks.x": settings}), "allow_targets=[mine]"]
    assert said in ask(run, capsys, monkeypatch)


def test_an_allowed_callback_is_made(capsys, monkeypatch):
    nested = {"_target_": "mine.Calls", "in": {"_target_": "mine.Calls"}}
    run = [*experiment({"hydra.callbacks.x": nested}), "allow_targets=[mine]"]
    assert "the trials began" in ask(run, capsys, monkeypatch)


def test_only_allowed_modules_of_the_folder_are_found_and_installed_ones_come_first(place):
    (place / "yaml.py").write_text(BOMB)
    (place / "json").mkdir()
    (place / "json/__init__.py").write_text(BOMB)
    (place / "mine.py").write_text("import helper\nclass Mine:\n    pass\n")
    (place / "helper.py").write_text("")
    allow_modules(["mine", "yaml", "json"])
    with refusal(
        r"it lies here, but only what allow_targets names is imported from here: add helper",
    ):
        load_class("mine.Mine", "densify", ["mine"])
    allow_modules(split("mine helper yaml json"))
    assert load_class("mine.Mine", "densify", ["mine"])
    assert Path(str(importlib.util.find_spec("yaml").origin)) != place / "yaml.py"
    assert importlib.util.find_spec("bomb") is None
    assert not Path("exploded").exists()


def test_looking_for_a_users_source_imports_nothing(place):
    (place / "bombs/sub.py").write_text("class Sub: ...\n")
    allow_modules(["bombs"])
    assert module_digest("bombs")
    assert not Path("exploded").exists()


# ---- names


def test_options_of_slurm_that_choose_resources_need_no_permission():
    assert not set(ALLOWED["sbatch"]) & {
        "wrap",
        "export",
        "export_file",
        "container",
        "bcast",
        "chdir",
        "get_user_env",
    }
    compose_one(["launch=slurm", "launch.sbatch={constraint: a100, mail-user: me}"])


def test_a_module_that_ends_the_process_when_it_is_imported_is_an_error(place):
    (place / "mine.py").write_text("raise SystemExit(0)\n")
    allow_modules(["mine"])
    with refusal(r"mine\.Mine cannot be imported \(SystemExit: 0\)"):
        load_class("mine.Mine", "densify", ["mine"])
