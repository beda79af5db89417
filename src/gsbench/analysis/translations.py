"""Trials as the conventions of another program measure their renders, from what ``gsbench evaluate`` kept."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from gsbench.analysis.results import Experiment, TrialResult
from gsbench.errors import InputError
from gsbench.eval.facts import find
from gsbench.eval.protocol import get_protocol
from gsbench.files import read_object
from gsbench.runs.layout import PROTOCOLS
from gsbench.words import signed

TRANSLATED = "translated_from"  # in ``data`` of such a trial: the protocol of the trial itself
SHARES = "translation"


def by_protocol(experiment: Experiment, name: str) -> Experiment:
    """The experiment with its trials' metrics by the protocol ``name``; raises InputError where one lacks them."""
    wanted = get_protocol(name).id
    return replace(experiment, trials=tuple(_translated(trial, wanted) for trial in experiment.trials))


def _translated(trial: TrialResult, wanted: str) -> TrialResult:
    own = str(trial.data["protocol"])
    if own == wanted:
        return trial
    record = read_object(trial.path / PROTOCOLS)
    hashes = trial.data.get("hashes", {})
    found: Any = record.get("protocols", {}).get(wanted)
    if record.get("made_of") != (hashes.get("evaluate") or hashes.get("config")) or not isinstance(found, dict):
        raise InputError(
            f"{trial.label} was not measured by {wanted}: gsbench evaluate {trial.experiment} "
            f"--protocol {wanted.rpartition('-')[0]}"
        )
    data = dict(trial.data) | {"protocol": wanted, "metrics": found["metrics"], TRANSLATED: own, SHARES: found}
    return replace(trial, metrics=found["metrics"], unavailable=found["unavailable"], data=data)


def translation_notes(trials: Sequence[TrialResult]) -> list[str]:
    """For trials by another protocol: what of the difference each convention makes, and what could not be followed."""
    shares: dict[str, dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
    unknown: dict[str, str] = {}
    translated = [trial for trial in trials if TRANSLATED in trial.data]
    for trial in translated:
        found: Mapping[str, Any] = trial.data[SHARES]
        for metric, parts in found["shares"].items():
            for name, value in parts.items():
                shares[metric][name].append(value)
        unknown |= {f"{name}: {reason}": name for name, reason in found["unknown"].items()}
    if not translated:
        return []
    data, notes = translated[0].data, []
    source = get_protocol(str(data["protocol"]).rpartition("-")[0]).source
    notes.append(f"The renders of trials by {data[TRANSLATED]}, measured by {data['protocol']} ({source}).")
    for metric, parts in shares.items():
        facts = find(metric)
        assert facts is not None
        spec = f".{facts.decimals + 1}f"
        count = len(translated)
        means = {name: sum(values) / count for name, values in parts.items()}  # a trial without it has 0 of it
        listed = ", ".join(f"{signed(value, spec)} {name}" for name, value in means.items())
        notes.append(f"{facts.name} against {data[TRANSLATED]}: {signed(sum(means.values()), spec)} ({listed}).")
    notes += [f"Not followed, {line}." for line in sorted(unknown)]
    return notes
