"""Questions to Hydra about the configuration: to show it, and to complete its words."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

from hydra.core.global_hydra import GlobalHydra
from hydra.plugins.completion_plugin import DefaultCompletionPlugin
from omegaconf import DictConfig, OmegaConf

from gsbench.config.command_words import check_search_path, parse, searched_folders, typed_permissions
from gsbench.config.compose import check_files
from gsbench.config.hydra_entry import CONFIG_NAME, hydra_ready, run_main
from gsbench.errors import InputError

NOT_TYPED = ("experiment", "experiment=", "hydra", "hydra.", "schema/")  # Hydra offers them, and gsbench refuses them


def answer(argv: Sequence[str]) -> None:
    """Let Hydra answer a question such as ``--cfg job`` on the standard output; no trial is run."""

    def task(config: Any) -> None:
        raise AssertionError("Hydra was asked a question, and ran the task instead")

    run_main(task, argv)


def has_part(config: DictConfig, key: str) -> bool:
    """Return whether a configuration has the part ``key``, with dots."""
    return OmegaConf.select(config, key) is not None


def settings_like(words: Sequence[str], word: str) -> list[str]:
    """Groups, their choices and keys, as Hydra completes ``word`` after ``words``; of a list, the last value."""
    head, comma, last = word.rpartition(",")
    key = head.partition("=")[0] + "=" if comma else ""
    try:
        overrides, _, _ = parse(words)
        check_search_path(overrides, typed_permissions(overrides))  # Hydra would import a package to look into it
        check_files(searched_folders(overrides))
    except InputError:
        return []
    first_values = [re.sub(r"^(\w+=[\w-]+),.*", r"\1", override) for override in overrides]  # Hydra: one at a time
    with hydra_ready():
        plugin = DefaultCompletionPlugin(GlobalHydra.instance().config_loader())
        try:
            found = plugin._query(CONFIG_NAME, " ".join([*first_values, key + last]))
        except Exception:  # noqa: BLE001 - a line that is half typed may be wrong in any way
            return []
    if comma:
        return [head + comma + candidate.removeprefix(key) for candidate in found]
    if not words or "+experiment=".startswith(word):
        found.append("+experiment=")
    return [_closed(candidate) for candidate in found if candidate not in NOT_TYPED]


def _closed(candidate: str) -> str:
    """A group that has folders below it is chosen as any other."""
    return candidate if re.search(r"[=./]", candidate) else f"{candidate}="
