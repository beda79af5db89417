"""Shares of one experiment: archives of trials that several machines, or one machine at several times, have run.

Trials are told apart by seed and settings, since folders differ from machine to machine. One that two shares hold with
unlike results is refused, so that nobody chooses the better of two trainings.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath
from tempfile import TemporaryDirectory
from typing import Any

from gsbench.analysis.cells import by_key
from gsbench.analysis.differences import describe_code, differing_code
from gsbench.analysis.results import Experiment, TrialResult, read_experiment
from gsbench.claims.archive import read_configuration, unpack_archive, write_archive
from gsbench.errors import InputError
from gsbench.files import write_text
from gsbench.runs.code import changed_files
from gsbench.runs.declaration import DeclaredPlan, merged_record, read_plans
from gsbench.runs.hashing import determining, sha256_of
from gsbench.runs.layout import DECLARED
from gsbench.runs.source import sources_of
from gsbench.words import some_of

ONE_CODE = "check out one commit on all machines"
ONE_DATA = "copy the scene's folder from one machine to the others, or leave the scene to one of them (--scene)"
PATHS = ("scene", "init")  # groups whose ``path`` says where somebody's files lie

FindTrial = Callable[[Mapping[str, Any]], TrialResult | None]  # by the whole configuration of a trial


@dataclass(frozen=True)
class Shares:
    """Trials of a check from archives: the plan that they were run under, all ``plans`` of claims of their experiment,
    and ``find``, which finds a trial by its configuration on any machine.
    """

    declared: DeclaredPlan
    plans: tuple[DeclaredPlan, ...]
    find: FindTrial


def read_shares(archives: Sequence[Path], folder: Path) -> Shares:
    """The shares of a check, unpacked into the empty folder ``folder``.

    Raises InputError as `gather` does, where no plan of claims was declared, and where trials whose mean would be taken
    were made by unlike code or of unlike photographs.
    """
    experiment = gather(archives, folder)
    plans = tuple(plan for plan in read_plans(experiment.folder) if not plan.kind)
    if not plans:
        raise InputError(
            f"{_names(archives)}: no plan of claims was declared in it: it is no archive of a gsbench check"
        )
    _check_alike(experiment.trials)
    trials = {identity(read_configuration(trial)): trial for trial in experiment.trials}
    return Shares(plans[-1], plans, lambda values: trials.get(identity(values)))


def gather(archives: Sequence[Path], folder: Path, name: str = "") -> Experiment:
    """Lay the trials of ``archives`` together into the empty folder ``folder``, and read them as one experiment.

    It is the experiment ``name``, or that of the first archive. Raises InputError, one line, for a damaged archive,
    one of another experiment, and a trial that stands in two of them with unlike results.
    """
    shares = [unpack_archive(file, folder / str(k)) for k, file in enumerate(archives)]
    home = folder / "together" / (name or shares[0].name)
    home.mkdir(parents=True)
    known: dict[str, tuple[TrialResult, Path]] = {}
    for file, share in zip(archives, shares, strict=True):
        if share.name != home.name:
            raise InputError(f"{file} is of the experiment {share.name}, not of {home.name}: shares are of one")
        for trial in share.trials:
            other, where = known.setdefault(identity(read_configuration(trial)), (trial, file))
            if other is trial:
                place = home / trial.path.relative_to(share.folder)
                place.parent.mkdir(parents=True, exist_ok=True)
                trial.path.rename(place)
            elif trial.record != other.record:
                raise InputError(
                    f"{trial.label} stands in {where} and in {file} with other results: it was trained twice; keep one "
                    "of the archives, or let gsbench make one of them again without it"
                )
    if declared := merged_record(share.folder for share in shares):
        write_text(home / DECLARED, declared)
    return read_experiment(home)


def _check_alike(trials: Sequence[TrialResult]) -> None:
    for part, versions in differing_code(trials).items():
        raise InputError(f"the archives hold trials by unlike code, {describe_code(part, versions)}: {ONE_CODE}")
    for group in by_key(trials, lambda trial: identity(read_configuration(trial) | {"seed": 0})).values():
        if len({trial.record.hashes.get("data") for trial in group}) > 1:
            raise InputError(f"{group[0].scene}: seeds were trained on unlike photographs or models: {ONE_DATA}")


def check_as_here(trial: TrialResult, values: Mapping[str, Any], data: str | None) -> None:
    """Raise InputError unless ``trial``, of a share, is what code and photographs of this machine would make of it.

    ``values`` is its configuration here, ``data`` the fingerprint of its photographs, None where nobody knows it yet.
    """
    code = trial.record.code
    changed = changed_files(code.files)
    changed += [target for target, digest in sources_of(values).items() if code.sources.get(target) != digest]
    if changed:
        made_by = f", commit {code.commit[:12]}" if code.commit else ""
        raise InputError(f"{trial.label} was made by other code ({some_of(changed)}{made_by}): {ONE_CODE}")
    if data is not None and data != trial.record.hashes.get("data"):
        raise InputError(f"{trial.scene}: photographs or their model are not those of {trial.label}: {ONE_DATA}")


def merge(archives: Sequence[Path], name: str, out: Path) -> None:
    """Write one archive of the experiment ``name``, with the trials of all ``archives``; raises as `gather` does."""
    with TemporaryDirectory() as folder:
        write_archive(gather(archives, Path(folder), name), out)


def identity(values: Mapping[str, Any]) -> str:
    """Return the hash of a trial's seed and of the settings of its result, the same on any machine."""
    kept = determining(values)
    for group in PATHS:
        if isinstance(kept.get(group), dict) and kept[group].get("path"):
            kept[group] = kept[group] | {"path": PurePath(str(kept[group]["path"])).name}
    return sha256_of([values["seed"], kept])


def _names(archives: Sequence[Path]) -> str:
    return ", ".join(map(str, archives))
