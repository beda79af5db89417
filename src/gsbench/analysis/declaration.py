"""Declarations of an experiment, and for each question whether it was declared in time.

A question (arm against baseline in a metric, on scenes and seeds) counts as declared if it was
fixed before the first trial of its *arm* was measured. Older trials of the baseline do no harm:
what was seen of them says nothing about the arm. Trials added after the arm's first result do
harm, since adding until an effect appears finds effects that do not exist.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, reduce
from pathlib import Path

from gsbench.analysis.attempts import earlier_results, of_same_arm, places_of
from gsbench.analysis.notes import Note
from gsbench.analysis.results import Experiment, TrialResult
from gsbench.analysis.trial_settings import config_if_readable, settings_text
from gsbench.analysis.unfinished import Unfinished
from gsbench.runs.experiments import Declaration, Planned, Question, merge_planned, of_latest_metric
from gsbench.runs.layout import FORGOTTEN, SEED
from gsbench.runs.seen import SeenResult
from gsbench.words import counted


@dataclass(frozen=True)
class Standing:
    """The standing of a declaration to the question about one arm.

    ``declaration`` is the one that first named the arm, with its trials up to the arm's first
    result; questions of one such declaration share an error rate. ``question`` is that about these
    arms if a sweep in looks names its questions. ``seen`` are the arm's results that were measured
    before the metric was declared, ``added`` the trials of its pairs that were not declared before
    its first result. ``other_pair``: these arms are no pair of the declaration.
    """

    active: "ActiveDeclaration"
    declaration: Declaration
    question: Question | None
    seen: tuple[SeenResult, ...]
    added: tuple[TrialResult, ...]
    other_pair: bool

    @property
    def beforehand(self) -> bool:
        """Return whether the question was fixed before any result of its arm."""
        return not self.doubt

    @property
    def doubt(self) -> str:
        """The reason why the question does not count as declared; "" if it does."""
        if self.seen:
            # trials of earlier code were seen, too, so these may be more than the arm has now
            of_arm = f"{counted(len(self.seen), 'trial')} of the arm"
            return f"only after {of_arm} had been measured"
        if self.added:
            were = "was" if len(self.added) == 1 else "were"
            return f"{counted(len(self.added), 'trial')} {were} added after the arm's first result"
        return "not for this pair of arms" if self.other_pair else ""


@dataclass(frozen=True)
class ActiveDeclaration:
    """The declarations in force in an experiment: all of the latest metric, the oldest first.

    ``declared`` are those of all metrics, ``folder`` is the experiment's. ``older`` are trials of
    earlier code, which do not count but were seen; ``seen`` is what was ever measured.
    """

    declared: tuple[Declaration, ...]
    folder: Path
    older: tuple[TrialResult, ...] = ()
    seen: tuple[SeenResult, ...] = ()

    @cached_property
    def records(self) -> tuple[Declaration, ...]:
        return of_latest_metric(self.declared)

    @property
    def metric(self) -> str:
        return self.records[0].questions[0].metric

    @property
    def question(self) -> str:
        """The question of the verdict, interpolation or extrapolation; "" if it is about both."""
        return self.records[0].questions[0].about

    def standing(
        self, baseline: Sequence[TrialResult], arm: Sequence[TrialResult], other_pair: bool = False
    ) -> Standing:
        """The standing to the question about ``arm``, given both arms' trials.

        A metric that is declared after the arm's first result is in force for later arms alone.
        ``other_pair`` says that the arms would not be compared without a choice made later.
        """
        old = of_same_arm(arm, self.older)
        # also what was removed or overwritten since, or had another name
        gone = earlier_results(arm, self.seen)
        times = [(one.measured, one.as_seen) for one in (*arm, *old)]
        times += [(one.moment, one) for one in gone]
        first = min((moment for moment, _ in times), default=math.inf)
        if known := [one for one in self.declared if one.moment <= first]:
            metric = known[-1].primary
            kept = tuple(o for o in self.declared if o.moment <= first or o.primary == metric)
            if kept != self.declared:
                return replace(self, declared=kept).standing(baseline, arm, other_pair)
        first = min((trial.measured for trial in arm), default=math.inf)
        # times are whole seconds: a declaration of the arm's first second may be later
        before = [
            record for record in self.records if record is self.records[0] or record.moment < first
        ]
        keys = {trial.key for trial in arm}
        naming = [record for record in before if keys & record.planned.keys()] or before[:1]
        in_looks = [record for record in naming if record.looks]
        of_baseline = {trial.key for trial in baseline}

        def asked_by(declarations: Iterable[Declaration]) -> list[tuple[Declaration, Question]]:
            return [
                (one, question)
                for one in declarations
                for question in one.questions
                # some scenes may have no result yet
                if any(a in of_baseline for a, _ in question.scenes.values())
                and any(b in keys for _, b in question.scenes.values())
            ]

        asked = asked_by(in_looks)
        seen = {
            (one.place, one.version): one
            for moment, one in times
            if moment < self.records[0].moment
        }
        # Only pairs of trials reach a verdict. Of the baseline, what was there before the arm's
        # first result could not be chosen by it.
        places, others = places_of(baseline), places_of(arm)
        paired = [trial for trial in arm if (trial.scene, trial.seed) in places]
        paired += [t for t in baseline if (t.scene, t.seed) in others and t.measured >= first]
        if before[-1].names_trials:
            planned = reduce(merge_planned, (record.planned for record in before))
            added = [trial for trial in paired if trial.seed not in planned.get(trial.key, ())]
        else:
            # The record's file may be lost, and results repeat only its metric and time. Then every
            # trial that was measured after the next record with trials may have been added.
            named = (record.moment for record in self.records if record.names_trials)
            next_record = min(named, default=math.inf)
            added = [one for one in paired if one.measured >= next_record]
        # An exploratory question has all looks that were ever planned for it: trials end at the
        # one that pleases.
        late = asked_by(one for one in self.records if one.looks) if seen or added else []
        latest = (late or asked)[-1:]
        declaration, question = latest[0] if latest else ((*in_looks, naming[0])[0], None)
        # a sweep in looks stopped by its own questions
        other_pair = not asked if in_looks else other_pair
        return Standing(self, declaration, question, tuple(seen.values()), tuple(added), other_pair)

    def missing(self, trials: Sequence[TrialResult]) -> list[Unfinished]:
        """The declared trials without a result, except those of looks, which may not be needed.

        A trial counts only if its settings are those of its arm's finished trials on its scene.
        """
        plans = [one.planned for one in self.declared if not one.looks]
        planned: Planned = reduce(merge_planned, plans, {})
        configs = {trial.key: trial.config for trial in trials}
        places = {key.rpartition("/")[0] for key in configs}
        done = {(trial.key, trial.seed) for trial in trials}
        return [
            Unfinished(self.folder / f"{key}{SEED}{seed}", configs.get(key, {}))
            for key, seeds in planned.items()
            if key in configs or key.rpartition("/")[0] not in places
            for seed in seeds
            if (key, seed) not in done
        ]

    def progress(self, trials: Sequence[TrialResult]) -> list[Note]:
        """A note on the declared trials that are missing; none if all are there."""
        planned = reduce(merge_planned, (declaration.planned for declaration in self.declared))
        done = {(trial.key, trial.seed) for trial in trials}
        replaced = {trial.key for trial in self.older}
        wanted = [
            (key, seed)
            for key, seeds in planned.items()
            for seed in seeds
            if (key, seed) in done
            or (key not in replaced and not self._is_replaced(key, seeds, trials))
        ]
        missing = sum(one not in done for one in wanted)
        if not missing:
            return []
        kind = (
            "looks to come"
            if any(declaration.looks for declaration in self.declared)
            else "early look"
        )
        return [Note.of(kind, missing=missing, declared=len(wanted))]

    def _is_replaced(self, key: str, seeds: Iterable[int], trials: Sequence[TrialResult]) -> bool:
        """Return whether trials with a planned trial's settings, but other code, have finished.

        That is so if the planned trial failed and its code was repaired.
        """
        for seed in seeds:
            homes = (self.folder, self.folder / FORGOTTEN)
            found = (config_if_readable(home / f"{key}{SEED}{seed}") for home in homes)
            if not (config := next(filter(None, found), None)):
                continue
            place = key.rpartition("/")[0]
            same_arm = [trial for trial in trials if trial.key.rpartition("/")[0] == place]
            text = settings_text(config)
            return any(
                trial.key != key and settings_text(trial.config) == text for trial in same_arm
            )
        return False

    def notes(self, name: str, doubted: bool) -> list[Note]:
        """Notes on when the metric called ``name`` was declared, and if this is ``doubted``."""
        name += f" at {self.question}" if self.question else ""
        when = self.records[0].when
        notes = [Note.of("declared" if doubted else "declared beforehand", metric=name, when=when)]
        return notes + ([Note.of("doubted", metric=name)] if doubted else [])


def active_declaration(experiment: Experiment) -> ActiveDeclaration | None:
    """The declarations in force for a sweep; None if nothing was declared.

    The latest metric is in force. Further commands may add trials to an arm until its first result.
    """
    declared = tuple(one for one in experiment.declarations if one.kind == "sweep")
    if not declared:
        return None
    return ActiveDeclaration(declared, experiment.folder, experiment.older, experiment.seen)
