"""The results that were ever measured in an experiment: ``<runs>/.seen/<experiment>.jsonl``.

A line is added before ``results.json`` is written, and stays. So an arm's earlier code counts as
seen, although its results were removed or overwritten, or the arm was renamed.
"""

import json
import logging
from dataclasses import field, replace
from functools import cached_property
from pathlib import Path

from gsbench.files import require_no_links, write_text
from gsbench.parsing import (
    Count,
    DamagedError,
    Number,
    Record,
    Text,
    parse_typed,
    read_bytes,
)
from gsbench.runs.experiments import stamp_now, unix_time
from gsbench.runs.freshness import code_of
from gsbench.runs.layout import SEEN
from gsbench.runs.package_code import AS_RELEASED
from gsbench.runs.trial_record import TrialRecord
from gsbench.system.locks import hold

log = logging.getLogger(__name__)

Place = tuple[str, int]  # photographs (their hash; if it is not known, the scene's name) and seed


class SeenResult(Record):
    """A result that was measured at ``time``, and so may have been seen.

    ``name`` is INIT-DENSIFY; ``arm`` the hash of what the arm is made of (`arm_hash`), "" if
    unknown. ``code`` are the versions of what a user may have edited: own modules, and packages of
    gsbench that differ from the release.
    """

    name: Text
    arm: str = ""
    scene: Text
    data: str = ""
    seed: Count
    time: str = ""
    code: dict[str, str] = field(default_factory=dict)
    metrics: dict[str, Number]
    num_gaussians: Count | None = None

    @classmethod
    def of(cls, record: TrialRecord) -> "SeenResult":
        """The result of a trial."""
        code = {
            str(part): version
            for part, version in code_of(record.code).items()
            if part.kind != "stage" and version != AS_RELEASED
        }
        return cls(
            name=f"{record.init}-{record.densify}",
            arm=record.hashes.get("arm", ""),
            scene=record.scene,
            data=record.hashes.get("data", ""),
            seed=record.seed,
            time=record.measured or "",
            code=code,
            metrics=dict(record.metrics),
            num_gaussians=record.num_gaussians,
        )

    @cached_property
    def place(self) -> Place:
        return self.data or self.scene, self.seed

    @cached_property
    def version(self) -> frozenset[tuple[str, str]]:
        """The versions of all parts of the code."""
        return frozenset(self.code.items())

    @property
    def moment(self) -> int:
        """The Unix time of measuring."""
        return unix_time(self.time) or 0

    def has_bits_of(self, other: "SeenResult") -> bool:
        """Return whether both have the same count, and the same values of all common metrics."""
        common = self.metrics.keys() & other.metrics.keys()
        same_count = self.num_gaussians == other.num_gaussians
        return same_count and all(self.metrics[key] == other.metrics[key] for key in common)


def seen_path(home: Path) -> Path:
    """The record of the experiment in ``home``; beside it, so that it outlives that folder."""
    return home.parent / SEEN / f"{home.name}.jsonl"


def read_seen(home: Path) -> tuple[SeenResult, ...]:
    """All results that were measured in the experiment, the first ones first.

    Damaged lines are left out, with a warning: each line is a result of its own.
    """
    path, found = seen_path(home), list[SeenResult]()
    try:
        for number, line in enumerate(read_bytes(path).splitlines(), 1):
            try:
                found.append(parse_typed(line, SeenResult, path))
            except DamagedError as error:
                log.warning("left out: line %d of %s", number, error)
    except FileNotFoundError:
        pass
    except DamagedError as error:
        log.warning("left out: %s", error)
    return tuple(found)


def remember(home: Path, record: TrialRecord) -> None:
    """Add a result to the record of its experiment, unless it has it; the first time counts."""
    path, result = seen_path(home), SeenResult.of(record)
    require_no_links(home.parent, path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with hold(path.with_name(f".{home.name}.lock"), "the record of what was measured"):
        if any(replace(known, time=result.time) == result for known in read_seen(home)):
            return
        text = path.read_text(errors="replace") if path.exists() else ""
        line = json.dumps(replace(result, time=result.time or stamp_now()).to_json())
        between = "" if not text or text.endswith("\n") else "\n"
        write_text(path, f"{text}{between}{line}\n")
