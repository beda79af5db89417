"""A trial on its way from a command line to its results, with what is made of it on the way, each once.

Loads no torch before a part is asked for.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from gsbench.config.compose import TrialConfig
from gsbench.runs.trial_folder import TrialFolder

if TYPE_CHECKING:
    from gsbench.pipeline.parts import Parts


class Trial(TrialConfig):
    """A composed trial: it knows where its files lie, and keeps its parts from the first check until it has run."""

    @classmethod
    def of(cls, composed: TrialConfig) -> Trial:
        """The trial of a composition."""
        return cls(composed.values, composed.overrides, composed.job, composed.recorded)

    @cached_property
    def files(self) -> TrialFolder:
        """The trial's folder, with all that is in it."""
        return TrialFolder.of(self.values)

    @property
    def folder(self) -> Path:
        """The place of that folder."""
        return self.files.path

    @cached_property
    def parts(self) -> Parts:
        """The objects that the trial's configuration describes."""
        from gsbench.pipeline.parts import Parts

        return Parts(self.values)


def drop_parts(trials: Iterable[Trial]) -> None:
    """Let go of the parts of trials that have run, or that another process runs: they hold memory."""
    for trial in trials:
        vars(trial).pop("parts", None)
