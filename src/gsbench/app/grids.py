"""The points of a sweep: what its words list, and what an experiment's file joins.

An experiment's file may join several grids, below ``hydra.sweeper.grids``. Each names settings and their values as
``hydra.sweeper.params`` does, which they share:

    hydra:
      mode: MULTIRUN
      sweeper:
        params:
          seed: 0,1,2
        grids:
          - densify: adc
          - densify: volumetric
            densify.volume_threshold: 0.01,0.03

A word of the command line whose setting some of the grids list is meant for these, and takes the place of what they
list; any other word is meant for all.
"""

from collections.abc import Mapping, Sequence
from itertools import product
from typing import Any

from hydra.core.override_parser.types import Override

from gsbench.config.command_words import check_sweep, key_of
from gsbench.errors import InputError

GRIDS = "hydra.sweeper.grids"


def grid(overrides: Sequence[Override]) -> list[list[str]]:
    """The words of every point of the grid that ``overrides`` span; of two for one key the later counts."""
    choices: dict[str, list[str]] = {}
    for override in overrides:
        key = override.get_key_element()
        if override.is_sweep_override():
            check_sweep(override)
            try:
                choices[key] = [f"{key}={value}" for value in override.sweep_string_iterator()]
            except ValueError as error:  # such as a range of steps of 0
                raise InputError(f"{override.input_line}: {error}") from error
            if not choices[key]:
                raise InputError(f"{override.input_line} lists no value")
        else:
            choices[key] = [key if override.is_delete() else f"{key}={override.get_value_element_as_str()}"]
    return [list(point) for point in product(*choices.values())]


def is_interval(override: Override) -> bool:
    """Return whether a word gives an interval, in which a value is searched, in place of a list of values."""
    return override.is_sweep_override() and not override.is_discrete_sweep()


def text_of(override: Override) -> str:
    """The value of a word as it was typed."""
    return str(override.input_line).partition("=")[2]


def checked_grids(grids: Any) -> list[dict[str, str]]:
    """The grids as they stand in the configuration; raises InputError for what is no list of settings with values."""
    if not isinstance(grids, list) or not all(isinstance(grid, dict) and grid for grid in grids):
        raise InputError(f"{GRIDS} must be a list, each a mapping of settings to values, got {grids!r}")
    return [{str(key): _text(key, value) for key, value in grid.items()} for grid in grids]


def words_of_grids(
    params: Mapping[str, Any], grids: Sequence[Mapping[str, str]], given: Sequence[str]
) -> list[list[str]]:
    """List the words of each grid: its own, the shared ones, and of the command line those that are meant for it.

    Of two for one setting the later counts; trials are in the order of the grids, the shared settings varying fastest.
    """
    listed = {bare(key) for grid in grids for key in grid}
    return [
        [
            *(f"{key}={value}" for key, value in grid.items()),
            *(f"{key}={value}" for key, value in params.items() if bare(key) not in map(bare, grid)),
            *(word for word in given if key_of(word) not in listed - set(map(bare, grid))),
        ]
        for grid in grids or [{}]
    ]


def bare(key: str) -> str:
    """A key without the signs by which it is added or taken away."""
    return key.lstrip("+~")


def _text(key: object, value: object) -> str:
    if value is None or isinstance(value, list | dict):
        raise InputError(f"{GRIDS}: {key} must list values as on the command line, such as 1,2,3, got {value!r}")
    return str(value).lower() if isinstance(value, bool) else str(value)
