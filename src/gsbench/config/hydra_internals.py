"""Parts of Hydra that are not public, in one place: what another version of Hydra may have changed.

gsbench does what ``hydra.main`` does step for step (`gsbench.app.hydra_app`), for which Hydra has no public functions.
Hydra 1.3 and 1.4 are tested (``make test-next-hydra``).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import hydra.utils
from hydra import __version__
from hydra._internal.callbacks import Callbacks
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.sources_registry import SourcesRegistry

__all__ = ["VERSION_BASE", "WHITELIST", "Callbacks", "ConfigLoaderImpl", "SourcesRegistry"]

# Hydra 1.3 wants to be told whose defaults hold; from 1.4 on there is one set of them, and being told is warned of.
VERSION_BASE: dict[str, Any] = {"version_base": "1.3"} if __version__.startswith("1.3.") else {}
# From 1.4 on Hydra makes objects within this context of the named classes alone (``mine.*``: all of a module).
WHITELIST: Callable[[Sequence[str]], AbstractContextManager[Any]] = getattr(
    hydra.utils, "execution_whitelist", lambda names: nullcontext()
)
