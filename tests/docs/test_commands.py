"""Verbs, options, groups, choices, settings and files that the documents name exist.

The text is read, and no command runs. Values other than choices are checked where commands run.
"""

import contextlib
import dataclasses
import importlib
import inspect
import io
import re
from functools import cache
from pathlib import Path

import pytest
import yaml

from gsbench.config.command_words import OPTIONS
from gsbench.config.groups import GROUPS, options
from gsbench.config.schema import ComponentConfig, LaunchConfig, TrackingConfig
from gsbench.eval.options import EvalConfig
from gsbench.external.settings import External
from gsbench.raster.executors import RasterConfig
from gsbench.scene.options import SceneConfig
from gsbench.train.options import TrainConfig
from gsbench.verbs import VERBS, load_verb
from gsbench.verbs.queries import QUERIES
from tests.conftest import ROOT
from tests.helpers import table

DOCUMENTS = [
    *(ROOT / name for name in ("README.md", "CHANGELOG.md", "CONTRIBUTING.md")),
    *sorted((ROOT / "docs").glob("*.md")),
]
FENCED = re.compile(r"^```.*?^```$", re.DOTALL | re.MULTILINE)  # run by tests/docs/test_examples.py
SPAN = re.compile(r"`([^`]+)`")
COMMAND = re.compile(r"^ {4,}((?:[A-Z_]+=\S+ )*gsbench(?: .*)?)$", re.MULTILINE)
SETTING = re.compile(r"^([+~]*)([a-z_][\w.]*)=(.*)$")
FILE = re.compile(r"^[\w.-]+(/[\w.-]+)+\.(py|yaml|md|sh)$")
# Other names with a slash may be files of other programs.
OUR_FILES = ("src/", "conf/", "docs/", "tests/")
# a choice that is a name, and no placeholder, pattern or expression
VERBATIM = re.compile(r"^[\w/]+$")
OWN = {"mine", "mycluster", "opacity", "NAME"}  # names that examples give to a reader's own
TOP = {"name", "seed", "device", "threads", "runs", "allow_targets"}
CLASSES = {
    "scene": (SceneConfig,),
    "densify": (ComponentConfig, External),
    "init": (ComponentConfig,),
    "raster": (RasterConfig,),
    "train": (TrainConfig,),
    "eval": (EvalConfig,),
    "tracking": (TrackingConfig,),
    "launch": (LaunchConfig,),
}
NO_SETTINGS = {"key", "stable", "grow_grad2d"}  # words of Hydra's grammar, of torch and of gsplat


@cache
def keys_of(group):
    """The settings of a group: those of its dataclass, its files, and the classes in the files."""
    known = {field.name for kind in CLASSES.get(group, ()) for field in dataclasses.fields(kind)}
    for file in (ROOT / f"conf/{group}").rglob("*.yaml"):
        content = yaml.safe_load(file.read_text(encoding="utf-8"))
        known |= {str(key) for key in content}
        module, _, name = str(content.get("_target_", "")).rpartition(".")
        if module and name != External.__name__:  # External is in `CLASSES`
            known |= set(
                inspect.signature(getattr(importlib.import_module(module), name)).parameters
            )
    return frozenset(known)


@cache
def options_of(verb):
    with contextlib.redirect_stdout(io.StringIO()) as text, contextlib.suppress(SystemExit):
        load_verb(verb)(["--help"], Path("runs"))
    return frozenset(re.findall(r"(?<![\w-])--?[a-z][a-z-]*", text.getvalue()))


def fault_of_setting(word):
    """The reason why a word ``key=value`` is no setting of gsbench; "" for other words."""
    match = SETTING.match(word.strip("'\","))
    if match is None or match[2] in NO_SETTINGS:
        return ""
    sign, key, value = match.groups()
    group, _, rest = key.partition(".")
    if group == "hydra":
        return ""
    if not rest and key in GROUPS:
        choices = {*options(key), *OWN}
        given = [
            choice
            for choice in re.split(r"[,|]", value.replace("\\", ""))
            if VERBATIM.match(choice)
        ]
        missing = sorted(set(given) - choices)
        return f"{key} has no choice {', '.join(missing)}" if missing else ""
    if sign.startswith("+"):
        return ""  # a setting of a reader's class
    if rest and group in GROUPS:
        return "" if rest.split(".")[0] in keys_of(group) else f"{group} has no setting {rest}"
    everywhere = TOP.union(*(keys_of(name) for name in GROUPS if name != "experiment"))
    return "" if key in everywhere else f"no setting is called {key}"


def faults_of_command(command):
    """The reasons why words of a command are wrong."""
    words = command.partition("gsbench")[2].partition(" #")[0].split()
    words = words[: words.index("|")] if "|" in words else words
    verb = words[0] if words and re.fullmatch(r"[a-z]+", words[0]) else None
    if verb is not None and verb not in VERBS:
        yield f"no verb {verb}"
        return
    known = {*OPTIONS, *QUERIES} if verb is None else {*options_of(verb), "--help"}
    for word in words:
        if re.match(r"--?[a-z]", word) and word.split("=")[0] not in known:
            yield f"{verb or 'a trial'} has no option {word}"
        elif not word.startswith("-") and (fault := fault_of_setting(word)):
            yield fault


def faults_of(text):
    """The faults of a document, each with its line."""
    text = FENCED.sub(lambda found: "\n" * found[0].count("\n"), text)
    # a command may continue on the next line
    joined = re.sub(r"\\\n +", lambda found: " " * (len(found[0]) - 1) + "\0", text)
    found = [
        (match.start(1), match[1]) for match in (*COMMAND.finditer(joined), *SPAN.finditer(joined))
    ]
    faults = []
    for start, words in sorted(found):
        line = joined[:start].count("\n") + joined[:start].count("\0") + 1
        words = " ".join(words.replace("\0", " ").split())
        if re.match(r"(?:[A-Z_]+=\S+ )*gsbench( |$)", words):
            faults += [f"{line}: {fault}: {words}" for fault in faults_of_command(words)]
        else:
            named = [
                word for word in words.split() if "." in word.partition("=")[0] or word == words
            ]
            faults += [
                f"{line}: {fault}: {words}" for word in named if (fault := fault_of_setting(word))
            ]
        if FILE.match(words) and words.startswith(OUR_FILES) and Path(words).stem not in OWN:
            faults += [] if (ROOT / words).is_file() else [f"{line}: no file {words}"]
    return faults


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_commands_settings_and_files_in_a_document_exist(document):
    assert faults_of(document.read_text(encoding="utf-8")) == []


def test_links_between_documents_lead_to_existing_files():
    for page in DOCUMENTS:
        for target in re.findall(r"\]\(([^)#]+?)(?:#[^)]*)?\)", page.read_text(encoding="utf-8")):
            assert "://" in target or (page.parent / target).exists(), f"{page} links to {target}"


def test_files_in_the_architecture_document_exist():
    """There, files may be named from ``src/gsbench``."""
    spans = SPAN.findall((ROOT / "docs/architecture.md").read_text(encoding="utf-8"))
    named = [span for span in spans if FILE.match(span)]
    assert len(named) > 10
    places = [
        (ROOT / folder / name for folder in ("", "src", "src/gsbench", "docs")) for name in named
    ]
    found = [any(place.is_file() for place in places_of) for places_of in places]
    assert [name for name, there in zip(named, found, strict=True) if not there] == []


@pytest.mark.parametrize(
    "text, fault",
    table(__file__, "wrong words"),
)
def test_a_wrong_word_is_found(text, fault):
    assert "\n" not in text or faults_of(text)[0].startswith("1: ")
    assert [fault in found for found in faults_of(text)] == [True]


def test_right_words_are_no_faults():
    right = """
    gsbench -m scene=garden densify=external/opensplat densify.options.program=x +densify.mine=1 seed=0,1,2 | tee x
    gsbench tables x --format csv   # no=comment
`densify=glob(*)` `key=interval(a, b)` `train=…` `densify/volumetric.py` `~densify.cap`
"""
    assert faults_of(right) == []
