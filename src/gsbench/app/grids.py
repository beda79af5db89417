"""Joined sweeps: one experiment may hold several grids, which share what is said outside them.

An experiment's file lists them below ``hydra.sweeper.grids``. Each entry names settings and their values as
``hydra.sweeper.params`` does; the grids share what stands there:

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

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

from omegaconf import DictConfig, ListConfig, OmegaConf, open_dict, read_write

from gsbench.config.command_words import parse_word
from gsbench.errors import InputError

PLACE = "hydra.sweeper.grids"


@contextmanager
def grids_aside(master: DictConfig) -> Iterator[list[dict[str, str]]]:
    """The grids of a composed configuration, which lacks them while the block runs.

    Hydra resolves ``${…}`` in what it makes a sweeper of; in a grid that is for each trial to do. Raises InputError for
    what is no list of settings with values.
    """
    sweeper = master.hydra.sweeper
    if "grids" not in sweeper:
        yield []
        return
    with read_write(master.hydra), open_dict(sweeper):
        grids = sweeper.pop("grids")
    try:
        yield _checked(grids)
    finally:
        with read_write(master.hydra), open_dict(sweeper):
            sweeper.grids = grids


def _checked(grids: Any) -> list[dict[str, str]]:
    found = OmegaConf.to_container(grids, resolve=False) if isinstance(grids, ListConfig) else grids
    if not isinstance(found, list) or not all(isinstance(grid, dict) and grid for grid in found):
        raise InputError(f"{PLACE} must be a list, each a mapping of settings to values, got {found!r}")
    return [{str(key): _text(key, value) for key, value in grid.items()} for grid in found]


def words_of_grids(
    params: Mapping[str, Any], grids: Sequence[Mapping[str, str]], given: Sequence[str]
) -> list[list[str]]:
    """List the words of each grid: its own, the shared ones, and of the command line those that are meant for it.

    Of two for one setting the later counts; trials are in the order of the grids, the shared settings varying fastest.
    """
    listed = {_bare(key) for grid in grids for key in grid}
    return [
        [
            *(f"{key}={value}" for key, value in grid.items()),
            *(f"{key}={value}" for key, value in params.items() if _bare(key) not in map(_bare, grid)),
            *_meant_for(grid, given, listed),
        ]
        for grid in grids or [{}]
    ]


def _meant_for(grid: Mapping[str, str], given: Sequence[str], listed: set[str]) -> list[str]:
    own = {_bare(key) for key in grid}
    keys = [_bare(parse_word(word).get_key_element()) for word in given]
    return [word for word, key in zip(given, keys, strict=True) if key in own or key not in listed]


def _bare(key: str) -> str:
    return key.lstrip("+~")


def _text(key: object, value: object) -> str:
    if value is None or isinstance(value, list | dict):
        raise InputError(f"{PLACE}: {key} must list values as on the command line, such as 1,2,3, got {value!r}")
    return str(value).lower() if isinstance(value, bool) else str(value)
