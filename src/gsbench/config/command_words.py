"""Parse and check the words of a command line, before Hydra composes anything."""

import re
from collections.abc import Sequence
from itertools import islice, product
from pathlib import Path
from typing import Any

from hydra.core.override_parser.types import Override

from gsbench.config.groups import GROUPS, REMOVABLE, options
from gsbench.config.overrides import bare_key, is_sweep, key_of, parse_word
from gsbench.config.search_path import search_path, searched_folders
from gsbench.config.trust import reading
from gsbench.errors import InputError
from gsbench.runs.code import PERMISSIONS
from gsbench.runs.configuration import READING, WITHOUT_EFFECT, is_hashed, purpose
from gsbench.words import did_you_mean

OPTIONS = (
    "-m",
    "--multirun",
    "--dry-run",
    "--config-dir",
    "--cfg",
    "--info",
    "--help",
    "--version",
)
# Hydra's options that replace the main configuration
MAIN_CONFIG_OPTIONS = ("--config-name", "-cn", "--config-path", "-cp")
# Settings that are texts, by the last part of their keys.
TEXTS = (
    "name",
    "runs",
    "path",
    "images",
    "sparse",
    "masks",
    "train_list",
    "test_list",
    "weights",
    "uri",
    "version",
)
MAX_POINTS = 1_000_000  # values of one list; more would fill the memory
VARIABLE = re.compile(r"\$\{oc\.env:\s*['\"]?(\w+)")


def parse(argv: Sequence[str]) -> tuple[list[str], bool, bool]:
    """Return the overrides, whether lists expand (``-m``), and whether trials are only listed.

    Raises InputError for an unknown option.
    """
    overrides: list[str] = []
    folders: list[Path] = []
    multirun = dry_run = False
    words = iter(argv)
    for word in words:
        option, _, value = word.partition("=")
        if word in ("-m", "--multirun"):
            multirun = True
        elif word == "--dry-run":
            dry_run = True
        elif option in ("--config-dir", "-cd"):
            folders.append(Path(value or next(words, "")))
        elif option in MAIN_CONFIG_OPTIONS:
            name = value or next(words, "NAME")
            name = name if option in ("--config-name", "-cn") else "NAME"
            raise InputError(
                f"{word}: gsbench's main configuration is its own: write yours to "
                f"FOLDER/experiment/{name}.yaml, and give --config-dir FOLDER +experiment={name}"
            )
        elif word.startswith("-"):
            near, key = did_you_mean(word, OPTIONS), option.lstrip("-")
            if key.partition(".")[0] in GROUPS:
                near = f"; a setting has no dashes: {key}=…"
            raise InputError(
                f"{word} is not an option{near} (there are -m, --dry-run, --config-dir FOLDER, "
                "--cfg job, --info, --help)"
            )
        else:
            overrides.append(word)
    return [*search_path(folders, overrides), *overrides], multirun, dry_run


def check_words(words: Sequence[str]) -> None:
    """Raise InputError for the first word that has no effect or that Hydra cannot take."""
    experiments = [word for word in words if word.startswith("+experiment=")]
    if len(experiments) > 1:
        raise InputError(
            f"{' '.join(experiments)}: two experiments are two sweeps: give a command for each"
        )
    for word in words:
        override, key = parse_word(word), key_of(word)
        # Hydra's own settings are otherwise checked after composition (config/trust.py).
        if key.startswith(("hydra.", "hydra/")):
            if override.is_sweep_override():
                raise InputError(
                    f"{word}: Hydra's own settings apply to all trials, so choose one value"
                )
        elif key == "experiment" or key.startswith(("experiment/", "experiment@", "experiment.")):
            _check_experiment_word(word, override, searched_folders(words))
        elif "@" in key:
            raise InputError(
                f"{word!r}: a group has one place, so leave out the @ and what follows it"
            )
        elif override.is_delete():
            check_removal(override)
        elif key in GROUPS and not _is_choice(override):
            choices = ", ".join(options(key, searched_folders(words)))
            raise InputError(f"{word!r}: choose one by its name: {key}={choices}")
        elif key.rpartition(".")[2] in TEXTS:
            check_text(word)


def check_text(word: str) -> None:
    """Raise InputError for a text that Hydra would read as a number and write differently.

    ``name=1_1`` would become 11, and ``name=1e3`` 1000.0, so results would land in a folder that
    the user did not name.
    """
    key, _, values = word.partition("=")
    for text in map(str.strip, values.split(",")):
        for read in (int, float):
            try:
                number = str(read(text))
            except ValueError:
                continue
            if number != text:
                raise InputError(
                    f"{word!r}: {text} would be read as the number {number}: type "
                    f"'{key}=\"{text}\"'"
                )
            break


def check_removal(override: Override) -> None:
    """Raise InputError unless the removed setting is an option of a component.

    A user's class may lack options that the chosen file sets.
    """
    group, dot, _ = bare_key(override.get_key_element()).partition(".")
    if not dot or group not in REMOVABLE:
        raise InputError(
            f"{override.input_line!r}: a setting cannot be removed: give it another value"
        )


def typed_permissions(words: Sequence[str]) -> tuple[str, ...]:
    """The names that a command line allows by ``allow_targets=[…]``; the last such word counts."""
    allowed: tuple[str, ...] = ()
    for word in words:
        override = parse_word(word)
        if key_of(word) != PERMISSIONS or override.is_sweep_override():
            continue
        names: Any = override.value()
        if not isinstance(names, list) or not all(
            isinstance(name, str) and name and "$" not in name for name in names
        ):
            raise InputError(
                f"{word}: {PERMISSIONS} is a list of names, such as {PERMISSIONS}=[mine]"
            )
        allowed = tuple(names)
    return allowed


def typed_readings(words: Sequence[str]) -> tuple[str, ...]:
    """The permissions to read the variables that the words themselves read by ``${oc.env:…}``."""
    return tuple(dict.fromkeys(reading(name) for name in VARIABLE.findall(" ".join(words))))


def check_single(words: Sequence[str], advice: str) -> None:
    """Run `check_words`, and raise InputError with ``advice`` for a word with several values."""
    check_words(words)
    if swept := [word for word in words if is_sweep(word)]:
        raise InputError(f"{swept[0]} lists several values: {advice}")


def grid_points(overrides: Sequence[Override]) -> list[list[str]]:
    """The words of every point of the grid that ``overrides`` span.

    If two overrides set one key, the later one counts. Raises InputError for an interval, and for
    a list that is empty or has more than `MAX_POINTS` values.
    """
    choices: dict[str, list[str]] = {}
    for override in overrides:
        key, word = override.get_key_element(), override.input_line
        if not override.is_sweep_override():
            value = override.get_value_element_as_str()
            choices[key] = [key if override.is_delete() else f"{key}={value}"]
            continue
        if is_interval(override):
            raise InputError(
                f"{word}: a sweep is a list of values, such as {bare_key(key)}=1,2,3; intervals "
                "are for gsbench's own sweeper, which searches in them (docs/search.md)"
            )
        check_makes_trials(override)
        try:
            values = islice(override.sweep_string_iterator(), MAX_POINTS + 1)
            choices[key] = [f"{key}={value}" for value in values]
        except ValueError as error:  # such as a range with a step of 0
            raise InputError(f"{word}: {error}") from error
        if not choices[key]:
            raise InputError(f"{word} lists no value")
        if len(choices[key]) > MAX_POINTS:
            raise InputError(f"{word} lists more than {MAX_POINTS:,} values")
    return [list(point) for point in product(*choices.values())]


def is_interval(override: Override) -> bool:
    """Return whether a word gives an interval for a search instead of a list of values."""
    return override.is_sweep_override() and not override.is_discrete_sweep()


def check_makes_trials(override: Override) -> None:
    """Raise InputError for a setting whose values would all give the same trial."""
    key = bare_key(override.get_key_element())
    if not makes_other_trials(key):
        raise InputError(
            f"{override.input_line}: {key} does not make a different trial, so choose one value"
        )


def makes_other_trials(key: str) -> bool:
    """Return whether each value of a setting gives a different trial."""
    first, _, last = key.partition(".")
    without_effect = last in WITHOUT_EFFECT or purpose(key) == READING
    # name and seed are not in the hash, but in the path of the trial's folder
    return not without_effect and (is_hashed(first) or first in ("name", "seed"))


def _check_experiment_word(word: str, override: Override, folders: Sequence[Path]) -> None:
    several = override.is_sweep_override() or isinstance(override.value(), list)
    if several and word.startswith("+experiment="):
        raise InputError(f"{word}: two experiments are two sweeps: give a command for each")
    if several or not word.startswith("+experiment=") or not _is_choice(override):
        raise InputError(
            f"{word}: write +experiment=NAME (choose: {', '.join(options('experiment', folders))})"
        )


def _is_choice(override: Override) -> bool:
    """Return whether the value can choose in a group: a name, names, or settings ({a: 1})."""
    return override.is_sweep_override() or isinstance(override.value(), str | int | float | dict)
