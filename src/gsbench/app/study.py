"""A study of Optuna's: what it searches, the points that it proposes, and what they were worth.

It lies in a journal in its experiment's folder, and what a point is worth is read from the files of its trials, so a
study that was killed goes on where it stopped.
"""

from __future__ import annotations

import logging
import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from hydra.core.override_parser.types import IntervalSweep, Override, RangeSweep

from gsbench.app.sweep import grid
from gsbench.config.command_words import check_makes_trials
from gsbench.errors import InputError
from gsbench.eval.facts import find, known_keys
from gsbench.files import require_own, write_json
from gsbench.launch.trial import Trial
from gsbench.runs.layout import SEARCH, SEARCH_JOURNAL
from gsbench.runs.search_record import Point, SearchRecord
from gsbench.runs.trial_folder import TrialFolder
from gsbench.system.install import install_command
from gsbench.words import closest, counted

if TYPE_CHECKING:
    from optuna import Study as OptunaStudy
    from optuna.distributions import BaseDistribution

log = logging.getLogger(__name__)

DIGITS = 4  # significant digits of a value: a name for it that people can type
DIRECTIONS: dict[int, Literal["maximize", "minimize"]] = {1: "maximize", -1: "minimize"}
Values = dict[str, Any]  # of a point, by key
Ranges = Mapping[str, "BaseDistribution"]  # of what is searched, by key


@dataclass(frozen=True)
class Goal:
    """Measure of a good point: ``metric``, better where there is more of it (``sign`` 1) or less (-1).

    ``points`` are all that are proposed, ``at_once`` of them before the next result is known.
    """

    metric: str
    sign: int
    points: int
    at_once: int = 1


@dataclass(frozen=True)
class Study:
    """The study called ``name`` of the experiment in ``home``.

    ``ranges`` are what is searched, ``first`` values that are the first point whatever the sampler would propose.
    """

    home: Path
    name: str
    goal: Goal
    ranges: Ranges
    first: Values | None = None
    seeds: int = field(default=1, kw_only=True)  # trials of each scene that a point is judged by: the record says so
    arm: str = field(default="", kw_only=True)  # INIT-DENSIFY that is searched

    def next_points(self) -> dict[int, Values]:
        """Values by the number of the point: those that a killed search left unjudged, else the next; none at the end.

        What is proposed depends on the results before it alone, not on when a search was killed.
        """
        from optuna.samplers import TPESampler
        from optuna.trial import TrialState

        study, goal = self._optuna, self.goal
        every = study.get_trials(deepcopy=False)
        known = [trial for trial in every if trial.state != TrialState.WAITING]
        begun = {trial.number: trial.params for trial in known if trial.state == TrialState.RUNNING}
        left = {number: values for number, values in begun.items() if lie_in(values, self.ranges)}
        for number in begun.keys() - left.keys():  # killed between its first value and its last
            study.tell(number, state=TrialState.FAIL)
        if left:
            return left
        if not every and self.first is not None:
            study.enqueue_trial(self.first)
        points: dict[int, Values] = {}
        while len(known) + len(points) < goal.points and len(points) < goal.at_once:
            number = len(known) + len(points)
            # A sampler for each point, so that what it proposes does not hang on how many it has proposed before.
            study.sampler = TPESampler(seed=number, constant_liar=goal.at_once > 1)
            asked = study.ask(dict(self.ranges))
            points[asked.number] = asked.params
        return points

    def judge(self, number: int, trials: Sequence[Trial]) -> None:
        """Judge a point by the files of its trials: by their mean, and as failed where one lacks the metric."""
        from optuna.trial import TrialState

        records = [TrialFolder(trial.folder).sound_record() for trial in trials]
        found = [None if record is None else record.metrics.get(self.goal.metric) for record in records]
        values = [value for value in found if value is not None]
        if len(values) < len(found):
            self._optuna.tell(number, state=TrialState.FAIL)
        else:
            self._optuna.tell(number, statistics.fmean(values))
        done = self._optuna.get_trials(deepcopy=False)[number]
        came = f"{self.goal.metric} {done.value:.5g}" if done.value is not None else f"failed, no {self.goal.metric}"
        where = ", ".join(words_of_values(done.params))
        log.info("%s: point %d of %d: %s: %s", self.home.name, number + 1, self.goal.points, where, came)

    def write_record(self) -> SearchRecord:
        """Write what was found so far where the report looks for it; the same."""
        record = self._record()
        write_json(self.home / SEARCH, record.to_json())
        return record

    def _record(self) -> SearchRecord:
        from optuna.distributions import FloatDistribution, IntDistribution
        from optuna.trial import TrialState

        states: dict[str, Literal["done", "failed"]] = {"COMPLETE": "done", "FAIL": "failed"}
        numbers = (FloatDistribution, IntDistribution)
        trials = [one for one in self._optuna.get_trials(deepcopy=False) if one.state != TrialState.WAITING]
        return SearchRecord(
            metric=self.goal.metric,
            direction=1 if self.goal.sign > 0 else -1,
            wanted=self.goal.points,
            seeds=self.seeds,
            validation=True,  # as all points of a tuning
            arm=self.arm,
            log=[key for key, one in self.ranges.items() if isinstance(one, numbers) and one.log],
            points=[
                Point(
                    number=trial.number,
                    state=states.get(trial.state.name, "unfinished"),
                    settings={key: _shown(value) for key, value in trial.params.items()},
                    value=trial.value,
                )
                for trial in trials
            ],
        )

    @cached_property
    def _optuna(self) -> OptunaStudy:
        check_installed()
        import optuna
        from optuna.storages import JournalStorage
        from optuna.storages.journal import JournalFileBackend

        optuna.logging.set_verbosity(optuna.logging.WARNING)
        require_own(self.home.parent, self.home / SEARCH_JOURNAL)
        storage = JournalStorage(JournalFileBackend(str(self.home / SEARCH_JOURNAL)))
        direction = DIRECTIONS[1 if self.goal.sign > 0 else -1]
        return optuna.create_study(study_name=self.name, storage=storage, direction=direction, load_if_exists=True)


def arm_of(trial: Trial) -> str:
    """``INIT-DENSIFY`` of a trial."""
    return f"{trial.values['init']['name']}-{trial.values['densify']['name']}"


def check_installed() -> None:
    """Raise InputError, one line that says what to install, where Optuna is not."""
    try:
        import optuna  # noqa: F401
    except ImportError:
        raise InputError(f"a search needs Optuna: {install_command('search')}") from None


def sign_of(metric: str, direction: str | None, place: str) -> int:
    """Sign of a metric, 1 where more of it is better, -1 where less: its own, else the ``direction`` given.

    Raises InputError, naming the settings below ``place``, for a metric that is not known and one that goes the other
    way.
    """
    facts = find(metric)
    if facts is None and direction is None:
        raise InputError(
            f"{place}.metric={metric} is no metric whose direction is known{closest(metric, known_keys())} "
            f"(choose: {', '.join(known_keys())}; for a metric of your own give {place}.direction, too)"
        )
    if facts is not None and direction not in (None, DIRECTIONS.get(facts.direction)):
        raise InputError(f"{place}.direction={direction}: {facts.label} is better the other way; leave direction out")
    given = next((sign for sign, name in DIRECTIONS.items() if name == direction), 0)
    return given or (facts.direction if facts else 0)


def distribution(override: Override) -> BaseDistribution:
    """Return the range of a swept word's values; raises InputError for what makes no other trial."""
    from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

    check_makes_trials(override)
    sweep: Any = override.value()
    try:
        if isinstance(sweep, IntervalSweep):
            low, high = sweep.start, sweep.end
            assert low is not None
            assert high is not None
            log_scale = "log" in sweep.tags
            if not -math.inf < low < high < math.inf:
                raise ValueError("an interval goes from a number to a larger one")
            if log_scale and low <= 0:
                raise ValueError("on a logarithmic scale an interval begins above 0")
            if isinstance(sweep.start, int) and isinstance(sweep.end, int) and "int" in sweep.tags:
                return IntDistribution(sweep.start, sweep.end, log=log_scale)
            return FloatDistribution(float(low), float(high), log=log_scale)
        if isinstance(sweep, RangeSweep) and not isinstance(sweep.step, float):
            values = [int(str(value)) for value in override.sweep_iterator()]
            return IntDistribution(values[0], values[-1], step=max(1, int(sweep.step)))
        choices = list(dict.fromkeys(word.partition("=")[2] for (word,) in grid([override])))
        return CategoricalDistribution(choices)
    except (ValueError, IndexError) as error:
        raise InputError(f"{override.input_line}: {error}") from error


def lowest(ranges: Ranges) -> Values:
    """The point of the lowest value, or first choice, of all that is searched."""
    return {key: one.choices[0] if hasattr(one, "choices") else one.low for key, one in ranges.items()}  # type: ignore[attr-defined]


def lie_in(values: Values, ranges: Ranges) -> bool:
    """Return whether ``values`` has a value of each range and nothing else; numbers as `text_of` rounds them."""
    # A record of a stranger's might set anything else, such as where the results are sent.
    return values.keys() == ranges.keys() and all(_lies_in(value, ranges[key]) for key, value in values.items())


def _lies_in(value: Any, one: Any) -> bool:
    if hasattr(one, "choices"):
        return value in one.choices
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    return float(text_of(one.low)) <= float(text_of(value)) <= float(text_of(one.high))


def words_of_values(values: Mapping[str, Any]) -> list[str]:
    """A point as words of a command line."""
    return [f"{key}={text_of(value)}" for key, value in values.items()]


def text_of(value: Any) -> str:
    """A value of a point as it is given to its trials."""
    return f"{value:.{DIGITS}g}" if isinstance(value, float) else str(value)


def best_words(record: SearchRecord, name: str) -> str:
    """``search: best psnr 25.1 at densify.volume_threshold=0.03 (12 points, 1 failed); gsbench report NAME``"""
    failed = sum(point.value is None for point in record.points)
    count = counted(len(record.points), "point") + (f", {failed} failed" if failed else "")
    best = record.best
    if best is None:
        return f"search: {count}; see gsbench status {name}"
    where = " ".join(words_of_values(best.settings))
    return f"search: best {record.metric} {best.value:.5g} at {where} ({count}); gsbench report {name}"


def _shown(value: Any) -> Any:
    return float(text_of(value)) if isinstance(value, float) else value
