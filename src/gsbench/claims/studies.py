"""Studies for a meta-analysis, out of what others hand over: archives of gsbench, and result files of nerfbaselines.

A study is one source's mean difference of two arms in one metric, over the pairs of trials of each scene, as every
difference here (docs/verdict.md). Results of nerfbaselines
(https://github.com/nerfbaselines/nerfbaselines, ``*.json`` of its ``evaluate``) have no seeds, so its pairs are scenes.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import math
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsbench.analysis.cells import select_trials, with_variants
from gsbench.analysis.fairness import budget_words
from gsbench.analysis.judgement import Pairs, pair
from gsbench.analysis.results import Arm, TrialResult
from gsbench.analysis.statistics import student, t_interval
from gsbench.claims.archive import unpack_archive
from gsbench.claims.pooling import Study
from gsbench.errors import InputError
from gsbench.parsing import DamagedError, read_json, resolved
from gsbench.runs.declaration import Question
from gsbench.runs.hashing import sha256_of

NERFBASELINES = "nerfbaselines"
NERFBASELINES_METRICS = {"psnr": "psnr", "ssim": "ssim", "lpips_alex": "lpips", "lpips_vgg": "lpips_vgg"}  # our keys
ROUNDED = 2e-5  # nerfbaselines writes its means with five decimals

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Wanted:
    """The pooled question: names that ``arm`` and ``baseline`` go by in the sources, and our key of the metric.

    ``where``: only trials of archives with these values of settings count.
    """

    arm: tuple[str, ...]
    baseline: tuple[str, ...]
    metric: str
    where: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Found:
    """Studies of one source, what they say of themselves, and ``trials`` as marks: none is to be counted twice."""

    studies: tuple[Study, ...]
    notes: tuple[str, ...] = ()
    trials: frozenset[str] = frozenset()


def read_source(path: Path, wanted: Wanted, name: str = "") -> Found:
    """The studies in ``path``, one for each protocol, called ``name`` (default: as the file).

    Raises InputError, one line, where there is none.
    """
    read = _read_nerfbaselines if path.is_dir() else _read_archive
    return read(path, wanted, name or path.stem)


def _read_archive(path: Path, wanted: Wanted, name: str) -> Found:
    with tempfile.TemporaryDirectory() as folder:
        every = unpack_archive(path, Path(folder)).trials
        trials = with_variants(select_trials(every, wanted.where))
        studies, notes = [], []
        protocols = sorted({trial.record.protocol for trial in trials})
        for protocol in protocols:
            own = [trial for trial in trials if trial.record.protocol == protocol]
            groups = _groups(own, _pairs(own, wanted, path))
            for pairs in groups:
                told_apart = [protocol] * (len(protocols) > 1) + [pairs[0][0].init] * (len(groups) > 1)
                label = f"{name} ({', '.join(told_apart)})" if told_apart else name
                found = [
                    pair(own, Question(metric=wanted.metric, baseline=first, arm=second)) for first, second in pairs
                ]
                together = Pairs(tuple(row for one in found for row in one.rows))
                if not together.rows:
                    reason = next((f" ({line})" for one in found for line in one.left_out), "")
                    raise InputError(f"{path}: no trials can be paired in {wanted.metric}{reason}")
                test = student(together.differences)
                mean, interval = float(together.differences.mean()), None if test is None else test.interval()
                studies.append(Study(label, mean, interval, _conditions(protocol, wanted.metric), _budgets(own, pairs)))
                for (first, second), paired in zip(pairs, found, strict=True):
                    count = sum(len(row.seeds) for row in paired.rows)
                    notes.append(
                        f"{label}: {second} against {first}, {count} pairs of trials on "
                        f"{', '.join(paired.scenes)}; {_size(own)}"
                    )
                    notes += [f"{label}: left out, {line}" for line in paired.left_out]
        return Found(tuple(studies), tuple(notes), frozenset(map(_mark, trials)))


def _groups(trials: Sequence[TrialResult], pairs: Sequence[tuple[Arm, Arm]]) -> list[list[tuple[Arm, Arm]]]:
    """Group pairs into studies: all are one where each scene has one initialiser, else each is its own."""
    scenes = [{trial.scene for trial in trials if trial.arm in pair} for pair in pairs]
    disjoint = sum(map(len, scenes)) == len(set().union(*scenes))
    return [list(pairs)] if disjoint else [[pair] for pair in pairs]


def _pairs(trials: Sequence[TrialResult], wanted: Wanted, path: Path) -> list[tuple[Arm, Arm]]:
    """(baseline, arm) under each initialiser that has both; a name is that of a densifier, with its variant or not."""
    arms = sorted({trial.arm for trial in trials})

    def named(init: str, names: Sequence[str]) -> list[Arm]:
        own = [arm for arm in arms if arm.init == init]
        return [arm for arm in own if {str(replace(arm, init="")), arm.densify, str(arm)} & {*names}]

    found = []
    for init in sorted({arm.init for arm in arms}):
        ones, others = named(init, wanted.baseline), named(init, wanted.arm)
        if len(ones) > 1 or len(others) > 1:
            several = ones if len(ones) > 1 else others
            raise InputError(
                f"{path}: {' and '.join(map(str, several))} go by one name: choose trials with --where "
                "KEY=VALUE, or give the whole name of one"
            )
        if ones and others:
            found.append((ones[0], others[0]))
    if not found:
        raise InputError(
            f"{path} has no pair of {' or '.join(wanted.arm)} and {' or '.join(wanted.baseline)} (there are "
            f"{', '.join(map(str, arms))})"
        )
    return found


def _conditions(protocol: str, metric: str) -> dict[str, str]:
    return {"protocol": protocol, "metric": metric}


def _budgets(trials: Sequence[TrialResult], pairs: Sequence[tuple[Arm, Arm]]) -> str:
    """``20,000 Gaussians (governor)``: what limited the growth in these pairs of arms."""
    arms = {arm for pair in pairs for arm in pair}
    return " or ".join(sorted({budget_words(trial) or "not known" for trial in trials if trial.arm in arms}))


def _size(trials: Sequence[TrialResult]) -> str:
    """In which trials of archives may differ without being refused, for people to judge."""
    sizes = sorted({f"{size[0]}×{size[1]}" for trial in trials if (size := trial.record.resolution)})
    steps = sorted({f"{trial.record.iterations:,}" for trial in trials})
    versions = sorted({trial.record.versions.get("gsbench", "?") for trial in trials})
    return f"{' or '.join(steps)} iterations, {' or '.join(sizes)} px, gsbench {' or '.join(versions)}"


def _mark(trial: TrialResult) -> str:
    """Mark that tells a trial from every other: made again elsewhere, it has other seconds."""
    record = trial.record
    told = [trial.config_hash, trial.seed, record.hashes, record.seconds, dict(trial.metrics)]
    return sha256_of(told)


@dataclass(frozen=True)
class _Result:
    """One file of nerfbaselines."""

    method: str
    scene: str
    protocol: str
    metrics: Mapping[str, float]
    mark: str


def _read_nerfbaselines(folder: Path, wanted: Wanted, name: str) -> Found:
    """The files anywhere below ``folder``: one study for each protocol and data set, whose pairs are its scenes."""
    if wanted.where:
        raise InputError(f"{folder}: result files of nerfbaselines hold no settings to choose by (--where)")
    key = NERFBASELINES_METRICS.get(wanted.metric)
    if key is None:
        raise InputError(f"{folder}: nerfbaselines measures {', '.join(NERFBASELINES_METRICS)}, not {wanted.metric}")
    notes, results = [], []
    for file in sorted(folder.rglob("*.json")):
        try:
            results.append(_result(file))
        except InputError as error:
            notes.append(f"left out, {error}")
    studies = []
    for protocol in sorted({one.protocol for one in results}):
        own = [one for one in results if one.protocol == protocol]
        sides = [_by_scene(own, names, folder) for names in (wanted.baseline, wanted.arm)]
        scenes = [s for s in sorted(sides[0].keys() & sides[1].keys()) if all(key in side[s].metrics for side in sides)]
        if not scenes:
            continue
        differences = np.array([sides[1][scene].metrics[key] - sides[0][scene].metrics[key] for scene in scenes])
        several = len({one.protocol for one in results}) > 1
        label = f"{name} ({protocol})" if several else name
        studies.append(
            Study(label, float(differences.mean()), t_interval(differences), _conditions(protocol, wanted.metric))
        )
        notes.append(f"{label}: {len(scenes)} scenes ({', '.join(scenes)}), one training each; {protocol}")
    if not studies:
        reason = f"; {notes[0]}" if notes else ""
        raise InputError(
            f"{folder} has no result files of nerfbaselines in which {' or '.join(wanted.arm)} and "
            f"{' or '.join(wanted.baseline)} share a scene{reason}"
        )
    return Found(tuple(studies), tuple(notes), frozenset(one.mark for one in results))


def _by_scene(results: Sequence[_Result], names: Sequence[str], folder: Path) -> dict[str, _Result]:
    found: dict[str, _Result] = {}
    for one in results:
        if one.method not in names:
            continue
        if one.scene in found:
            raise InputError(
                f"{folder}: {one.scene} stands twice for {' or '.join(names)}: keep one file of each scene"
            )
        found[one.scene] = one
    return found


def _result(file: Path) -> _Result:
    """Read and check one file; its means must be those of its raw values, and these those that were hashed."""
    try:
        data = read_json(resolved(file))
        about = data["nb_info"]
        dataset = data.get("render_dataset_metadata") or about["dataset_metadata"]
        raw = {name: _floats(text) for name, text in data["metrics_raw"].items()}
        means = {name: float(np.mean(values)) for name, values in raw.items()}
        scene = f"{dataset.get('id') or dataset['name']}/{dataset['scene']}"
        protocol = f"{NERFBASELINES} {data.get('evaluation_protocol', 'default')}"
        result = _Result(str(about["method"]), scene, protocol, means, file_mark(raw))
        changed = data.get("metrics_sha256", result.mark) != result.mark
        for name, value in data.get("metrics", {}).items():
            changed |= name not in means or not math.isclose(value, means[name], rel_tol=ROUNDED, abs_tol=ROUNDED)
    except DamagedError:
        raise
    except (OSError, UnicodeDecodeError, ValueError, KeyError, TypeError, AttributeError, binascii.Error) as error:
        raise InputError(f"{file} is no result file of nerfbaselines ({error!r})") from None
    if changed or not all(map(math.isfinite, means.values())):
        raise InputError(f"{file} was changed: its means are not those of the values that it was written with")
    return result


def file_mark(raw: Mapping[str, Array]) -> str:
    """``metrics_sha256`` as nerfbaselines computes it: names and sorted float32 values in base64, line by line."""
    digest = hashlib.sha256()
    for name in sorted(raw):
        digest.update(name.lower().encode())
        digest.update(base64.b64encode(np.sort(raw[name]).astype("<f4").tobytes()))
        digest.update(b"\n")
    return digest.hexdigest()


def _floats(text: str) -> Array:
    values = np.frombuffer(base64.b64decode(text, validate=True), "<f4").astype(np.float64)
    if not len(values):
        raise ValueError("no values")
    return values
