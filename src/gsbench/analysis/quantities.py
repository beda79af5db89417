"""Quantities that a table can show of a trial: metrics, counts and costs, with their names, directions and formats."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Sequence
from dataclasses import dataclass
from functools import partial

from gsbench.analysis.results import TrialResult
from gsbench.errors import InputError
from gsbench.eval.facts import LPIPS, find, from_record, known_keys
from gsbench.eval.protocol import PAPER, protocol_of

MILLION, THOUSAND, MINUTE = 1e6, 1e3, 60.0


@dataclass(frozen=True)
class Quantity:
    """One number of a trial.

    ``direction`` is +1 where more is better, -1 where less is and 0 where that is not known; a ``cost`` is never set in
    bold, since fewer Gaussians or seconds are no aim in themselves.
    """

    key: str
    name: str
    direction: int
    decimals: int
    read: Callable[[TrialResult], float | None]
    cost: bool = False
    worthwhile: float | None = None  # the smallest difference worth resolving

    @property
    def heading(self) -> str:
        return self.name + {1: " ↑", -1: " ↓", 0: ""}[self.direction]

    def format(self, value: float) -> str:
        return f"{value:.{self.decimals}f}"


COSTS = ("gaussians", "train_time", "init_points", "total_time", "peak_memory_mb")
ALIASES = {"num_gaussians": "gaussians", "seconds": "train_time", "train": "train_time"}
AT = "@"  # psnr@7000 is the PSNR at iteration 7000 (eval.at)


def choose_quantities(trials: Iterable[TrialResult], names: Iterable[str] | None = None) -> list[Quantity]:
    """The quantities by name; by default all metrics that some trial has, LPIPS as it was asked for, and main costs."""
    trials = list(trials)
    if names is None:
        wanted = {key for trial in trials for key in _lpips_asked_for(trial)}
        names = [*metric_keys(trials, wanted), "gaussians", "train_time"]
    return [quantity(name, trials) for name in names]


def quantity(name: str, trials: Iterable[TrialResult]) -> Quantity:
    """The quantity ``name`` (a metric, a cost or an alias); raises ``InputError``.

    Counts and times come in a unit that suits the trials, those named by their unit always in that one.
    """
    trials = list(trials)
    key = ALIASES.get(name, name)
    metric, _, step = key.partition(AT)
    if metric == "lpips":
        metric = _protocol_lpips(trials[0]) if trials else f"{LPIPS}{PAPER.lpips}"
    if find(metric) is not None:
        return _metric(metric, step, trials)
    if key == "gaussians":
        return _count(key, "Gaussians", "num_gaussians", trials)
    if key == "gaussians_millions":
        return _count(key, "Gaussians", "num_gaussians", trials, unit=("M", MILLION, 2))
    if key == "train_minutes":
        return _time(key, "train", lambda trial: trial.record.seconds.get("train"), trials, unit=("min", MINUTE))
    if key == "init_points":
        return _count(key, "initial points", "num_init_points", trials)
    if key == "train_time":
        return _time(key, "train", lambda trial: trial.record.seconds.get("train"), trials)
    if key == "total_time":
        return _time(key, "total", _total_seconds, trials)
    if key == "peak_memory_mb":
        return Quantity(key, "peak memory (MB)", -1, 0, lambda trial: trial.record.peak_memory_mb, cost=True)
    if any(metric in trial.metrics for trial in trials):  # a user's own
        return _metric(metric, step, trials)
    raise InputError(f"unknown metric {name!r}; choose among {', '.join([*metric_keys(trials, known_keys()), *COSTS])}")


def metric_quantity(key: str, trials: Iterable[TrialResult]) -> Quantity:
    """The metric ``key`` at the end of trials; of a user's own that no trial has, nothing but the key is known."""
    return _metric(key, "", list(trials))


def metric_keys(trials: Iterable[TrialResult], wanted: Container[str] = ()) -> list[str]:
    """The metrics that some trial has or that are ``wanted``, in the order of tables; a user's own come last."""
    present = {key for trial in trials for key in trial.metrics}
    own = sorted(key for key in present if find(key) is None)
    return [key for key in known_keys() if key in present or key in wanted] + own


def _metric(key: str, step: str, trials: Sequence[TrialResult]) -> Quantity:
    """A metric at the end, or after the iteration ``step`` (text); a user's own is described by the trials' files."""
    records = [trial.record.metric_facts.get(key) for trial in trials if key in trial.metrics]
    facts = find(key) or from_record(key, records[0] if records else None)
    name, read = facts.name, partial(_final_value, key)
    if step:
        known = sorted({int(at) for trial in trials for at in trial.record.metrics_at})
        if step not in map(str, known):
            there = ", ".join(map(str, known)) or "none"
            raise InputError(f"no trial was measured at iteration {step!r}; measured were (eval.at) {there}")
        name, read = f"{facts.label} at {int(step):,}", partial(_value_at, key, step)
    return Quantity(
        f"{key}{AT}{step}" if step else key, name, facts.direction, facts.decimals, read, worthwhile=facts.worthwhile
    )


def _final_value(key: str, trial: TrialResult) -> float | None:
    return trial.metrics.get(key)


def _value_at(key: str, step: str, trial: TrialResult) -> float | None:
    earlier = trial.record.metrics_at.get(step)
    return None if earlier is None else earlier.metrics.get(key)


def _protocol_lpips(trial: TrialResult) -> str:
    """Key of the metric that the trial's protocol means by LPIPS."""
    protocol = protocol_of(trial.record.protocol) or PAPER
    return f"{LPIPS}{protocol.lpips or PAPER.lpips}"


def _lpips_asked_for(trial: TrialResult) -> list[str]:
    """Key of what the trial's protocol means by LPIPS, or keys where its configuration asks for others alone."""
    protocols, setting = _protocol_lpips(trial), trial.config.get("eval.lpips")
    asked = [f"{LPIPS}{variant}" for variant in setting] if isinstance(setting, list) else []
    return asked if asked and protocols not in asked else [protocols]


def _total_seconds(trial: TrialResult) -> float | None:
    return None if trial.made_elsewhere else sum(trial.record.seconds.values())


def _count(
    key: str, name: str, field: str, trials: list[TrialResult], unit: tuple[str, float, int] | None = None
) -> Quantity:
    largest = max((getattr(trial.record, field) or 0 for trial in trials), default=0)
    symbol, scale, decimals = unit or (("M", MILLION, 2) if largest >= MILLION else ("k", THOUSAND, 1))

    def read(trial: TrialResult) -> float | None:
        value = getattr(trial.record, field)
        return None if value is None else value / scale

    return Quantity(key, f"{name} ({symbol})", -1, decimals, read, cost=True)


def _time(
    key: str,
    name: str,
    seconds: Callable[[TrialResult], float | None],
    trials: list[TrialResult],
    unit: tuple[str, float] | None = None,
) -> Quantity:
    longest = max((seconds(trial) or 0.0 for trial in trials), default=0.0)
    symbol, scale = unit or (("min", MINUTE) if longest >= 10 * MINUTE else ("s", 1.0))

    def read(trial: TrialResult) -> float | None:
        value = seconds(trial)
        return None if value is None else value / scale

    return Quantity(key, f"{name} ({symbol})", -1, 1, read, cost=True)
