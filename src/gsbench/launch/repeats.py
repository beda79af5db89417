"""Failures that other trials of a sweep would repeat, so that these are not started."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from gsbench.config.compose import Trial
from gsbench.launch.outcomes import Outcome
from gsbench.runs.nested import flatten

SCENE = ("scene",)
CLOUD = (*SCENE, "init")
ALL = (*CLOUD, "densify", "raster", "train", "eval", "device")
# the settings that a stage reads; in other stages, any setting may be the cause
READ_BY = {"scene": SCENE, "ground_truth": SCENE, "init": CLOUD}
PARTS = ("densify", "raster", "train", "eval")
NOT_NAMED = ("name",)  # settings whose values make no trial fail


@dataclass
class Repeats:
    """The failures so far in a sweep that no other seed would avert.

    These are wrong settings and files, and errors before the first iteration.
    """

    _known: list[tuple[tuple[str, ...], dict[str, Any], Outcome]] = field(default_factory=list)

    def note(self, trial: Trial, outcome: Outcome) -> None:
        """Remember how a trial ended."""
        if outcome.status != "failed" or outcome.change or not trial.files.has_failed():
            return
        stage, step = trial.files.stage_and_step()
        if not outcome.bad_input and step > 0:
            return
        named = setting_in(outcome.message, trial.values)
        group = named.partition(".")[0]
        read = (group,) if outcome.bad_input and group in ALL else READ_BY.get(stage, ALL)
        change = named or f"a setting of {' or '.join(READ_BY.get(stage, PARTS))}"
        repeated = Outcome(trial.folder, "failed", outcome.message, outcome.bad_input, change)
        self._known.append((read, _values(trial, read), repeated))

    def of(self, trial: Trial) -> Outcome | None:
        """The failure that a ``trial`` would repeat, as its own; None if there is none."""
        for read, values, outcome in self._known:
            if _values(trial, read) == values:
                return Outcome(
                    trial.folder, "failed", outcome.message, outcome.bad_input, outcome.change
                )
        return None


def setting_in(message: str, values: dict[str, Any]) -> str:
    """The first setting that a message names; "" if it names none."""
    places = {key: message.find(key) for key in flatten(values) if "." in key}
    found = [key for key, place in places.items() if place >= 0]
    # densify.split and densify.split_size may begin at one place: the longer one is meant
    return min(found, key=lambda key: (places[key], -len(key)), default="")


def _values(trial: Trial, read: Sequence[str]) -> dict[str, Any]:
    """What a trial's configuration says about the groups ``read``."""
    return {
        group: {key: value for key, value in values.items() if key not in NOT_NAMED}
        if isinstance(values := trial.values.get(group), dict)
        else values
        for group in read
    }
