"""Conditions of this machine for a claim's trials: captures and weights that are missing."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

from gsbench.config.compose import Trial
from gsbench.errors import InputError
from gsbench.eval.facts import LPIPS


class Here:
    """Answers for one command.

    ``folders`` names the folders that trials ask for and that are not here. Without ``download``, weights that would
    have to be fetched count as missing.
    """

    def __init__(self, folders: Callable[[Sequence[Trial]], Sequence[str]], download: bool) -> None:
        self._folders, self._download = folders, download
        self._init = cache(self._missing_weights)
        self._metrics = cache(self._missing_metrics)

    def __call__(self, trial: Trial, metric: str) -> str:
        """Return why the trial cannot be run here or lacks the metric, in one line; "" where nothing is missing."""
        if missing := self._folders([trial]):
            return missing[0]
        values = trial.values
        if reason := self._init(_frozen(values["init"]), tuple(values["allow_targets"])):
            return reason
        if metric.startswith(LPIPS):
            return self._metrics(_frozen(values["eval"])).get(metric, "")
        return ""

    def _missing_weights(self, init: str, allowed: tuple[str, ...]) -> str:
        values = _thawed(init)
        if "weights" not in values:  # a class without networks
            return ""
        from gsbench.pipeline.components import build

        made = build("init", values, list(allowed))
        if not hasattr(made, "find_weights"):
            return ""
        try:
            dataclasses.replace(made, download=made.download and self._download).find_weights()
        except InputError as error:
            return str(error)
        return ""

    def _missing_metrics(self, options: str) -> dict[str, str]:
        from gsbench.eval.options import EvalConfig
        from gsbench.pipeline.components import make_evaluator

        values = _thawed(options)
        settings = EvalConfig(**(values | {"download": values["download"] and self._download}))
        return dict(make_evaluator(settings).unavailable)


def _frozen(values: dict[str, Any]) -> str:
    return json.dumps(values, sort_keys=True)


def _thawed(text: str) -> dict[str, Any]:
    values: dict[str, Any] = json.loads(text)
    return values
