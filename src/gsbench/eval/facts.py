"""One table of facts about gsbench's metrics, such as labels, units and directions. Loads no torch.

A metric of your own needs no entry here: ``eval.extra.NAME._target_=mine.MyMetric`` (docs/metric.md).
"""

import math
from dataclasses import dataclass, fields

from gsbench.errors import InputError
from gsbench.runs.trial_record import MetricRecord

MORE = "eval.more"  # the setting that lists metrics which are computed only on request
LPIPS = "lpips_"  # prefix of the keys of LPIPS; the rest is the variant, as in ``eval.lpips``
DECIMALS = 3  # default of a user's metric


@dataclass(frozen=True)
class MetricFacts:
    """The facts about a metric that tables, verdicts and reports need."""

    key: str  # in results, per-view files and ``--metrics``
    label: str  # in tables
    direction: int  # +1: more is better; -1: less is better; 0: not known, so there is no verdict
    decimals: int  # in tables
    unit: str = ""
    worthwhile: float | None = None  # the smallest difference worth resolving, about what papers claim as improvements
    perceptual: bool = False  # meant to agree with human vision
    setting: str = ""  # the setting that requests it; empty: it is always computed
    lowest: float | None = None  # lower bound of its values; None: none or unknown
    highest: float | None = None  # upper bound
    words: str = ""  # what it measures

    @property
    def name(self) -> str:
        """The label with its unit."""
        return f"{self.label} ({self.unit})" if self.unit else self.label


def _lpips(variant: str, label: str, words: str) -> MetricFacts:
    return MetricFacts(f"{LPIPS}{variant}", label, -1, 3, "", 0.005, True, "eval.lpips", 0.0, words=words)


def _structural(key: str, label: str, direction: int, highest: float, words: str) -> MetricFacts:
    """A metric of structure without weights, computed if ``eval.more`` names it."""
    return MetricFacts(key, label, direction, 4, "", 0.002, True, MORE, 0.0, highest, words)


METRICS = (  # `gsbench.eval.evaluator.MEASURES` has the class of each
    MetricFacts("psnr", "PSNR", 1, 2, "dB", 0.1, lowest=0.0, words="mean squared error, logarithmic"),
    MetricFacts(
        "ssim", "SSIM", 1, 3, "", 0.005, False, "", -1.0, 1.0, "means, contrast and structure in windows of 11 px"
    ),
    _lpips("vgg_raw", "LPIPS VGG raw", "distance of what vgg sees, fed [0, 1]"),
    _lpips("vgg", "LPIPS VGG", "distance of what vgg sees"),
    _lpips("alex", "LPIPS Alex", "distance of what alex sees"),
    _lpips("squeeze", "LPIPS Squeeze", "distance of what squeeze sees"),
    MetricFacts(
        "flip", "FLIP", -1, 3, "", 0.005, True, "eval.flip", 0.0, 1.0, "difference one sees when two images alternate"
    ),
    _structural("ms_ssim", "MS-SSIM", 1, 1.0, "SSIM's structure at five scales"),
    _structural("iw_ssim", "IW-SSIM", 1, 1.0, "the same, weighted by the information that a place carries"),
    _structural("fsim", "FSIMc", 1, 1.0, "edges and lines: phase congruency, contrast and colour there"),
    _structural("gmsd", "GMSD", -1, 0.5, "how unevenly the gradients agree"),
)
# A fact about the trained model instead of its pictures, measured separately in the evaluation.
FPS = MetricFacts(
    "fps", "speed", 1, 2, "frames/s", None, False, "eval.fps", 0.0, words="renders of the test views at one size"
)
ALL = (*METRICS, FPS)  # in the order of tables


def known_keys() -> tuple[str, ...]:
    """The keys of gsbench's own metrics, in the order of tables."""
    return tuple(facts.key for facts in ALL)


def lpips_variants() -> tuple[str, ...]:
    """The values allowed in ``eval.lpips``."""
    return tuple(facts.key.removeprefix(LPIPS) for facts in METRICS if facts.key.startswith(LPIPS))


def further_keys() -> tuple[str, ...]:
    """The values allowed in ``eval.more``."""
    return tuple(facts.key for facts in METRICS if facts.setting == MORE)


def find_metric(key: str) -> MetricFacts | None:
    """The facts about gsbench's metric ``key``, or None."""
    return next((facts for facts in ALL if facts.key == key), None)


def facts_of(key: str, metric: object) -> MetricFacts:
    """The facts about a user's metric, from the attributes of its class; raises InputError for a wrong attribute."""
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


def to_record(facts: MetricFacts) -> MetricRecord:
    """The facts about a user's metric for its results, so that tables need not import its class."""
    return MetricRecord(**{entry.name: getattr(facts, entry.name) for entry in fields(MetricRecord)})


def from_record(key: str, record: MetricRecord | None) -> MetricFacts:
    """The facts about a user's metric from its results; without a record, only its key is known."""
    if record is None:
        return MetricFacts(key, key, 0, DECIMALS)
    return MetricFacts(key, record.label, record.direction, record.decimals, record.unit, record.worthwhile)


def _is_count(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value <= 12


def _is_positive(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value) and value > 0
