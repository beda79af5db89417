"""Trials as the conventions of another program measure their renders, from what ``gsbench evaluate`` kept."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace

from gsbench.analysis.results import Experiment, TrialResult
from gsbench.errors import InputError
from gsbench.eval.facts import find
from gsbench.eval.protocol import Protocol, get_protocol, protocol_of
from gsbench.runs.translation_record import read_translations
from gsbench.words import signed


def by_protocol(experiment: Experiment, name: str) -> Experiment:
    """The experiment with its trials' metrics by the protocol ``name``; raises InputError where one lacks them."""
    wanted = get_protocol(name)
    return replace(experiment, trials=tuple(_translated(trial, wanted) for trial in experiment.trials))


def _translated(trial: TrialResult, wanted: Protocol) -> TrialResult:
    own = trial.record.protocol
    if own == wanted.id:
        return trial
    found = read_translations(trial.path, trial.record).get(wanted.id)
    if found is None:
        raise InputError(
            f"{trial.label} was not measured by {wanted.id}: gsbench evaluate {trial.experiment} "
            f"--protocol {wanted.name}"
        )
    record = replace(trial.record, protocol=wanted.id, metrics=found.metrics, unavailable=found.unavailable)
    return replace(trial, record=record, translation=found, translated_from=own)


def translation_notes(trials: Sequence[TrialResult]) -> list[str]:
    """Explain trials by another protocol: what each convention adds to the difference, and what was not followed."""
    shares: dict[str, dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
    unknown: dict[str, str] = {}
    translated = [trial for trial in trials if trial.translated_from]
    for trial in translated:
        assert trial.translation is not None
        for metric, own_shares in trial.translation.shares.items():
            for name, value in own_shares.items():
                shares[metric][name].append(value)
        unknown |= {f"{name}: {reason}": name for name, reason in trial.translation.unknown.items()}
    if not translated:
        return []
    own, now = translated[0].translated_from, protocol_of(translated[0].record.protocol)
    assert now is not None
    notes = [f"The renders of trials by {own}, measured by {now.id} ({now.source})."]
    for metric, parts in shares.items():
        facts = find(metric)
        assert facts is not None
        spec = f".{facts.decimals + 1}f"
        count = len(translated)
        means = {name: sum(values) / count for name, values in parts.items()}  # a trial without it has 0 of it
        listed = ", ".join(f"{signed(value, spec)} {name}" for name, value in means.items())
        notes.append(f"{facts.name} against {own}: {signed(sum(means.values()), spec)} ({listed}).")
    notes += [f"Not followed, {line}." for line in sorted(unknown)]
    return notes
