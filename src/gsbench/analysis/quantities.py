"""Quantities of a trial: metrics, counts and costs, with their names, directions and formats.

Tables show counts and times in a unit that suits the trials (`quantity`). Questions compare them in
their own unit (`asked_quantity`).
"""

from collections.abc import Callable, Container, Iterable, Sequence
from dataclasses import dataclass, field
from statistics import fmean

from gsbench.analysis.results import TrialResult, group_by
from gsbench.errors import InputError
from gsbench.eval.facts import LPIPS, find_metric, from_record, in_region, known_keys
from gsbench.eval.protocol import PAPER, protocol_of
from gsbench.runs.experiments import AT
from gsbench.words import signed

MILLION, THOUSAND, MINUTE = 1e6, 1e3, 60.0
# the reason of no verdict
NO_DIRECTION = "unknown whether higher is better: set `direction` in the metric's class"

Reader = Callable[[TrialResult], float | None]


@dataclass(frozen=True)
class Quantity:
    """A number that every trial may have.

    ``direction`` is +1 if more is better, -1 if less is better, 0 if that is not known. A ``cost``
    is never printed in bold: fewer Gaussians or seconds are no aim in themselves. ``worthwhile`` is
    the smallest difference worth resolving, in the quantity's unit.
    """

    key: str
    name: str
    direction: int
    decimals: int
    read: Reader = field(compare=False, repr=False)
    cost: bool = False
    worthwhile: float | None = None

    @property
    def heading(self) -> str:
        return self.name + {1: " ↑", -1: " ↓", 0: ""}[self.direction]

    def format(self, value: float) -> str:
        return f"{value:,.{self.decimals}f}"


def _textured(trial: TrialResult) -> float:
    # here, since only claims about this error read pictures
    from gsbench.analysis.images import textured_error

    return textured_error(trial)


COSTS: dict[str, tuple[str, Reader]] = {  # name, and value in its own unit (one, s or MB)
    "gaussians": ("Gaussians", lambda trial: trial.record.num_gaussians),
    "train_time": ("training time", lambda trial: trial.record.seconds.get("train")),
    "init_points": ("initial points", lambda trial: trial.record.num_init_points),
    "total_time": (
        "total time",
        # compiling is paid once for each processor, not by each trial
        lambda trial: (
            None
            if trial.made_elsewhere
            else sum(value for key, value in trial.record.seconds.items() if key != "compile")
        ),
    ),
    "peak_memory_mb": ("peak memory", lambda trial: trial.record.peak_memory_mb),
}
COUNTS = ("gaussians", "init_points")
# symbol, scale, decimals, and the value of the largest trial from which the unit is used
COUNT_UNITS = (("M", MILLION, 2, MILLION), ("k", THOUSAND, 1, THOUSAND), ("", 1.0, 0, 0.0))
TIME_UNITS = (("min", MINUTE, 1, 10 * MINUTE), ("s", 1.0, 1, 0.0))
# (cost, symbol, scale, decimals) of the names that fix a unit.
FIXED_UNITS = {
    "gaussians_millions": ("gaussians", "M", MILLION, 2),
    "train_minutes": ("train_time", "min", MINUTE, 1),
    "peak_memory_mb": ("peak_memory_mb", "MB", 1.0, 0),
}
ALIASES = {"num_gaussians": "gaussians", "seconds": "train_time", "train": "train_time"}
TEXTURED = Quantity("error_textured", "error in textured parts (levels)", -1, 2, _textured)


@dataclass(frozen=True)
class Change:
    """The relative change of a cost over ``scenes`` scenes: of totals, and mean of ratios."""

    of_totals: float
    of_scenes: float
    scenes: int

    def __str__(self) -> str:
        totals, ratios = signed(self.of_totals, ".1%"), signed(self.of_scenes, ".1%")
        more = f" as a ratio of totals, {ratios} as the mean of {self.scenes} scenes"
        return totals + more * (self.scenes > 1)


def relative_change(
    baseline: Iterable[TrialResult], other: Iterable[TrialResult], read: Reader
) -> Change | None:
    """The change of a cost over scenes where both arms have a value above 0; else None."""
    sides: list[dict[str, float]] = []
    for own in (baseline, other):
        with_value = group_by([trial for trial in own if read(trial)], "scene")
        sides.append(
            {scene: fmean(read(one) or 0.0 for one in same) for scene, same in with_value.items()}
        )
    one, two = sides
    scenes = sorted(one.keys() & two.keys())
    if not scenes:
        return None
    totals = sum(two[scene] for scene in scenes) / sum(one[scene] for scene in scenes)
    return Change(totals - 1, fmean(two[scene] / one[scene] for scene in scenes) - 1, len(scenes))


def choose_quantities(
    trials: Sequence[TrialResult], names: Iterable[str] | None = None
) -> list[Quantity]:
    """The named quantities; by default all metrics, the LPIPS asked for, and the main costs.

    Of metrics in regions, the default has PSNR and the metric of the verdict.
    """
    if names is None:
        wanted = {key for trial in trials for key in _lpips_asked_for(trial)}
        costs = [key for key in ("gaussians", "train_time") if any(map(COSTS[key][1], trials))]
        primary = {str(trial.config.get("eval.primary")).partition(AT)[0] for trial in trials}
        metrics = [
            key
            for key in metric_keys(trials, wanted)
            if AT not in key or key.partition(AT)[0] in primary | {"psnr"}
        ]
        names = [*metrics, *costs]
    return [quantity(name, trials) for name in names]


def quantity(name: str, trials: Sequence[TrialResult]) -> Quantity:
    """The quantity ``name`` (a metric, a cost or an alias) for tables.

    Counts and times have a unit that suits the smallest and the largest trial, unless the name
    fixes the unit (`FIXED_UNITS`). Raises ``InputError`` for an unknown name.
    """
    key = ALIASES.get(name, name)
    metric, _, step = key.rpartition(AT)
    if not step.isdigit():  # psnr, or psnr@far
        metric, step = key, ""
    if metric == "lpips":
        metric = _protocol_lpips(trials[0]) if trials else f"{LPIPS}{PAPER.lpips}"
    # gsbench's or a user's
    if metric in known_keys() or any(metric in trial.metrics for trial in trials):
        return _metric(metric, step, trials)
    if key in FIXED_UNITS:
        return _scaled(key, *FIXED_UNITS[key])
    if key not in COSTS:
        names = [*metric_keys(trials, known_keys()), *COSTS]
        raise InputError(f"unknown metric {name!r}; choose among {', '.join(names)}")
    units = COUNT_UNITS if key in COUNTS else TIME_UNITS
    values = [value for trial in trials if (value := COSTS[key][1](trial))] or [0.0]
    # the smallest value must have two digits, as 0.12 M or 1.0 k
    return next(
        _scaled(key, key, symbol, scale, decimals)
        for symbol, scale, decimals, start in units
        if not start or (max(values) >= start and min(values) >= 10 * scale / 10**decimals)
    )


def asked_quantity(key: str, trials: Sequence[TrialResult] = ()) -> Quantity:
    """The number that a question about ``key`` compares: a metric at the end, or a cost.

    If ``key`` is a user's metric that no trial has, the quantity has default facts.
    """
    if key == TEXTURED.key:
        return TEXTURED
    # a table of results may have a column of the name
    if key in COSTS and not any(key in trial.metrics for trial in trials):
        name, read = COSTS[key]
        return Quantity(key, name, -1, 3, lambda trial: read(trial) or None, cost=True)
    return _metric(key, "", trials)


def askable_names() -> tuple[str, ...]:
    """The names that the ``metric`` of a question may have, without a user's own metrics."""
    return (*known_keys(), TEXTURED.key, *COSTS)


def value_of(asked: Quantity, trial: TrialResult) -> float:
    """The trial's value; raises InputError that says why it is missing."""
    value = asked.read(trial)
    if value is None:
        raise InputError(trial.unavailable.get(asked.key, f"{trial.label} has no {asked.name}"))
    return float(value)


def metric_keys(trials: Iterable[TrialResult], wanted: Container[str] = ()) -> list[str]:
    """The metrics of any trial and those ``wanted``, in order.

    Metrics in regions and a user's own come last.
    """
    present = {key for trial in trials for key in trial.metrics}
    own = sorted(present.difference(known_keys()))
    return [key for key in known_keys() if key in present or key in wanted] + own


def _metric(key: str, step: str, trials: Sequence[TrialResult]) -> Quantity:
    """A metric at the end, or at iteration ``step`` unless it is "".

    Trials record the facts of a user's metric.
    """
    base, _, region = key.partition(AT)
    records = [trial.record.metric_facts.get(base) for trial in trials if key in trial.metrics]
    facts = find_metric(base) or from_record(base, records[0] if records else None)
    facts = in_region(facts, region)
    name = facts.name

    def read(trial: TrialResult) -> float | None:
        earlier = trial.record.metrics_at.get(step) if step else trial
        return None if earlier is None else earlier.metrics.get(key)

    if step:
        measured = sorted({int(at) for trial in trials for at in trial.record.metrics_at})
        if step not in map(str, measured):
            steps = ", ".join(map(str, measured)) or "none"
            raise InputError(
                f"no trial was measured at iteration {step!r}; measured were (eval.at) {steps}"
            )
        name = f"{facts.label} at {int(step):,}"
    return Quantity(
        f"{key}{AT}{step}" if step else key,
        name,
        facts.direction,
        facts.decimals,
        read,
        worthwhile=facts.worthwhile,
    )


def _protocol_lpips(trial: TrialResult) -> str:
    """The key of the LPIPS variant of the trial's protocol."""
    protocol = protocol_of(trial.record.protocol) or PAPER
    return f"{LPIPS}{protocol.lpips or PAPER.lpips}"


def _lpips_asked_for(trial: TrialResult) -> list[str]:
    """The key of the protocol's LPIPS, or those of ``eval.lpips`` if it asks only for others."""
    if trial.made_elsewhere and not trial.config:  # a row of a table
        return []
    by_protocol, setting = _protocol_lpips(trial), trial.config.get("eval.lpips")
    asked = [f"{LPIPS}{variant}" for variant in setting] if isinstance(setting, list) else []
    return asked if asked and by_protocol not in asked else [by_protocol]


def _scaled(key: str, cost: str, symbol: str, scale: float, decimals: int) -> Quantity:
    """A cost in the unit ``symbol``, as tables show it."""
    name, read = COSTS[cost]

    def scaled(trial: TrialResult) -> float | None:
        value = read(trial)
        return None if value is None else value / scale

    shown = {"train_time": "train", "total_time": "total"}.get(cost, name)
    named = f"{shown} ({symbol})" if symbol else shown
    return Quantity(key, named, -1, decimals, scaled, cost=True)
