"""Addresses of trials as people type them: ``demo:courtyard:psnr:momentum[decay=0.9]``.

An arm is typed as `Arm` prints it, with or without its initialiser and its settings.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

from gsbench.analysis.results import Arm, TrialResult, group_by
from gsbench.analysis.trial_result import Trained
from gsbench.errors import InputError
from gsbench.words import split_outside_brackets, value_words

TRIAL = (
    "a trial's folder, or EXPERIMENT:SCENE:ARM[:SEED] such as demo:courtyard:volumetric:0 or "
    "'demo:courtyard:momentum[decay=0.9]'"
)
CELL = (
    "EXPERIMENT:SCENE:METRIC:ARM, such as table1:garden:lpips:volumetric or "
    "'demo:courtyard:psnr:momentum[decay=0.9]'"
)
ARM = re.compile(r"(?P<name>[^\[\]]+)(\[(?P<settings>.*)\])?")


@dataclass(frozen=True)
class ArmName:
    """An arm's name as it was typed, and its settings by their keys, whole or the last part."""

    name: str
    settings: Mapping[str, str]

    @classmethod
    def read(cls, word: str) -> Self:
        """Read ``sfm-momentum[decay=0.9, lr=0.1]``; raises InputError for another form."""
        match = ARM.fullmatch(word)
        entries = [
            one.partition("=")
            for one in split_outside_brackets((match and match["settings"]) or "", ",")
            if one.strip()
        ]
        if match is None or not all(key.strip() and equals for key, equals, _ in entries):
            raise InputError(f"{word!r} is no arm such as adc, sfm-adc or momentum[decay=0.9]")
        return cls(match["name"], {key.strip(): value.strip() for key, _, value in entries})

    def names(self, arm: Arm) -> bool:
        """Return whether initialiser (if given) and densifier are those of ``arm``."""
        return self.name in (f"{arm.init}-{arm.densify}", arm.densify)

    def fits(self, trial: Trained) -> bool:
        """Return whether a trial has the name and the settings."""
        if not self.names(trial.arm):
            return False
        own = dict(trial.config) | dict(trial.variant) if self.settings else {}
        return all(
            any(_same(value, own[known]) for known in own if f".{known}".endswith(f".{key}"))
            for key, value in self.settings.items()
        )


def _same(typed: str, value: Any) -> bool:
    """Return whether a typed value is that of a setting; numbers may be written in other ways."""
    text = str(value)
    try:
        return typed in (text, value_words(text)) or float(typed) == float(text)
    except ValueError:
        return typed.lower() == text.lower() or (typed, text) == ("null", "None")


def fitting(trials: Sequence[TrialResult], words: Sequence[str]) -> dict[Arm, list[TrialResult]]:
    """The trials that one of ``words`` names, by arm; ``trials`` have their variants."""
    names = [ArmName.read(word) for word in words]
    return group_by((one for one in trials if any(name.fits(one) for name in names)), "arm")


def trials_of_arm(trials: Sequence[TrialResult], word: str, where: str = "") -> list[TrialResult]:
    """The trials of the one arm that ``word`` names; ``trials`` have their variants.

    Raises InputError, which lists the arms, unless it names one. ``where`` is what has the trials.
    """
    found = fitting(trials, [word])
    if len(found) != 1:
        arms = sorted(found or {trial.arm for trial in trials})
        raise InputError(
            f"{word!r} names {len(found)} arms{where}; choose one of {', '.join(map(str, arms))}"
        )
    return next(iter(found.values()))
