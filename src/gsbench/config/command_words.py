"""The words of a command line, before Hydra composes anything: each is understood, or refused with a reason."""

from __future__ import annotations

import re
import shlex
from collections.abc import Sequence
from pathlib import Path

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException

from gsbench.config.schema import COMPONENTS
from gsbench.errors import InputError
from gsbench.runs.hashing import DECLARED, NOT_HASHED, WITHOUT_EFFECT
from gsbench.system.install import conf_dir
from gsbench.words import closest

GROUPS = ("scene", "init", "densify", "raster", "train", "eval", "tracking", "launch", "experiment")
EXTERNAL_FOLDER = "external"  # below a group: choices that are no arms of gsbench's own, which glob(*) leaves out
NAMED_APART = ("name", "seed")  # not hashed, and yet each of their values has a trial of its own
OPTIONS = ("-m", "--multirun", "--dry-run", "--config-dir", "--cfg", "--info", "--help", "--version")
KEY = re.compile(r"[+~]*\w+([./]\w+)*")


def parse(argv: Sequence[str]) -> tuple[list[str], bool, bool]:
    """Overrides, whether to expand lists (``-m``), and whether to only list the trials (``--dry-run``)."""
    overrides: list[str] = []
    folders: list[Path] = []
    multirun = dry_run = False
    words = iter(argv)
    for word in words:
        if word in ("-m", "--multirun"):
            multirun = True
        elif word == "--dry-run":
            dry_run = True
        elif word.split("=")[0] in ("--config-dir", "-cd"):
            folders.append(Path(word.partition("=")[2] or next(words, "")))
        elif word.startswith("-"):
            raise InputError(
                f"{word} is not an option{closest(word, OPTIONS)} "
                "(there are -m, --dry-run, --config-dir FOLDER, --cfg job, --info, --help)"
            )
        else:
            overrides.append(word)
    return [*search_path(folders, overrides), *overrides], multirun, dry_run


def search_path(folders: Sequence[Path], overrides: Sequence[str]) -> list[str]:
    """The entries of Hydra's search path that ``--config-dir`` stands for."""
    if not folders:
        return []
    if len(folders) > 1 or any(word.startswith("hydra.searchpath=") for word in overrides):
        raise InputError("--config-dir names one folder: for several, give hydra.searchpath=[file://A,file://B] alone")
    if folders[0] == Path():
        raise InputError("--config-dir needs a folder")
    if not folders[0].is_dir():
        raise InputError(f"--config-dir {folders[0]}: no such folder")
    escaped = str(folders[0].resolve()).replace("'", "\\'")
    return [f"hydra.searchpath=['file://{escaped}']"]


def check_words(words: Sequence[str]) -> None:
    """Raise InputError, one line, for the first word that nothing would read or that Hydra would choke on."""
    experiments = [word for word in words if word.startswith("+experiment=")]
    if len(experiments) > 1:
        raise InputError(f"{' '.join(experiments)}: two experiments are two sweeps: give a command for each")
    for word in words:
        override = parse_word(word)
        key = override.get_key_element().lstrip("+~")
        if key.startswith(("hydra.", "hydra/")):
            continue  # Hydra's own settings: what of them cannot be is said of the whole (app/hydra_app.py)
        elif key == "experiment" or key.startswith(("experiment/", "experiment@", "experiment.")):
            _check_experiment_word(word, override)
        elif "@" in key:
            raise InputError(f"{word!r}: a group has one place, so leave out the @ and what follows it")
        elif override.is_delete():
            _check_deletion(word, key)
        elif key in GROUPS and not _is_choice(override):
            raise InputError(f"{word!r}: choose one by its name: {key}={', '.join(options(key))}")


def parse_word(word: str) -> Override:
    """A word as Hydra reads it. Raises InputError where it is no ``key=value``."""
    if "=" not in word and not word.startswith("~"):
        raise InputError(f"{word!r} is not a setting like key=value")
    try:
        override = OverridesParser.create().parse_override(word)
    except HydraException as error:
        reason = re.sub(r",? expecting .*", "", str(error).splitlines()[0])
        raise InputError(f"{word!r} is not a setting like key=value ({reason}){_quoted(word)}") from error
    if not override.key_or_group.strip():
        raise InputError(f"{word!r} names no setting")
    return override


def _quoted(word: str) -> str:
    """Say how a word would be read whose value has characters that mean something to Hydra."""
    key, _, value = word.partition("=")
    if not KEY.fullmatch(key):
        return ""
    function = re.fullmatch(r"(\w+)\((.*)\)", value)
    if function and function.group(1) != "glob":
        return ""  # in quotes it would be a text, not a list of values
    start, value, end = (f"{key}=glob(", function.group(2), ")") if function else (f"{key}=", value, "")
    quoted = f"{start}'{value}'{end}" if '"' in value else f'{start}"{value}"{end}'
    return f"; special characters need quotes of their own, which the shell must leave: {shlex.quote(quoted)}"


def check_single(words: Sequence[str], mend: str) -> None:
    """`check_words`, and refuse a list of values, with the ``mend``, where one configuration is asked for."""
    check_words(words)
    if swept := [word for word in words if is_sweep(word)]:
        raise InputError(f"{swept[0]} lists several values: {mend}")


def is_sweep(word: str) -> bool:
    """Return whether a word lists several values."""
    return bool(parse_word(word).is_sweep_override())


def check_sweep(override: Override) -> None:
    """Raise InputError for a list of values whose trials would all be one and the same trial, or cannot be listed."""
    if not override.is_discrete_sweep():
        key = override.get_key_element().lstrip("+~")
        raise InputError(
            f"{override.input_line}: a sweep is a list of values, such as {key}=1,2,3; "
            "intervals are for hydra/sweeper=optuna"
        )
    check_makes_trials(override)


def check_makes_trials(override: Override) -> None:
    """Raise InputError for a setting whose values would all give one and the same trial."""
    key = override.get_key_element().lstrip("+~")
    first, _, last = key.partition(".")
    without_effect = last in (*WITHOUT_EFFECT, *DECLARED.get(first, ()))
    if (first in NOT_HASHED and first not in NAMED_APART) or without_effect:
        raise InputError(f"{override.input_line}: {key} makes no other trial, so choose one value of it")


def options(group: str, folders: Sequence[Path] = ()) -> list[str]:
    """The YAML files of a group that come with gsbench; those of other programs by their folder, ``external/NAME``.

    Those of a user's ``folders`` follow.
    """
    found: dict[str, None] = {}
    for folder in (Path(conf_dir()), *folders):
        found |= dict.fromkeys(sorted(path.stem for path in Path(folder, group).glob("*.yaml")))
        others = Path(folder, group, EXTERNAL_FOLDER).glob("*.yaml")
        found |= dict.fromkeys(sorted(f"{EXTERNAL_FOLDER}/{path.stem}" for path in others))
    return list(found)


def searched_folders(words: Sequence[str]) -> list[Path]:
    """The folders of a user's own that ``hydra.searchpath`` among ``words`` names."""
    values = [parse_word(word).value() for word in words if word.startswith("hydra.searchpath=")]
    places = [str(place) for value in values if isinstance(value, list) for place in value]
    return [Path(place.removeprefix("file://")) for place in places if not place.startswith("pkg://")]


def _check_experiment_word(word: str, override: Override) -> None:
    choices = ", ".join(options("experiment"))
    if not word.startswith("+experiment="):
        raise InputError(f"{word}: write +experiment=NAME (choose: {choices})")
    if override.is_sweep_override() or isinstance(override.value(), list):
        raise InputError(f"{word}: two experiments are two sweeps: give a command for each")
    if not _is_choice(override):
        raise InputError(f"{word}: write +experiment=NAME (choose: {choices})")


def _check_deletion(word: str, key: str) -> None:
    group = key.partition(".")[0]
    if key == group or group not in (*COMPONENTS, "raster"):
        raise InputError(f"{word!r}: a setting cannot be taken away: give it another value")


def _is_choice(override: Override) -> bool:
    """Return whether the value can be one name in a group, a list of them in a sweep, or its settings ({a: 1})."""
    return override.is_sweep_override() or isinstance(override.value(), str | int | float | dict)
