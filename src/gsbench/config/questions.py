"""Questions to Hydra about the configuration: to show it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from omegaconf import DictConfig, OmegaConf

from gsbench.config.hydra_entry import run_main


def answer(argv: Sequence[str]) -> None:
    """Let Hydra answer a question such as ``--cfg job`` on the standard output; no trial is run."""

    def task(config: Any) -> None:
        raise AssertionError("Hydra was asked a question, and ran the task instead")

    run_main(task, argv)


def has_part(config: DictConfig, key: str) -> bool:
    """Return whether a configuration has the part ``key``, with dots."""
    return OmegaConf.select(config, key) is not None
