"""Another program as an arm: the settings of what trains in place of gsbench.

It is chosen in the group ``densify``, because an arm of a table is an initialiser and a densifier. In its command
``{name}`` stands for what is known when it runs. Loads no torch.
"""

import os
import re
import shlex
import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath, PureWindowsPath
from tempfile import TemporaryDirectory
from typing import Annotated, Any

from annotated_types import MinLen, Predicate, doc
from pydantic import PositiveFloat

from gsbench.errors import InputError
from gsbench.settings import MISSING, check_settings
from gsbench.words import closest

# Placeholders of a command beside the options of its YAML.
DATA = "data"  # folder of the training views: images/ and the COLMAP model sparse/0
TEST_CAMERAS = "test_cameras"  # folder of the test views' cameras: transforms.json and the COLMAP model sparse/0
OUTPUT = "output"  # empty folder, in which the program also starts
KNOWN = (DATA, TEST_CAMERAS, OUTPUT, "iterations", "seed", "device", "threads")
PLACES = (DATA, TEST_CAMERAS, OUTPUT)  # folders, which are absolute
MODEL_SUFFIX = ".ply"

Text = Annotated[str, MinLen(1), Predicate(lambda text: text != MISSING and bool(text.strip())), doc("a text")]
CommandLine = Annotated[list[str] | str, doc("a list of words, or a text that is split as a shell would")]
PLACEHOLDER = re.compile(r"\{(\w+)\}")
Command = str | Sequence[str]  # one text is split as a shell would; none is run


def words_of(command: Command, key: str) -> list[str]:
    """A command's words; the setting ``key`` is named in errors. Raises InputError for an empty one, or open quotes."""
    try:
        words = shlex.split(command) if isinstance(command, str) else [str(word) for word in command]
    except ValueError as error:
        raise InputError(f"{key} cannot be split into words ({error}): write it as a list") from error
    if not words or not words[0]:
        raise InputError(f"{key} is empty: name the program to run")
    return words


def program_of(command: Command, options: Mapping[str, object], key: str = "densify.command") -> str:
    """The program that the setting ``key`` runs: its first word, in which ``options`` may stand."""
    return fill(words_of(command, key)[0], options, key)


def names_in(texts: Iterable[str]) -> set[str]:
    """The placeholders that stand in ``texts``."""
    return {name for text in texts for name in PLACEHOLDER.findall(text)}


def fill(text: str, values: Mapping[str, object], key: str) -> str:
    """``text`` with every placeholder replaced once. Raises InputError, naming ``key``, for one that is not known."""

    def value(match: re.Match[str]) -> str:
        name = match[1]
        if name not in values:
            there = ", ".join(f"{{{known}}}" for known in values)
            raise InputError(f"{key}: nothing is known as {{{name}}}{closest(name, values)} (there are {there})")
        return str(values[name])

    return PLACEHOLDER.sub(value, text)


def check_pattern(pattern: str) -> None:
    """Raise InputError for a pattern that can fit no file below a folder."""
    key = f"densify.result={pattern}"
    parts = PurePosixPath(pattern).parts
    if (
        not parts
        or PurePosixPath(pattern).is_absolute()
        or PureWindowsPath(pattern).drive
        or {"..", "\0"} & {*parts, *pattern}
    ):
        raise InputError(f"{key}: give a pattern of files below the program's output folder, such as point_cloud/*.ply")
    try:
        with TemporaryDirectory() as empty:
            list(Path(empty).glob(pattern))
    except (ValueError, NotImplementedError, IndexError, OSError, RecursionError) as error:
        raise InputError(
            f"{key} is not a pattern of files ({error}): ** stands for folders, so it is a part of its own"
        ) from None


@dataclass(frozen=True, kw_only=True)
class External:
    """A program that trains on a folder of training views and leaves a model, or renders of the test views.

    ``command`` is run without a shell; ``{data}``, ``{output}`` and the other names of `KNOWN`, and those of
    ``options``, are replaced in it, in ``result`` and in ``environment``. ``result`` is a pattern below the output
    folder: of one 3DGS PLY, or of the pictures of the test views, whose names are matched (or ``by_order``).
    ``version`` names the program's version: it is part of the results' key. ``version_command`` prints something that
    must contain it.

    Examples:
        A program ``train.py`` that writes ``point_cloud.ply``:

        >>> trainer = External(
        ...     command="python train.py --data {data} --out {output} --steps {iterations} --rate {rate}",
        ...     result="point_cloud.ply",
        ...     version="1.2",
        ...     options={"rate": 0.01},
        ... )
        >>> trainer.program, trainer.leaves_model
        ('python', True)
        >>> External(command="python train.py", result="*.png", version="1.2")
        Traceback (most recent call last):
        gsbench.errors.InputError: densify.command has no {data}: the folder that the program is to train on
    """

    command: CommandLine
    result: Text
    version: Text
    version_command: CommandLine | None = None
    options: dict[str, Any] = field(default_factory=dict)
    environment: dict[str, str] = field(default_factory=dict)  # further variables
    by_order: bool = False
    time_limit_minutes: PositiveFloat | None = None  # then the program is ended, and the trial has failed

    def __post_init__(self) -> None:
        check_settings(self, "densify")
        for name, value in self.options.items():
            if value == MISSING:
                raise InputError(f"densify.options.{name} is not set: give it a value")
            if not str(name).isidentifier() or name in KNOWN or isinstance(value, Mapping | list):
                raise InputError(
                    f"densify.options.{name}: an option is one value with a name of its own, none of {', '.join(KNOWN)}"
                )
        check_pattern(
            fill(self.result, dict.fromkeys(KNOWN, "1") | dict.fromkeys(PLACES, "/") | self.options, "densify.result")
        )
        known = dict.fromkeys((*KNOWN, *self.options))
        for key, text in [("command", word) for word in self.words] + [("result", self.result)]:
            fill(text, known, f"densify.{key}")
        if not names_in(self.words) & {DATA}:
            raise InputError("densify.command has no {data}: the folder that the program is to train on")

    @property
    def words(self) -> list[str]:
        """The command's words, with their placeholders."""
        return words_of(self.command, "densify.command")

    @property
    def leaves_model(self) -> bool:
        """Return whether the result is a model; else it is pictures."""
        return self.result.lower().endswith(MODEL_SUFFIX)

    @property
    def needs_test_cameras(self) -> bool:
        return TEST_CAMERAS in names_in([*self.words, *self.environment.values()])

    @property
    def program(self) -> str:
        """The program as it is called."""
        return program_of(self.command, self.options)

    def executable(self) -> str:
        """The path of the program. Raises InputError where this machine has none."""
        path = self.environment.get("PATH", os.environ.get("PATH"))
        found = shutil.which(Path(self.program).expanduser(), path=path)
        if found is None:
            raise InputError(
                f"densify.command: this machine has no program {self.program!r}: install it (docs/other_trainers.md "
                "says how), or give its path"
            )
        return str(Path(found).absolute())
