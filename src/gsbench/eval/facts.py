"""Facts about metrics, such as labels, units and directions; gsbench's own are in metrics.yaml.

Loads no torch.

A metric of your own needs no entry here: ``eval.extra.NAME._target_=mine.MyMetric``
(docs/metric.md).
"""

from dataclasses import asdict, dataclass, fields, replace
from typing import Annotated, Literal

from annotated_types import Interval, Predicate
from pydantic import PositiveFloat, StrictStr

from gsbench.parsing import table_beside
from gsbench.runs.experiments import AT
from gsbench.runs.trial_record import MetricRecord
from gsbench.settings import check_values

MORE = "eval.more"  # the setting that lists metrics which are computed only on request
LPIPS = "lpips_"  # prefix of the keys of LPIPS; the rest is the variant, as in ``eval.lpips``


@dataclass(frozen=True)
class MetricFacts:
    """The facts about a metric that tables, verdicts and reports need."""

    key: str  # in results, per-view files and ``--metrics``
    label: Annotated[StrictStr, Predicate(lambda text: bool(text.strip()))]  # in tables
    # 1: more is better; -1: less is better; 0: not known, so there is no verdict
    direction: Literal[-1, 0, 1] = 0
    decimals: Annotated[int, Interval(ge=0, le=12)] = 3  # in tables
    unit: StrictStr = ""
    # the smallest difference worth resolving, about what papers claim as improvements
    worthwhile: PositiveFloat | None = None
    setting: str = ""  # the setting that requests it; empty: it is always computed
    lowest: float | None = None  # lower bound of its values; None: none or unknown
    highest: float | None = None  # upper bound
    words: str = ""  # what it measures

    @property
    def name(self) -> str:
        """The label with its unit."""
        return f"{self.label} ({self.unit})" if self.unit else self.label


METRICS = [MetricFacts(**row) for row in table_beside(__file__, "metrics.yaml")]


def known_keys() -> tuple[str, ...]:
    """The keys of gsbench's own metrics, in the order of tables."""
    return tuple(facts.key for facts in METRICS)


def lpips_variants() -> tuple[str, ...]:
    """The values allowed in ``eval.lpips``."""
    return tuple(
        facts.key.removeprefix(LPIPS) for facts in METRICS if facts.setting == "eval.lpips"
    )


def further_keys() -> tuple[str, ...]:
    """The values allowed in ``eval.more``."""
    return tuple(facts.key for facts in METRICS if facts.setting == MORE)


def find_metric(key: str) -> MetricFacts | None:
    """The facts about gsbench's metric ``key``, such as ``psnr`` or ``psnr@far``, or None."""
    metric, _, region = key.partition(AT)
    facts = next((facts for facts in METRICS if facts.key == metric), None)
    return None if facts is None else in_region(facts, region)


def in_region(facts: MetricFacts, region: str) -> MetricFacts:
    """The facts about a metric that is measured in one ``region`` of each view, or in all if ""."""
    if not region:
        return facts
    return replace(facts, key=f"{facts.key}{AT}{region}", label=f"{facts.label} {region}")


def facts_of(key: str, metric: object) -> MetricFacts:
    """The facts about a user's metric, from the attributes of its class.

    Raises InputError for a wrong attribute.
    """
    given = {
        field.name: getattr(metric, field.name)
        for field in fields(MetricRecord)
        if hasattr(metric, field.name)
    }
    return MetricFacts(
        key, **({"label": key} | check_values(MetricFacts, given, type(metric).__qualname__))
    )


def to_record(facts: MetricFacts) -> MetricRecord:
    """The facts about a user's metric for its results, so that tables need not import its class."""
    return MetricRecord(
        **{field.name: getattr(facts, field.name) for field in fields(MetricRecord)}
    )


def from_record(key: str, record: MetricRecord | None) -> MetricFacts:
    """The facts about a user's metric from its results; without a record, only its key is known."""
    return MetricFacts(key, label=key) if record is None else MetricFacts(key, **asdict(record))
