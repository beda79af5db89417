"""A stranger's files of configurations are checked before Hydra resolves anything in them.

Each case tries to bring a variable that may be secret into a name, a message or a path, at another
place where Hydra resolves ``${…}`` or follows a path.
"""

from pathlib import Path
from shlex import split

import hydra
import pytest

from gsbench import cli
from gsbench.config.compose import compose_one
from tests.helpers import refusal, table, write
from tests.strange import ask, no_trial
from tests.strange import place as place

pytestmark = pytest.mark.usefixtures("place")
READ = "${oc.env:KEY}"
SECRET = "sesame-q7xk"
OUTSIDE = "Parent traversal ('..')"

# the text of experiment/e.yaml, and what refuses it
ENTRIES = table(__file__, "entries")


def said_of(words, capsys, monkeypatch):
    """The line that refuses the ``words``, with the secret in the environment."""
    monkeypatch.setenv("KEY", SECRET)
    line = ask([*split("--config-dir conf --dry-run"), *words], capsys, monkeypatch)
    assert not any(part in line for part in SECRET.split("-"))
    assert not Path("runs").exists()
    return line


@pytest.mark.parametrize("case", ENTRIES)
def test_a_defaults_list_resolves_nothing_secret(case, capsys, monkeypatch):
    text, said = ENTRIES[case]
    text = text.replace("%s", READ)
    write(Path("conf/experiment/e.yaml"), f"# @package _global_\ndefaults: {text}\n")
    line = said_of(["+experiment=e"], capsys, monkeypatch)
    assert said in line
    assert "experiment/e.yaml" in line


@pytest.mark.parametrize(
    "file, first",
    [
        ("scene/mine.yaml", "scene=mine"),
        ("densify/deep/a/b.yaml", "densify=deep/a/b"),
        ("hydra/job_logging/mine.yaml", "hydra/job_logging=mine"),
    ],
)
def test_the_defaults_list_of_any_groups_file_is_looked_at(file, first, capsys, monkeypatch):
    write(Path("conf", file), f'defaults: [{{optional /leak: "{READ}"}}]\n')
    assert file in said_of([first], capsys, monkeypatch)
    if file.startswith("hydra"):
        return  # gsbench's own file decides there
    # also if only another file of the stranger's names it
    group, _, name = file.removesuffix(".yaml").rpartition("/")
    entry = f"{{override /{group}: {name}}}" if group != "densify/deep/a" else "/densify/deep/a/b"
    write(Path("conf/experiment/e.yaml"), f"# @package _global_\ndefaults: [{entry}]\n")
    assert file in said_of(["+experiment=e"], capsys, monkeypatch)


@pytest.mark.parametrize(
    "settings",
    [
        f'hydra: {{job: {{env_copy: "{READ}"}}}}',
        f'hydra: {{job: {{config: {{override_dirname: {{kv_sep: "{READ}"}}}}}}}}',
        f'hydra: {{searchpath: "{READ}"}}',
        f'hydra: {{searchpath: ["file://{READ}"]}}',
        f'hydra: {{mode: "{READ}"}}',
        f'hydra: {{run: {{dir: "{READ}"}}}}',
        f'hydra: {{verbose: "{READ}"}}',
        f'hydra: {{help: {{template: "{READ}"}}}}',
        f'"{READ}": 1',
    ],
)
def test_hydras_own_settings_resolve_nothing_secret(settings, capsys, monkeypatch):
    write(Path("conf/experiment/e.yaml"), f"# @package _global_\n{settings}\n")
    line = said_of(["+experiment=e"], capsys, monkeypatch)
    assert "experiment/e.yaml: " in line
    assert "which may be secret" in line


def test_the_address_of_a_typed_tracker_resolves_nothing_secret(capsys, monkeypatch):
    """Another file's address stands in its place, so the whole configuration does not have it."""
    monkeypatch.setenv("MLFLOW_TRACKING_URI", "http://lab:1")
    write(Path("conf/tracking/lab.yaml"), f'name: lab\nuri: "http://lab/{READ}"\n')
    write(Path("conf/experiment/e.yaml"), "# @package _global_\ntracking: {uri: 'http://lab:1'}\n")
    line = said_of(["+experiment=e", "tracking=lab"], capsys, monkeypatch)
    assert "tracking/lab.yaml: uri" in line


@pytest.mark.parametrize(
    "words",
    [
        [f"densify={READ}"],
        [f"densify={{a: '{READ}'}}"],
        [f"name={READ}"],
        [f"+init.x=[1,'{READ}']"],
        [f"hydra.job.name={READ}"],
    ],
)
def test_words_that_nobody_typed_resolve_nothing_secret(words, monkeypatch):
    """Such as those of a plan or a claims file."""
    monkeypatch.setenv("KEY", SECRET)
    with refusal("which may be secret"):
        compose_one(words, typed=[])


@pytest.mark.skipif(
    not hydra.__version__.startswith("1.3"), reason="Hydra 1.4 resolves only chosen groups there"
)
def test_what_is_allowed_is_resolved_in_a_defaults_list(capsys, monkeypatch):
    monkeypatch.setenv("KEY", "adc")
    monkeypatch.setenv("USER", "me")
    monkeypatch.setattr("gsbench.app.command.run_batch", no_trial)
    write(
        Path("conf/experiment/e.yaml"),
        '# @package _global_\ndefaults:\n- optional /other: "x_${oc.env:USER}"\n'
        '- override /densify: "${oc.env:KEY}"\n- override /init: random\n',
    )
    words = split("--config-dir conf --dry-run +experiment=e allow_targets=[env:KEY]")
    assert cli.run(words) == 0
    assert "courtyard/random-adc" in capsys.readouterr().out


@pytest.mark.parametrize(
    "text, said",
    [
        ("a: " + "[" * 3000 + "]" * 3000, "more than 40 levels"),
        ("a: " + "9" * 100_000, "a word of 100,000 characters"),
        (
            "a: &a [" + "x," * 300 + "]\nb: &b [" + "*a," * 300 + "]\nc: [" + "*b," * 300 + "]",
            "more than 100,000 values",
        ),
        ("a: [", "is not YAML"),
        ("a: !!python/name:os.mkdir", "has the tag"),
    ],
)
def test_a_file_that_cannot_be_read_is_named(text, said, capsys, monkeypatch):
    write(Path("conf/experiment/e.yaml"), text)
    line = said_of(["+experiment=e"], capsys, monkeypatch)
    assert "conf/experiment/e.yaml " in line
    assert said in line


def test_a_date_in_a_file_stays_a_text():
    write(Path("conf/densify/mine.yaml"), "defaults: [adc, _self_]\nname: 2024-05-01\n")
    trial = compose_one(["hydra.searchpath=[conf]", "densify=mine"])
    assert trial.values["densify"]["name"] == "2024-05-01"


def test_completion_of_a_line_resolves_nothing_secret(capsys, monkeypatch):
    monkeypatch.setenv("KEY", SECRET)
    write(Path("conf/scene/x.yaml"), f'defaults: [{{optional /leak: "{READ}"}}]\n')
    monkeypatch.setenv("COMP_LINE", "gsbench hydra.searchpath=[conf] scene=x name=")
    assert cli.run(["-sc", "query=bash"]) == 2
    shown = capsys.readouterr()
    assert "scene/x.yaml" in shown.err
    assert SECRET not in shown.out + shown.err
