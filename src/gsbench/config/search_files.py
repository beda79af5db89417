"""A check of the user's places of files, before Hydra reads them."""

from collections.abc import Sequence
from importlib.util import find_spec
from itertools import chain
from pathlib import Path

import yaml

from gsbench.config.explain import explained
from gsbench.errors import InputError
from gsbench.parsing import MAX_VALUES


def check_places(folders: Sequence[Path], packages: Sequence[str]) -> None:
    """Refuse a missing place of files, and a file whose YAML aliases stand for too many values.

    A few lines of nested aliases can stand for billions of values ("billion laughs"), and Hydra
    would expand them.
    """
    files: list[Path] = []
    for package in packages:
        with explained([]):
            spec = find_spec(package)
        if spec is None:
            raise InputError(f"hydra.searchpath names {package}: no such package")
    for folder in folders:
        if not folder.is_dir():  # Hydra only warns
            raise InputError(f"hydra.searchpath names {folder}: no such folder")
        for pattern in ("*.yaml", "*/*.yaml", "*/*/*.yaml"):
            files += folder.glob(pattern)
    for file in files:
        try:
            text = file.read_text(encoding="utf-8") if file.is_file() else ""
            if "*" not in text:
                continue
            # The loader in Python raises RecursionError for deep nesting; that in C would crash.
            count = _expanded_size(yaml.compose(text, Loader=yaml.SafeLoader), {})
        # Hydra reports it if it reads the file
        except (OSError, ValueError, RecursionError, yaml.YAMLError):
            continue
        if count > MAX_VALUES:
            raise InputError(f"{file}: its aliases stand for more than {MAX_VALUES:,} values")


def _expanded_size(node: yaml.Node | None, sizes: dict[int, int]) -> int:
    """The number of values in a YAML node after each alias is replaced by what it names.

    ``sizes`` keeps the numbers that are known, by the id of the node.
    """
    if id(node) not in sizes:
        sizes[id(node)] = 1  # counts where an alias stands for a mapping or list that contains it
        parts = node.value if isinstance(node, yaml.CollectionNode) else []
        if isinstance(node, yaml.MappingNode):
            parts = chain(*parts)  # keys and values
        sizes[id(node)] = 1 + sum(_expanded_size(part, sizes) for part in parts)
    return sizes[id(node)]
