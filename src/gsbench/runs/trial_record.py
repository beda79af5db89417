"""The types of a trial's files, for writing and for reading.

These are ``results.json``, the records of stages in the store (``training.json``,
``metrics.json``), the small files of a trial's folder, and the JSON lines of a training.
"""

import logging
import reprlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import field
from pathlib import Path
from typing import Annotated, Any, Final, Literal, TypeVar

from pydantic import AfterValidator, AliasChoices, Field

from gsbench.normalization import IDENTITY, Normalization
from gsbench.parsing import (
    MAX_NUMBER,
    Amount,
    Count,
    DamagedError,
    Facts,
    Number,
    Raw,
    Record,
    Text,
    Whole,
    fault_of,
    one_line,
    parse_typed,
    read_bytes,
    typed,
)
from gsbench.settings import FolderName
from gsbench.words import as_line

log = logging.getLogger(__name__)
T = TypeVar("T")

# ``evaluated_from`` of trials that gsbench did not train: it rendered another program's model, or
# has only renders.
FROM_MODEL: Final = "model"
FROM_RENDERS: Final = "renders"
MADE_ELSEWHERE = "made by another program"  # start of the reason why such a trial lacks a quantity
RENDERS_ALONE = f"{MADE_ELSEWHERE}; only the renders are known"

BY_LISTS = "list"  # `split_text` of a split by lists of views

Iteration = Annotated[str, Field(pattern=r"^\d{1,18}$")]  # as the key of an object


class Budget(Record):
    """Limits on a trial's growth: a maximum of Gaussians, the rule that keeps it, and seconds."""

    max_gaussians: Count | None = None
    cap: str | None = None
    seconds: Amount | None = None


class Code(Record):
    """The versions of the code: sha256 of a user's modules (``sources``), and of the stages.

    ``packages`` has the states of gsbench's packages (`gsbench.runs.code`). ``commit`` is
    that of the checkout that trained; ``edited`` says whether files that git tracks had changed.
    """

    sources: dict[str, str] = field(default_factory=dict)
    stages: dict[str, int] = field(default_factory=dict)
    packages: Annotated[
        dict[str, str], Field(validation_alias=AliasChoices("packages", "rooms"))
    ] = field(default_factory=dict)  # "rooms" in early files
    commit: str | None = None
    edited: bool | None = None  # None without a checkout, or if git cannot tell


class MetricRecord(Record):
    """Facts of a user's own metric; see `gsbench.eval.facts`."""

    label: str
    direction: Literal[-1, 0, 1] = 0
    decimals: Annotated[int, Field(ge=0, le=12)] = 3
    unit: str = ""
    worthwhile: Annotated[float, Field(gt=0, le=MAX_NUMBER)] | None = None


class Earlier(Record):
    """Metrics at an earlier iteration."""

    metrics: dict[str, Number]
    num_gaussians: Count | None = None


class ExternalTrainer(Record):
    """The program that trained in gsbench's place: its name, version, own words, and command."""

    program: str
    version: str
    said: str | None = None
    command: list[str] = field(default_factory=list)


class Oddity(Record):
    """An oddity that one rule of gsbench.scene.rules found in a capture, its model or its points.

    ``refused`` says that the value is not usable, and that the rule was accepted.
    """

    rule: Text
    line: Text
    value: Number
    refused: bool = False


class InitialCloud(Record):
    """Facts of the initial points, measured before the first iteration (`gsbench.train.start`)."""

    seen: Amount  # the share of points that at least two training views have in view
    # with the photographs: 1 is equal, 0 is chance; None for points of one colour
    color_agreement: Number | None
    identical: Amount  # the share of points that share their place with another
    # points more than 10,000 times as far from the cameras' median place as cameras usually are
    far: Count
    # the median distance of points from their median place, over that of the training cameras
    spread: Amount
    warnings: list[str] = field(default_factory=list)  # of earlier versions


class TwinViews(Record):
    """Photographs that the capture has twice.

    ``left_out`` maps each photograph that was not used to the one that it copies. ``near`` maps
    a test view to the training view that looks nearly the same, as the next shot of a burst
    does; both were used.
    """

    left_out: dict[str, str] = field(default_factory=dict)
    near: dict[str, str] = field(default_factory=dict)


class RasterProof(Record):
    """A comparison of a rasterizer with the float64 reference on a device (`gsbench.train.proof`).

    ``errors`` has the largest error of each quantity. ``failures`` has a line for each that is too
    large. ``direct_fault`` says why training steps use autograd; "" if they need not.
    """

    raster: Text
    device: Text
    versions: dict[str, str]
    errors: dict[str, Number]
    failures: list[str]
    seconds: Amount
    direct_fault: str = ""

    @property
    def passed(self) -> bool:
        return not self.failures


class TrialRecord(Record):
    """A finished trial.

    A value that cannot be known is None; the file leaves out None if that is the default.
    ``metrics`` are means over the test views. ``unavailable`` says why other metrics are
    missing; ``awaited`` names those of them that need only weights. ``seconds`` are by stage;
    ``resolution`` is (width, height) in px.
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
    evaluated_from: Literal["model", "renders"] | None = None  # None if gsbench trained it
    trained_by: ExternalTrainer | None = None
    measured: str | None = None  # time at which the evaluation was stored
    # ids of the questions that covered the trial when its training began
    questions: list[str] = field(default_factory=list)
    awaited: list[str] = field(default_factory=list)
    metric_facts: dict[str, MetricRecord] = field(default_factory=dict)
    metrics_at: dict[Iteration, Earlier] = field(default_factory=dict)
    # dB: what a picture of the training views' mean colour would reach
    one_color_psnr: Number | None = None
    # Gaussians at the end, by the cause of their creation
    causes: dict[str, Count] = field(default_factory=dict)
    scene_extent: Amount | None = None  # units of the given coordinates
    initial_cloud: InitialCloud | None = None
    oddities: list[Oddity] = field(default_factory=list)
    twins: TwinViews | None = None  # None: not looked for
    # from the given coordinates to those of the training; None: the same
    normalization: Normalization | None = None
    budget: Budget | None = None
    train_views: Count | None = None
    test_views: Count | None = None
    split: str = ""  # the rule that holds views out, as short text (`split_text`)
    held_out: str = ""  # the same as a sentence
    resolution: tuple[Count, Count] | None = None
    events: dict[str, Count] = field(default_factory=dict)  # totals of the refinements, by cause
    init_report: Facts = field(default_factory=dict)
    renders: dict[str, str] = field(default_factory=dict)  # origin of another program's renders
    code: Code = field(default_factory=Code)
    machine: dict[str, str] | None = None
    raster_proof: RasterProof | None = None  # of the executor, on a GPU
    # executors that raster=auto did not take, and why
    raster_passed_over: list[str] = field(default_factory=list)

    @property
    def remark(self) -> str:
        """The reason why a finished trial's results may surprise, in one line; "" without one."""
        return "; ".join(filter(None, [self.learnt_nothing, *self.raster_passed_over]))

    @property
    def metrics_line(self) -> str:
        """The metrics to four digits, in one line."""
        return "  ".join(f"{key} {value:.4g}" for key, value in self.metrics.items())

    @property
    def learnt_nothing(self) -> str:
        """A line that the renders are not better than one colour; "" if they are, or if unknown."""
        psnr, one_color = self.metrics.get("psnr"), self.one_color_psnr
        if psnr is None or one_color is None or psnr > one_color:
            return ""
        return (
            f"not better than one colour: PSNR {psnr:.2f} dB, the training views' mean colour "
            f"has {one_color:.2f}"
        )

    @property
    def to_training(self) -> Normalization:
        """The map from the coordinates of the model's file to those of the training."""
        return self.normalization or IDENTITY

    def __post_init__(self) -> None:
        if self.num_gaussians is None and self.evaluated_from != FROM_RENDERS:
            raise ValueError("num_gaussians is not there")
        if fault := fault_of(self.init_report):
            raise ValueError(f"in init_report {fault}")


class UnfinishedError(DamagedError):
    """A ``results.json`` whose status is not "complete"."""


def record_from(values: Any, path: Path) -> TrialRecord:
    """The record with the JSON ``values`` of the results file ``path``.

    Raises DamagedError and UnfinishedError.
    """
    if isinstance(values, dict) and (status := values.get("status")) != "complete":
        raise UnfinishedError(path, f"is unfinished, its status is {reprlib.repr(status)}")
    return typed(values, TrialRecord, path)


class Training(Record):
    """The counts, time and memory of a training.

    ``trained_by`` and ``evaluated_from`` are set if another program trained.
    """

    iterations: Count
    num_init_points: Count
    num_gaussians: Count | None
    causes: dict[str, Count]
    scene_extent: Amount
    seconds: Amount
    peak_memory_mb: Amount | None
    machine: dict[str, str]
    # gsbench's commit, and whether files were edited
    checkout: dict[str, Any] = field(default_factory=dict)
    initial_cloud: InitialCloud | None = None
    oddities: list[Oddity] = field(default_factory=list)  # of the initial points
    # compiling kernels for it, in no other time; None if another program trained
    compile_seconds: Amount | None = None
    evaluated_from: Literal["model", "renders"] | None = None
    trained_by: ExternalTrainer | None = None

    @property
    def was_given(self) -> bool:
        """Return whether the model of another program was given, so that nothing was trained."""
        return self.trained_by is None and not self.iterations


class Evaluation(Record):
    """The metrics of a trial; fields as in `TrialRecord`."""

    one_color_psnr: Number | None = None
    metrics: dict[str, Number]
    unavailable: dict[str, str]
    awaited: list[str]
    facts: dict[str, MetricRecord] = field(default_factory=dict)  # of a user's own metrics
    at: dict[Iteration, Earlier] = field(default_factory=dict)  # by iteration


def split_text(config: Mapping[str, Any]) -> str:
    """``every_nth``, ``sector 0 of 8`` or ``list``, then ``, matched`` or ``, validation``."""
    text, sectors = str(config.get("scene.split")), config.get("scene.sectors")
    if text == "sector":
        text = f"sector {config.get('scene.sector')} of {sectors}"
    if config.get("scene.train_list") or config.get("scene.test_list"):
        text = BY_LISTS
    elif config.get("scene.match_views"):
        text += ", matched" if text.startswith("sector") else f", matched with {sectors}"
    return f"{text}, validation" if config.get("scene.validation") else text


# ---- the small files of a trial's folder


class NamedGroup(Record):
    """A group of the configuration that must have a name."""

    name: FolderName


class TrackingSettings(Record):
    """The settings of the group ``tracking`` that later mirroring of a trial needs."""

    uri: str | None
    flush_seconds: Amount
    patience_seconds: Amount
    images: Count


class Configuration(Record):
    """The keys that every usable ``config.yaml`` has; `gsbench.config.schema` checks the others."""

    name: FolderName
    seed: Count
    runs: str
    scene: NamedGroup
    init: NamedGroup
    densify: NamedGroup
    tracking: TrackingSettings


class Failure(Record):
    """``failed.json``: the error's type, its text, its traceback, and the Unix time."""

    error: str = ""
    message: Raw = ""  # of several lines; `reason` is the first
    traceback: Raw = field(default="", repr=False)
    time: Amount = 0.0
    seed: Count = 0
    bad_input: bool = False  # the user's files or settings are the cause

    @property
    def reason(self) -> str:
        """The first line of the message."""
        lines = (self.message or self.error).strip().splitlines()
        return one_line(as_line(lines[0])) if lines else "no reason was given"


class Building(Record):
    """``building.json``: the present stage of an unfinished trial, and where it is built."""

    stage: str = ""
    folder: Raw = ""


class AskedBefore(Record):
    """The ids of the questions that covered a trial when the ``training`` (a key) began."""

    training: str
    questions: list[str]


# ---- the JSON lines of a training

STEP = "step"  # the key of the iteration in every row


def _with_step(row: dict[str, bool | int | float]) -> dict[str, bool | int | float]:
    step = row.get(STEP)
    if not isinstance(step, int) or isinstance(step, bool) or step < 0:
        raise ValueError(f"{STEP} is not an iteration")
    return row


Value = bool | Whole | Number
# a row of ``metrics.jsonl`` or ``events.jsonl``
Row = Annotated[dict[str, Value], AfterValidator(_with_step)]


class RowWithStep(Record):
    """A row of any of these files; only its iteration is checked."""

    step: Count


def read_rows(path: Path, read: Callable[[Path], bytes] = read_bytes) -> list[Any]:
    """The rows of a file; [] if there is no such file.

    ``read`` reads the content. With a warning, a file that cannot be read is left out, and so are
    all rows from a damaged one on.
    """
    try:
        content = read(path)
    except FileNotFoundError:
        return []
    except DamagedError as error:
        log.warning("left out: %s", error)
        return []
    return [row for _, row in iterate_rows(content, Row, path)]


def whole_lines(path: Path) -> list[tuple[str, int]]:
    """The lines of a file such as ``metrics.jsonl`` up to the first damaged one, by iteration."""
    try:
        content = read_bytes(path)
    except FileNotFoundError:
        return []
    return [(line, row.step) for line, row in iterate_rows(content, RowWithStep, path)]


def iterate_rows(content: bytes, kind: type[T], path: Path) -> Iterator[tuple[str, T]]:
    """Parse the JSON lines of the file ``path``; yields each line with its object of ``kind``.

    A damaged line and the lines after it are left out. There is a warning, except for an incomplete
    last line, which a killed process leaves.
    """
    lines = content.splitlines(keepends=True)
    for number, line in enumerate(lines, 1):
        try:
            row = parse_typed(line, kind, path)
        except DamagedError as error:
            if line.endswith(b"\n") or number < len(lines):
                log.warning("left out: %s from line %d on, which %s", path, number, error.reason)
            return
        yield line.decode("utf-8").rstrip("\r\n"), row
