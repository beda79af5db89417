"""The origin of one number in a table."""

from collections.abc import Sequence
from pathlib import Path

from gsbench.analysis.cells import check_averageable, make_cell, swept_settings
from gsbench.analysis.differences import short_version
from gsbench.analysis.quantities import Quantity, quantity
from gsbench.analysis.results import Experiment, TrialResult, load_experiment
from gsbench.analysis.tables import format_cell
from gsbench.errors import InputError
from gsbench.runs.code import AS_RELEASED
from gsbench.words import some_of

ADDRESS = "EXPERIMENT:SCENE:METRIC:ARM, such as table1:garden:lpips:volumetric or demo:courtyard:psnr:sfm-adc"


def explain_cell(address: str, runs: Path) -> str:
    """Plain text about the cell at ``address``; raises ``InputError`` if there is no such cell."""
    parts = address.split(":")
    if len(parts) != 4 or not all(parts):
        raise InputError(f"{address!r} is not {ADDRESS}")
    name, scene, metric, arm = parts
    experiment = load_experiment(runs, name)
    trials = _trials_at(experiment, scene, arm)
    shown = quantity(metric, trials)
    variants = swept_settings(trials)
    if variants:
        raise InputError(f"{address} names several cells, which differ in {', '.join(variants)}")
    check_averageable(trials, f"scene={scene} {arm}")
    expected = len(experiment.seeds)
    cell = make_cell(trials, shown, [scene], expected)
    lines = [
        f"{shown.name} of {trials[0].init}-{trials[0].densify} on {scene} in experiment {name}",
        f"  {format_cell(cell, shown)}: mean ± deviation (n - 1) over {cell.count} of {expected} trials",
    ]
    if cell.reason:
        lines.append(f"  not available: {cell.reason}")
    lines += ["", "Conditions"] + [f"  {key}: {value}" for key, value in trials[0].conditions.items()]
    lines += _trials_lines(trials, shown)
    left_out = [line for line in experiment.warnings if line.startswith(f"{name}/{scene}/") and arm in line]
    if left_out:
        lines += ["", "Left out", *(f"  {line}" for line in left_out)]
    return "\n".join(lines)


def _trials_at(experiment: Experiment, scene: str, arm: str) -> list[TrialResult]:
    """The trials of a scene and an arm: ``<init>-<densify>``, or the densifier alone if only one arm has it."""
    of_scene = [trial for trial in experiment.trials if trial.scene == scene]
    if not of_scene:
        scenes = ", ".join(sorted({trial.scene for trial in experiment.trials}))
        raise InputError(f"experiment {experiment.name!r} has no scene {scene!r}; it has {scenes}")
    arms = sorted({(trial.init, trial.densify) for trial in of_scene})
    chosen = [(init, densify) for init, densify in arms if arm in (f"{init}-{densify}", densify)]
    if len(chosen) != 1:
        names = ", ".join(f"{init}-{densify}" for init, densify in arms)
        raise InputError(f"{arm!r} names {len(chosen)} arms of {scene}; choose one of {names}")
    return [trial for trial in of_scene if (trial.init, trial.densify) == chosen[0]]


def _trials_lines(trials: Sequence[TrialResult], shown: Quantity) -> list[str]:
    """The value and the origin of each trial; a line that equals the previous trial's is not repeated."""
    lines = ["", "Trials"]
    previous: dict[str, str] = {}
    for trial in trials:
        value, origin = shown.read(trial), _origin(trial)
        lines.append(f"  seed {trial.seed}: {'n/a' if value is None else f'{value:.6g}'}")
        lines += [f"    {label:<9} {text}" for label, text in origin.items() if previous.get(label) != text]
        previous = previous | origin
    return lines


def _origin(trial: TrialResult) -> dict[str, str]:
    """The folder of a trial, its counts, hashes, and the programs that made it, by label."""
    record = trial.record
    if trial.from_renders and not trial.program:
        counts = ", ".join(f"{key} {value}" for key, value in record.renders.items())
    elif trial.from_renders:
        counts = "its own renders"
    else:
        counts = f"{record.num_gaussians or 0:,} from {record.num_init_points or 0:,} points"
    origin = {"folder": str(trial.path), "Gaussians": counts}
    origin["views"] = f"{'?' if record.test_views is None else record.test_views} for testing"
    origin |= {key: str(value) for key, value in record.hashes.items() if key not in trial.conditions}
    if record.trained_by is not None:
        origin["program"] = f"{record.trained_by.version}: {' '.join(record.trained_by.command)}"
    if machine := trial.machine:
        origin["machine"] = machine
    if trial.code:
        origin["code"] = ", ".join(f"{part} {short_version(version)}" for part, version in trial.code.items())
    if record.code.commit:
        origin["commit"] = f"{record.code.commit}{', edited' if record.code.edited else ''}"
    edited = [name.removeprefix("gsbench's ") for name, state in trial.rooms.items() if state != AS_RELEASED]
    if edited and len(edited) < len(trial.rooms):  # before the first release all rooms count as edited
        origin["edited"] = f"since the last release: {some_of(edited)}"
    origin["versions"] = ", ".join(f"{key} {value}" for key, value in record.versions.items())
    return origin
