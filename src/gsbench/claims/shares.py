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
from gsbench.claims.archive import read_configuration, unpack_archive, without_paths, write_archive
from gsbench.errors import InputError
from gsbench.files import write_text
from gsbench.runs.code import changed_files
from gsbench.runs.declaration import CLAIMS, DeclaredPlan, merged_record, read_plans, standing_plan
from gsbench.runs.hashing import determining, sha256_of
from gsbench.runs.layout import DECLARED
from gsbench.runs.source import sources_of
from gsbench.runs.stages import STAGES
from gsbench.words import some_of

ONE_CODE = "check out one commit on all machines"
ONE_DATA = "copy the scene's folder from one machine to the others, or leave the scene to one of them (--scene)"
ONE_PLAN = (
    "give all machines one file; one that lacks a scene names those that it runs (--scene), checks and exports again"
)
PATHS = ("scene", "init")  # groups whose ``path`` says where somebody's files lie
PLACE = 3  # folders of a trial within its experiment

FindTrial = Callable[[Mapping[str, Any]], TrialResult | None]  # by the whole configuration of a trial


@dataclass(frozen=True)
class Shares:
    """Trials of a check from archives: the plan that they were run under, and all ``plans`` of claims of theirs.

    ``sources`` are the archives by name, each with the function that finds a trial of it by its configuration on any
    machine.
    """

    declared: DeclaredPlan
    plans: tuple[DeclaredPlan, ...]
    sources: tuple[tuple[str, FindTrial], ...]


def read_shares(archives: Sequence[Path], folder: Path, name: str) -> Shares:
    """The shares of the check ``name``, unpacked into the empty folder ``folder``.

    Raises InputError, one line, for a damaged archive, one of another experiment or without a plan of claims, and where
    archives were made under several plans.
    """
    shares = _unpacked(archives, folder, name)
    plans = {str(file): read_plans(share.folder, CLAIMS) for file, share in zip(archives, shares, strict=True)}
    for file, own in plans.items():
        if not own:
            raise InputError(f"{file}: no plan of claims was declared in it: it is no archive of a gsbench check")
    check_one_plan({file: own[-1] for file, own in plans.items()})
    every = tuple(sorted((plan for own in plans.values() for plan in own), key=lambda plan: plan.time))
    sources = tuple((str(file), _finder(file, share)) for file, share in zip(archives, shares, strict=True))
    return Shares(standing_plan(every), every, sources)


def gather(archives: Sequence[Path], folder: Path, name: str = "") -> Experiment:
    """Lay the trials of ``archives`` together into the empty folder ``folder``, and read them as one experiment.

    It is the experiment ``name``, or that of the first archive. Raises InputError as `read_shares` does, but for a plan
    that is absent, and for a trial that stands in two archives with unlike results.
    """
    shares = _unpacked(archives, folder, name)
    home = folder / "together" / shares[0].name
    home.mkdir(parents=True)
    plans = {str(file): read_plans(share.folder, CLAIMS) for file, share in zip(archives, shares, strict=True)}
    check_one_plan({file: own[-1] for file, own in plans.items() if own})
    known: dict[str, tuple[TrialResult, Path]] = {}
    for file, share in zip(archives, shares, strict=True):
        for key, trial in _by_identity(file, share).items():
            other, where = known.setdefault(key, (trial, file))
            if len(trial.metrics) > len(other.metrics):
                known[key] = trial, file
            if not same_training(trial, other):
                raise InputError(
                    f"{trial.label} stands in {where} and in {file} with other results: it was trained twice, as after "
                    "a kill between the two trials of a pair. No one archive can hold both: hand both over, and "
                    "gsbench check --from takes each pair from the one that has it whole"
                )
    for trial, _ in known.values():
        place = home.joinpath(*trial.path.parts[-PLACE:])
        place.parent.mkdir(parents=True, exist_ok=True)
        trial.path.rename(place)
    if declared := merged_record(share.folder for share in shares):
        write_text(home / DECLARED, declared)
    return read_experiment(home)


def _unpacked(archives: Sequence[Path], folder: Path, name: str) -> list[Experiment]:
    """The archives as experiments, of one name: ``name``, or that of the first."""
    shares = [unpack_archive(file, folder / str(k)) for k, file in enumerate(archives)]
    for file, share in zip(archives, shares, strict=True):
        if share.name != (name or shares[0].name):
            raise InputError(
                f"{file} is of the experiment {share.name}, not of {name or shares[0].name}: shares are of one"
            )
    return shares


def _by_identity(file: Path, share: Experiment) -> dict[str, TrialResult]:
    found: dict[str, TrialResult] = {}
    for trial in share.trials:
        try:
            other = found.setdefault(identity(read_configuration(trial)), trial)
        except InputError as error:
            raise InputError(f"{file}: {trial.label}: {error}") from None
        if other is not trial:
            raise InputError(
                f"{file} holds one trial twice, as {other.label} and {trial.label}, as where photographs were moved "
                "between: remove one of the folders, and export again"
            )
    return found


def _finder(file: Path, share: Experiment) -> FindTrial:
    trials = _by_identity(file, share)
    return lambda values: trials.get(identity(values))


def check_one_plan(standing: Mapping[str, DeclaredPlan]) -> None:
    """Raise InputError where the plans that stand in several places (by name) are not one."""
    if len({plan.hash for plan in standing.values()}) > 1:
        listed = "; ".join(f"{place} {plan.hash[:12]} on {_scenes(plan)}" for place, plan in standing.items())
        raise InputError(f"not one plan was declared: {listed}: {ONE_PLAN}")


def check_plan_keeps(ours: DeclaredPlan, theirs: DeclaredPlan, place: str) -> None:
    """Raise InputError where ``theirs``, of archives, would drop scenes of ``ours``, the same plan but for these."""
    if {**ours.plan, "tested": None} == {**theirs.plan, "tested": None} and not tested(ours) <= tested(theirs):
        check_one_plan({"here": ours, place: theirs})


def tested(plan: DeclaredPlan) -> set[tuple[str, str]]:
    """Return which claims were to be tested on which scenes."""
    kept = plan.plan.get("tested")
    lists = (
        {claim: scenes for claim, scenes in kept.items() if isinstance(scenes, list)} if isinstance(kept, dict) else {}
    )
    return {(str(claim), str(scene)) for claim, scenes in lists.items() for scene in scenes}


def _scenes(plan: DeclaredPlan) -> str:
    return some_of(sorted({scene for _, scene in tested(plan)})) or "no scene"


def check_alike(trials: Sequence[TrialResult]) -> None:
    """Raise InputError where trials whose mean is taken were made by unlike code, or of unlike photographs."""
    for part, versions in differing_code(trials).items():
        raise InputError(f"the trials were made by unlike code, {describe_code(part, versions)}: {ONE_CODE}")
    for group in by_key(trials, lambda trial: identity(read_configuration(trial) | {"seed": 0})).values():
        if len({trial.record.hashes.get("data") for trial in group}) > 1:
            raise InputError(f"{group[0].scene}: seeds were trained on unlike photographs or models: {ONE_DATA}")


def check_code(trial: TrialResult, values: Mapping[str, Any]) -> None:
    """Raise InputError unless ``trial`` was made by the code of this machine; ``values`` is its configuration here."""
    code = trial.record.code
    changed = changed_files(code.files)
    changed += [target for target, digest in sources_of(values).items() if code.sources.get(target) != digest]
    changed += [f"stage {one.name}" for one in STAGES if code.stages.get(one.name, one.version) != one.version]
    if changed:
        made_by = f", commit {code.commit[:12]}" if code.commit else ""
        raise InputError(f"{trial.label} was made by other code ({some_of(changed)}{made_by}): {ONE_CODE}")


def check_photographs(trial: TrialResult, data: str | None) -> None:
    """Raise InputError unless ``trial`` was made of the photographs with the fingerprint ``data``; None: not known."""
    if data is not None and data != trial.record.hashes.get("data"):
        raise InputError(f"{trial.scene}: photographs or their model are not those of {trial.label}: {ONE_DATA}")


def same_training(one: TrialResult, other: TrialResult) -> bool:
    """Return whether both are of one training, as its seconds tell, and agree in each metric that both have.

    One that was evaluated again, when weights had come, has more metrics; its photographs may lie elsewhere by now.
    """
    told = [(trial.record.seconds.get("train"), trial.record.num_gaussians) for trial in (one, other)]
    shared = one.metrics.keys() & other.metrics.keys()
    return told[0] == told[1] and all(one.metrics[name] == other.metrics[name] for name in shared)


def merge(archives: Sequence[Path], name: str, out: Path) -> list[str]:
    """Write one archive of the experiment ``name``, with the trials of all ``archives``; raises as `gather` does.

    Returns a line for each trial that is left out, with why.
    """
    with TemporaryDirectory() as folder:
        return write_archive(gather(archives, Path(folder), name), out)


def identity(values: Mapping[str, Any]) -> str:
    """Return the hash of a trial's seed and of the settings of its result, the same on any machine."""
    kept = without_paths(determining(values))
    for group in PATHS:
        if isinstance(kept.get(group), dict) and kept[group].get("path"):
            kept[group] = kept[group] | {"path": PurePath(str(kept[group]["path"])).name}
    return sha256_of([values["seed"], kept])
