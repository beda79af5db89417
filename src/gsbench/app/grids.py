"""The points of a sweep: the grid of its words, or several grids that an experiment's file joins.

An experiment's file lists such grids below ``hydra.sweeper.grids``. Each grid maps settings to values, and all share
the settings of ``hydra.sweeper.params``:

    hydra:
      mode: MULTIRUN
      sweeper:
        params:
          seed: 0,1,2
        grids:
          - densify: adc
          - densify: volumetric
            densify.volume_threshold: 0.01,0.03

If some grids list the setting of a word of the command line, the word replaces their values and does not reach the
other grids. Any other word is for all grids.
"""

from collections.abc import Mapping, Sequence
from itertools import product
from typing import Any

from hydra.core.override_parser.types import Override

from gsbench.config.command_words import check_sweep, key_of
from gsbench.errors import InputError

GRIDS = "hydra.sweeper.grids"


def grid_points(overrides: Sequence[Override]) -> list[list[str]]:
    """The words of every point of the grid that ``overrides`` span. If two set one key, the later counts."""
    choices: dict[str, list[str]] = {}
    for override in overrides:
        key = override.get_key_element()
        if override.is_sweep_override():
            check_sweep(override)
            try:
                choices[key] = [f"{key}={value}" for value in override.sweep_string_iterator()]
            except ValueError as error:  # such as a range with a step of 0
                raise InputError(f"{override.input_line}: {error}") from error
            if not choices[key]:
                raise InputError(f"{override.input_line} lists no value")
        else:
            choices[key] = [key if override.is_delete() else f"{key}={override.get_value_element_as_str()}"]
    return [list(point) for point in product(*choices.values())]


def is_interval(override: Override) -> bool:
    """Return whether a word gives an interval in which a value is searched, instead of a list of values."""
    return override.is_sweep_override() and not override.is_discrete_sweep()


def value_text(override: Override) -> str:
    """The value of a word as it was typed."""
    return str(override.input_line).partition("=")[2]


def checked_grids(grids: Any) -> list[dict[str, str]]:
    """The grids of the configuration, with values as texts. Raises InputError unless they are a list of mappings."""
    if not isinstance(grids, list) or not all(isinstance(grid, dict) and grid for grid in grids):
        raise InputError(f"{GRIDS} must be a list, each a mapping of settings to values, got {grids!r}")
    return [{str(key): _text(key, value) for key, value in grid.items()} for grid in grids]


def words_of_grids(
    params: Mapping[str, Any], grids: Sequence[Mapping[str, str]], given: Sequence[str]
) -> list[list[str]]:
    """The words of each grid: its own, the shared ``params``, and the words ``given`` that are for it.

    If two set one key, the later counts. Trials are in the order of the grids; the shared settings vary fastest.
    """
    listed = {bare_key(key) for grid in grids for key in grid}
    return [
        [
            *(f"{key}={value}" for key, value in grid.items()),
            *(f"{key}={value}" for key, value in params.items() if bare_key(key) not in map(bare_key, grid)),
            *(word for word in given if key_of(word) not in listed - set(map(bare_key, grid))),
        ]
        for grid in grids or [{}]
    ]


def bare_key(key: str) -> str:
    """A key without the signs that add or remove it."""
    return key.lstrip("+~")


def _text(key: object, value: object) -> str:
    if value is None or isinstance(value, list | dict):
        raise InputError(f"{GRIDS}: {key} must list values as on the command line, such as 1,2,3, got {value!r}")
    return str(value).lower() if isinstance(value, bool) else str(value)
