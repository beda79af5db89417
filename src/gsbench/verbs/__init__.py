"""The verbs of the command line: functions ``VERB(argv, runs) -> exit code`` on ``runs``."""

import importlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from gsbench.parsing import table_beside

VERBS: dict[str, dict[str, Any]] = table_beside(__file__, "verbs.yaml")


def load_verb(name: str) -> Callable[[list[str], Path], int]:
    """The function of a verb; its module is imported only now."""
    module = importlib.import_module(f"gsbench.verbs.{VERBS[name]['module']}")
    return getattr(module, name)
