"""What is known of every metric before it is computed, as one table that everything asks. Loads no torch.

A metric of your own needs no entry here: ``eval.extra.NAME._target_=mine.MyMetric`` (docs/metric.md).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from gsbench.errors import InputError

LPIPS = "lpips_"  # how the keys of LPIPS start; what follows names the variant, as in ``eval.lpips``
DECIMALS = 3  # of a metric that does not say


@dataclass(frozen=True)
class MetricFacts:
    """A metric as tables, verdicts and reports need it."""

    key: str  # in results, per-view files and ``--metrics``
    label: str  # in tables
    direction: int  # +1: more is better; -1: less is better; 0: not known, and it gets no verdict
    decimals: int  # in tables
    unit: str = ""
    worthwhile: float | None = None  # the smallest difference worth resolving; about what papers claim as improvements
    perceptual: bool = False  # meant to follow what people see
    setting: str = ""  # the setting that asks for it; empty: it is always computed
    target: str = field(default="", repr=False)  # import path of what computes it
    options: Mapping[str, Any] = field(default_factory=dict, repr=False)  # of that class

    @property
    def name(self) -> str:
        """The label with its unit."""
        return f"{self.label} ({self.unit})" if self.unit else self.label


def _lpips(variant: str, label: str, net: str, raw: bool = False) -> MetricFacts:
    """LPIPS by the network ``net``, fed [-1, 1] as it is defined; ``raw``: fed [0, 1], as the evaluation of 3DGS is."""
    options = {"net": net, "raw": raw}
    target = "gsbench.eval.measures.LpipsMetric"
    return MetricFacts(
        f"{LPIPS}{variant}", label, -1, 3, "", 0.005, True, setting="eval.lpips", target=target, options=options
    )


METRICS = (
    MetricFacts("psnr", "PSNR", 1, 2, "dB", 0.1, target="gsbench.eval.measures.Psnr"),
    MetricFacts("ssim", "SSIM", 1, 3, "", 0.005, target="gsbench.eval.measures.Ssim"),
    _lpips("vgg_raw", "LPIPS VGG raw", "vgg", raw=True),
    _lpips("vgg", "LPIPS VGG", "vgg"),
    _lpips("alex", "LPIPS Alex", "alex"),
    _lpips("squeeze", "LPIPS Squeeze", "squeeze"),
    MetricFacts("flip", "FLIP", -1, 3, "", 0.005, True, setting="eval.flip", target="gsbench.eval.measures.Flip"),
)


def known_keys() -> tuple[str, ...]:
    """The keys of gsbench's own metrics, in the order of tables."""
    return tuple(facts.key for facts in METRICS)


def lpips_variants() -> tuple[str, ...]:
    """What ``eval.lpips`` may list."""
    return tuple(facts.key.removeprefix(LPIPS) for facts in METRICS if facts.key.startswith(LPIPS))


def find(key: str) -> MetricFacts | None:
    """The facts of gsbench's own metric ``key``, or None."""
    return next((facts for facts in METRICS if facts.key == key), None)


def facts_of(key: str, metric: object) -> MetricFacts:
    """The facts of a user's metric, from the attributes of its class; raises InputError for one that cannot be used."""
    label, unit = getattr(metric, "label", key), getattr(metric, "unit", "")
    direction, decimals = getattr(metric, "direction", 0), getattr(metric, "decimals", DECIMALS)
    worthwhile = getattr(metric, "worthwhile", None)
    rules = [
        ("direction", direction in (-1, 0, 1), "1 (more is better), -1 (less is better) or 0", direction),
        ("decimals", _is_count(decimals), "a whole number from 0 to 12", decimals),
        ("label", isinstance(label, str) and bool(label.strip()), "a text", label),
        ("unit", isinstance(unit, str), "a text", unit),
        ("worthwhile", worthwhile is None or _is_positive(worthwhile), "a number above 0", worthwhile),
    ]
    for name, holds, rule, value in rules:
        if not holds:
            raise InputError(f"{type(metric).__qualname__}.{name} must be {rule}, got {value!r}")
    return MetricFacts(key, label, direction, decimals, unit, worthwhile)


def to_record(facts: MetricFacts) -> dict[str, Any]:
    """What results keep of a user's metric, so that tables need not import its class."""
    kept = ("label", "direction", "decimals", "unit", "worthwhile")
    return {name: value for name, value in asdict(facts).items() if name in kept}


def from_record(key: str, record: object) -> MetricFacts:
    """The facts of a user's metric from its results; without a record, its key is all that is known."""
    if not isinstance(record, Mapping):
        return MetricFacts(key, key, 0, DECIMALS)
    return MetricFacts(
        key,
        str(record.get("label", key)),
        int(record.get("direction", 0)),
        int(record.get("decimals", DECIMALS)),
        str(record.get("unit", "")),
        record.get("worthwhile"),
    )


def _is_count(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value <= 12


def _is_positive(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value) and value > 0
