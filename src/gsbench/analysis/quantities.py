"""What a table can show of a trial: metrics, counts and costs, with their names, directions and formats."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from gsbench.analysis.results import Trial
from gsbench.errors import InputError

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
    read: Callable[[Trial], float | None]
    cost: bool = False

    @property
    def heading(self) -> str:
        return self.name + {1: " ↑", -1: " ↓", 0: ""}[self.direction]

    def format(self, value: float) -> str:
        return f"{value:.{self.decimals}f}"


METRICS: dict[str, tuple[str, int, int]] = {  # key -> name, direction, decimals
    "psnr": ("PSNR (dB)", 1, 2),
    "ssim": ("SSIM", 1, 3),
    "lpips_vgg_raw": ("LPIPS VGG raw", -1, 3),
    "lpips_vgg": ("LPIPS VGG", -1, 3),
    "lpips_alex": ("LPIPS Alex", -1, 3),
    "lpips_squeeze": ("LPIPS Squeeze", -1, 3),
    "flip": ("FLIP", -1, 3),
}
COSTS = ("gaussians", "train_time", "init_points", "total_time", "peak_memory_mb")
ALIASES = {"num_gaussians": "gaussians", "seconds": "train_time", "train": "train_time"}
PAPER_LPIPS = "lpips_vgg_raw"
PROTOCOL_LPIPS = {"paper": PAPER_LPIPS, "standard": "lpips_vgg"}  # what a protocol means by LPIPS


def choose_quantities(trials: Iterable[Trial], names: Iterable[str] | None = None) -> list[Quantity]:
    """The quantities by name; by default all metrics that some trial has, the protocol's LPIPS, and the main costs."""
    trials = list(trials)
    if names is None:
        protocols = {_protocol(trial) for trial in trials}
        wanted = {PROTOCOL_LPIPS.get(protocol) for protocol in protocols}
        present = {key for trial in trials for key in trial.metrics}
        names = [key for key in METRICS if key in present or key in wanted]
        names += [*sorted(present - METRICS.keys()), "gaussians", "train_time"]
    return [quantity(name, trials) for name in names]


def quantity(name: str, trials: Iterable[Trial]) -> Quantity:
    """The quantity ``name`` (a metric, a cost or an alias); raises ``InputError``.

    Counts and times come in a unit that suits the trials, those named by their unit always in that one.
    """
    trials = list(trials)
    key = ALIASES.get(name, name)
    if key == "lpips":
        key = PROTOCOL_LPIPS.get(_protocol(trials[0]) if trials else "", PAPER_LPIPS)
    if key in METRICS:
        label, direction, decimals = METRICS[key]
        return Quantity(key, label, direction, decimals, lambda trial: trial.metrics.get(key))
    if key == "gaussians":
        return _count(key, "Gaussians", "num_gaussians", trials)
    if key == "gaussians_millions":
        return _count(key, "Gaussians", "num_gaussians", trials, unit=("M", MILLION, 2))
    if key == "train_minutes":
        return _time(key, "train", lambda trial: trial.data["seconds"].get("train"), trials, unit=("min", MINUTE))
    if key == "init_points":
        return _count(key, "initial points", "num_init_points", trials)
    if key == "train_time":
        return _time(key, "train", lambda trial: trial.data["seconds"].get("train"), trials)
    if key == "total_time":
        return _time(key, "total", lambda trial: sum(trial.data["seconds"].values()), trials)
    if key == "peak_memory_mb":
        return Quantity(key, "peak memory (MB)", -1, 0, lambda trial: trial.data.get(key), cost=True)
    if any(name in trial.metrics for trial in trials):  # a metric of the user's own
        return Quantity(name, name, 0, 3, lambda trial: trial.metrics.get(name))
    raise InputError(f"unknown metric {name!r}; choose among {', '.join([*METRICS, *COSTS])}")


def _protocol(trial: Trial) -> str:
    """The protocol's name without its version."""
    return str(trial.data["protocol"]).rsplit("-", 1)[0]


def _count(
    key: str, name: str, field: str, trials: list[Trial], unit: tuple[str, float, int] | None = None
) -> Quantity:
    largest = max((trial.data.get(field) or 0 for trial in trials), default=0)
    symbol, scale, decimals = unit or (("M", MILLION, 2) if largest >= MILLION else ("k", THOUSAND, 1))

    def read(trial: Trial) -> float | None:
        value = trial.data.get(field)
        return None if value is None else value / scale

    return Quantity(key, f"{name} ({symbol})", -1, decimals, read, cost=True)


def _time(
    key: str,
    name: str,
    seconds: Callable[[Trial], float | None],
    trials: list[Trial],
    unit: tuple[str, float] | None = None,
) -> Quantity:
    longest = max((seconds(trial) or 0.0 for trial in trials), default=0.0)
    symbol, scale = unit or (("min", MINUTE) if longest >= 10 * MINUTE else ("s", 1.0))

    def read(trial: Trial) -> float | None:
        value = seconds(trial)
        return None if value is None else value / scale

    return Quantity(key, f"{name} ({symbol})", -1, 1, read, cost=True)
