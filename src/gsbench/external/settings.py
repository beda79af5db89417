"""The settings of another program that trains in place of gsbench.

It is chosen in the group ``densify``, because an arm of a table is an initialiser and a densifier.
A placeholder ``{name}`` in the command is replaced when the program runs. Loads no torch.
"""

import os
import re
import shlex
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath, PureWindowsPath
from tempfile import TemporaryDirectory
from typing import Annotated, Any

from annotated_types import MinLen, Predicate, doc
from pydantic import PositiveFloat

from gsbench.errors import InputError
from gsbench.settings import MISSING, check_settings
from gsbench.words import did_you_mean

# Placeholders of a command, in addition to the options of its YAML file.
DATA = "data"  # folder of the training views: images/ and the COLMAP model sparse/0
OUTPUT = "output"  # empty folder, which is also the program's working folder
PLACEHOLDERS = (DATA, OUTPUT, "iterations", "seed", "device", "threads")
FOLDERS = (DATA, OUTPUT)  # absolute paths
MODEL_SUFFIX = ".ply"

Text = Annotated[
    str, MinLen(1), Predicate(lambda text: text != MISSING and bool(text.strip())), doc("a text")
]
CommandLine = Annotated[
    list[str] | str, doc("a list of words, or a text that is split as a shell would")
]
PLACEHOLDER = re.compile(r"\{(\w+)\}")
Command = str | Sequence[str]  # one text is split as a shell would, but no shell runs


def split_command(command: Command, key: str) -> list[str]:
    """Split a command into words; raises InputError naming ``key`` if it is empty or malformed."""
    try:
        words = shlex.split(command) if isinstance(command, str) else list(map(str, command))
    except ValueError as error:
        what = f"{key} cannot be split into words ({error})"
        raise InputError(f"{what}: write it as a list") from error
    if not words or not words[0]:
        raise InputError(f"{key} is empty: name the program to run")
    return words


def program_of(
    command: Command, options: Mapping[str, object], key: str = "densify.command"
) -> str:
    """The program that the setting ``key`` runs: its first word, with ``options`` filled in."""
    return fill_placeholders(split_command(command, key)[0], options, key)


def fill_placeholders(text: str, values: Mapping[str, object], key: str) -> str:
    """Replace each placeholder in ``text`` once. Raises InputError, naming ``key``, if unknown."""

    def value(match: re.Match[str]) -> str:
        name = match[1]
        if name not in values:
            names = ", ".join(f"{{{known}}}" for known in values)
            raise InputError(
                f"{key}: unknown placeholder {{{name}}}{did_you_mean(name, values)} (there are "
                f"{names})"
            )
        return str(values[name])

    return PLACEHOLDER.sub(value, text)


def check_pattern(pattern: str) -> None:
    """Raise InputError for a pattern that cannot fit a model below a folder."""
    key = f"densify.result={pattern}"
    parts = PurePosixPath(pattern).parts
    if (
        not parts
        or PurePosixPath(pattern).is_absolute()
        or PureWindowsPath(pattern).drive
        or {"..", "\0"} & {*parts, *pattern}
    ):
        raise InputError(
            f"{key}: give a pattern of files below the program's output folder, such as "
            "point_cloud/*.ply"
        )
    if not pattern.lower().endswith(MODEL_SUFFIX):
        raise InputError(
            f"{key} must name a 3DGS model, as *.ply; renders of a program are entered by gsbench "
            "evaluate --as"
        )
    try:
        with TemporaryDirectory() as empty:
            list(Path(empty).glob(pattern))
    except (ValueError, NotImplementedError, IndexError, OSError, RecursionError) as error:
        raise InputError(
            f"{key} is not a pattern of files ({error}): ** stands for folders, so it is a part "
            "of its own"
        ) from None


@dataclass(frozen=True, kw_only=True)
class External:
    """A program that trains on a folder of views and writes a 3DGS PLY.

    ``command`` runs without a shell. ``{data}``, ``{output}``, the other `PLACEHOLDERS` and the
    names of ``options`` are replaced in ``command``, ``result`` and ``environment``. ``result`` is
    a pattern of the PLY below the output folder. ``version`` is the program's version, which is
    part of the key of its results. The output of ``version_command`` must contain it.

    Examples:
        A program ``train.py`` that writes ``point_cloud.ply``:

        >>> trainer = External(
        ...     command="python train.py --data {data} --to {output} -n {iterations} --lr {lr}",
        ...     result="point_cloud.ply",
        ...     version="1.2",
        ...     options={"lr": 0.01},
        ... )
        >>> trainer.program
        'python'
        >>> External(
        ...     command="python train.py", result="*.ply", version="1.2"
        ... )  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        gsbench.errors.InputError: densify.command has no {data}: the folder that ...
    """

    command: CommandLine
    result: Text
    version: Text
    version_command: CommandLine | None = None
    options: dict[str, Any] = field(default_factory=dict)
    environment: dict[str, str] = field(default_factory=dict)  # additional environment variables
    # after it, the program is ended and the trial fails
    time_limit_minutes: PositiveFloat | None = None

    def __post_init__(self) -> None:
        check_settings(self, "densify")
        for name, value in self.options.items():
            if value == MISSING:
                raise InputError(f"densify.options.{name} is not set: give it a value")
            own_name = str(name).isidentifier() and name not in PLACEHOLDERS
            if not own_name or isinstance(value, Mapping | list):
                raise InputError(
                    f"densify.options.{name}: an option is one value with a name of its own, none "
                    f"of {', '.join(PLACEHOLDERS)}"
                )
        # An option's value may make the pattern lead out of the folder, so values are filled in.
        examples = dict.fromkeys(PLACEHOLDERS, "1") | dict.fromkeys(FOLDERS, "/")
        pattern = fill_placeholders(self.result, examples | self.options, "densify.result")
        check_pattern(pattern)
        known = dict.fromkeys((*PLACEHOLDERS, *self.options))
        for key, text in [("command", word) for word in self.words] + [("result", self.result)]:
            fill_placeholders(text, known, f"densify.{key}")
        if not any(f"{{{DATA}}}" in word for word in self.words):
            raise InputError(
                "densify.command has no {data}: the folder that the program is to train on"
            )

    @property
    def words(self) -> list[str]:
        """The command's words, with their placeholders."""
        return split_command(self.command, "densify.command")

    @property
    def program(self) -> str:
        """The program as the command calls it."""
        return program_of(self.command, self.options)

    def executable(self) -> str:
        """The path of the program; raises InputError if this machine does not have it."""
        path = self.environment.get("PATH", os.environ.get("PATH"))
        program_path = shutil.which(Path(self.program).expanduser(), path=path)
        if program_path is None:
            raise InputError(
                f"densify.command: this machine has no program {self.program!r}: install it "
                "(docs/other_trainers.md says how), or give its path"
            )
        return str(Path(program_path).absolute())
