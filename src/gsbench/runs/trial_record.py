"""Content of a trial's files: of ``results.json``, of the records that its stages leave in the store beside their
files (``training.json``, ``metrics.json``), and of the JSON lines of a training. Writers fill these, readers get them.
"""

import logging
import reprlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from pydantic import AfterValidator, Field, ValidationError

from gsbench.parsing import DamagedError, fault_of, read_bytes
from gsbench.records import (
    MAX_NUMBER,
    Amount,
    Count,
    Number,
    Record,
    Text,
    Whole,
    adapter,
    iterate_rows,
    misfit,
    read_typed,
)
from gsbench.runs.layout import METRICS, TRAINING

log = logging.getLogger(__name__)

# ``evaluated_from`` of what gsbench did not train itself: the model was rendered here, or only renders are known.
FROM_MODEL: Final = "model"
FROM_RENDERS: Final = "renders"
MADE_ELSEWHERE = "made by another program"  # how the reason of a quantity starts that nobody can know of such a trial
RENDERS_ALONE = f"{MADE_ELSEWHERE}; only the renders are known"

BY_LISTS = "list"  # of `split_text`

Iteration = Annotated[str, Field(pattern=r"^\d{1,18}$")]  # as the key of an object


@dataclass(frozen=True, kw_only=True)
class Budget(Record):
    """Limits on the growth of a trial: a cap on Gaussians, the rule that keeps it, a limit of time in s."""

    max_gaussians: Count | None = None
    cap: str | None = None
    seconds: Amount | None = None


@dataclass(frozen=True, kw_only=True)
class Code(Record):
    """The versions of the code: sha256 of the a user's modules, versions of gsbench's stages.

    ``rooms`` are those of gsbench that had a part, with their states (`gsbench.runs.code`); ``commit`` is that of the
    checkout that trained, ``edited`` says whether files that git follows had changed.
    """

    sources: dict[str, str] = field(default_factory=dict)
    stages: dict[str, int] = field(default_factory=dict)
    rooms: dict[str, str] = field(default_factory=dict)
    commit: str | None = None
    edited: bool | None = None  # None: without a checkout, or not to be told


@dataclass(frozen=True, kw_only=True)
class MetricRecord(Record):
    """Facts of a user's own metric; see `gsbench.eval.facts`."""

    label: str
    direction: Literal[-1, 0, 1] = 0
    decimals: Annotated[int, Field(ge=0, le=12)] = 3
    unit: str = ""
    worthwhile: Annotated[float, Field(gt=0, le=MAX_NUMBER)] | None = None


@dataclass(frozen=True, kw_only=True)
class Earlier(Record):
    """Metrics at an earlier iteration."""

    metrics: dict[str, Number]
    num_gaussians: Count | None = None


@dataclass(frozen=True, kw_only=True)
class Declared(Record):
    """The metric that the verdict was declared to be about, and when (`gsbench.runs.declaration`)."""

    metric: str
    time: str


@dataclass(frozen=True, kw_only=True)
class Trainer(Record):
    """The program that trained in gsbench's place: as it is called, its version, what it says of it, the command."""

    program: str
    version: str
    said: str | None = None
    command: list[str] = field(default_factory=list)


@dataclass(frozen=True, kw_only=True)
class TrialRecord(Record):
    """A finished trial. What nobody can know of it is None, or absent from the file where that is the default.

    ``metrics`` are means over the test views, ``unavailable`` says why others are missing and ``awaited`` names those
    of them that may still come; ``seconds`` are by stage, ``resolution`` is (width, height) in px.
    """

    status: Literal["complete"]
    experiment: Text
    scene: Text
    init: Text
    densify: Text
    seed: Count
    raster: Text
    protocol: Text
    iterations: Count
    metrics: dict[str, Number]
    unavailable: dict[str, str]
    seconds: dict[str, Amount]
    num_init_points: Count | None
    num_gaussians: Count | None
    peak_memory_mb: Amount | None
    hashes: dict[str, str]
    versions: dict[str, str]
    evaluated_from: Literal["model", "renders"] | None = None  # what gsbench did not train itself
    trained_by: Trainer | None = None
    measured: str | None = None  # when the evaluation came into the store
    declared: Declared | None = None
    awaited: list[str] = field(default_factory=list)
    metric_facts: dict[str, MetricRecord] = field(default_factory=dict)
    metrics_at: dict[Iteration, Earlier] = field(default_factory=dict)
    causes: dict[str, Count] = field(default_factory=dict)  # of the Gaussians that live at the end
    scene_extent: Amount | None = None  # world units
    budget: Budget | None = None
    train_views: Count | None = None
    test_views: Count | None = None
    split: str = ""  # the views that are held out, as short text (`split_text`)
    held_out: str = ""  # the same in a sentence
    resolution: tuple[Count, Count] | None = None
    events: dict[str, Count] = field(default_factory=dict)  # totals of the refinements, by cause
    init_report: dict[str, Any] = field(default_factory=dict)
    renders: dict[str, str] = field(default_factory=dict)  # where the renders of another program came from
    code: Code = field(default_factory=Code)
    machine: dict[str, str] | None = None

    def __post_init__(self) -> None:
        if self.num_gaussians is None and self.evaluated_from != FROM_RENDERS:
            raise ValueError("num_gaussians is not there")
        if fault := fault_of(self.init_report):
            raise ValueError(f"in init_report {fault}")


class UnfinishedError(DamagedError):
    """A ``results.json`` that does not say that its trial is complete."""


def record_from(content: bytes, path: Path) -> TrialRecord:
    """The record that the JSON of the file ``path`` is; raises DamagedError, and UnfinishedError."""
    try:
        return adapter(TrialRecord).validate_json(content)
    except ValidationError as error:
        of_status = next((fault for fault in error.errors() if fault["loc"] == ("status",)), None)
        if of_status is not None:
            said = "missing" if of_status["type"] == "missing" else reprlib.repr(of_status["input"])
            raise UnfinishedError(path, f"is unfinished, its status is {said}") from None
        raise DamagedError(path, misfit(error)) from None


@dataclass(frozen=True, kw_only=True)
class Training(Record):
    """Record of what a training took and gave; of another program's, ``trained_by`` and ``evaluated_from`` are set."""

    iterations: Count
    num_init_points: Count
    num_gaussians: Count | None
    causes: dict[str, Count]
    scene_extent: Amount
    seconds: Amount
    peak_memory_mb: Amount | None
    machine: dict[str, str]
    checkout: dict[str, Any] = field(default_factory=dict)  # the commit of gsbench's own, and whether it was edited
    evaluated_from: Literal["model", "renders"] | None = None
    trained_by: Trainer | None = None


@dataclass(frozen=True, kw_only=True)
class Evaluation(Record):
    """The means of the metrics, why others are missing, and which of those may still come."""

    metrics: dict[str, Number]
    unavailable: dict[str, str]
    awaited: list[str]
    facts: dict[str, MetricRecord] = field(default_factory=dict)  # of a user's own metrics
    at: dict[Iteration, Earlier] = field(default_factory=dict)  # by earlier iterations


def read_training(folder: Path) -> Training:
    """The record of the training in ``folder``; raises FileNotFoundError and DamagedError."""
    return read_typed(folder / TRAINING, Training)


def read_evaluation(folder: Path) -> Evaluation:
    """The record of the evaluation in ``folder``; raises as `read_training` does."""
    return read_typed(folder / METRICS, Evaluation)


def split_text(config: Mapping[str, Any]) -> str:
    """``every_nth``, ``sector 0 of 8`` or ``list``, and whether it is matched, or for validation."""
    text, sectors = str(config.get("scene.split")), config.get("scene.sectors")
    if text == "sector":
        text = f"sector {config.get('scene.sector')} of {sectors}"
    if config.get("scene.train_list") or config.get("scene.test_list"):
        text = BY_LISTS
    elif config.get("scene.match_views"):
        text += ", matched" if text.startswith("sector") else f", matched with {sectors}"
    return f"{text}, validation" if config.get("scene.validation") else text


# ---- the JSON lines of a training

STEP = "step"  # the key of every row: the iteration
Exponent = Annotated[float, Field(ge=-300, le=300)]  # ten to this power is a number


def _with_step(row: dict[str, bool | int | float]) -> dict[str, bool | int | float]:
    step = row.get(STEP)
    if not isinstance(step, int) or isinstance(step, bool) or step < 0:
        raise ValueError(f"{STEP} is not an iteration")
    return row


Value = bool | Whole | Number
Row = Annotated[dict[str, Value], AfterValidator(_with_step)]  # of ``metrics.jsonl`` and ``events.jsonl``


@dataclass(frozen=True, kw_only=True)
class Stepped(Record):
    """A row of any of these files, of which the iteration is asked for."""

    step: Count


@dataclass(frozen=True, kw_only=True)
class Histogram(Stepped):
    """A row of ``volume_histograms.jsonl``: counts between edges, the logarithms to the base 10 of volumes."""

    log10_edges: list[Exponent]
    counts: list[Amount]

    def __post_init__(self) -> None:
        if len(self.log10_edges) != len(self.counts) + 1:
            raise ValueError("the edges are not one more than the counts")


def read_rows(path: Path, kind: Any = Row, read: Callable[[Path], bytes] = read_bytes) -> list[Any]:
    """The rows of a file, each of type ``kind``; [] where there is none.

    ``read`` gives the content. What cannot be read, and what follows a damaged row, is left out, with a warning.
    """
    try:
        content = read(path)
    except FileNotFoundError:
        return []
    except DamagedError as error:
        log.warning("left out: %s", error)
        return []
    return [row for _, row in iterate_rows(content, kind, path)]


def whole_lines(path: Path) -> list[tuple[str, int]]:
    """The lines of ``metrics.jsonl`` or its like up to the first damaged one, each with its iteration."""
    try:
        content = read_bytes(path)
    except FileNotFoundError:
        return []
    return [(line, row.step) for line, row in iterate_rows(content, Stepped, path)]
