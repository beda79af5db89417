"""The work of ``gsbench evaluate``: measuring renders of any program, and printing the values."""

import argparse
import json
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import torch

from gsbench.analysis.results import read_experiment
from gsbench.config.build import build_metrics
from gsbench.config.command_words import typed_permissions
from gsbench.config.compose import compose_one
from gsbench.errors import InputError
from gsbench.eval.evaluator import Evaluator, summarize
from gsbench.eval.facts import METRICS, further_keys
from gsbench.eval.options import EvalConfig
from gsbench.eval.pictures import PicturePair, check_pairs, measure
from gsbench.files import storage_errors
from gsbench.logs import progress
from gsbench.pipeline.parts import make_evaluator
from gsbench.renders.imported import Measured, check_destination, find_destination, import_trial
from gsbench.renders.sources import (
    ReferenceImages,
    find_reference_images,
    picture_names,
    pictures_in,
    reference_images_of,
    require_folder,
)
from gsbench.runs.code import PERMISSIONS
from gsbench.scene.names import Matching, match_by_order, match_pictures
from gsbench.system.programs import allow_modules
from gsbench.system.resources import available_threads, select_device
from gsbench.words import counted, some_of


def measure_folders(
    root: Path, truth: Path, settings: Sequence[str]
) -> list[dict[str, str | float]]:
    """The mean metrics of renders in ``root/METHOD/SCENE/SEED``, a row for each folder.

    The photographs of a scene are in ``truth/SCENE``. Raises InputError for other folders, and for
    pictures that do not match.
    """
    folders = sorted(folder for folder in root.glob("*/*/*") if folder.is_dir())
    if not folders:
        raise InputError(f"{root} has no folder METHOD/SCENE/SEED with pictures")
    rows: list[dict[str, str | float]] = []
    torch.set_num_threads(available_threads())
    with progress("evaluate") as report:
        for done, folder in enumerate(folders, 1):
            method, scene, seed = folder.relative_to(root).parts
            images = pictures_in(truth / scene, settings)
            pairs, _ = _pair_up(images, folder)
            check_pairs(pairs, str(folder))
            evaluator = _evaluator(images, None, settings)
            means = summarize(measure(pairs, evaluator), evaluator.unavailable)
            rows.append({"method": method, "scene": scene, "seed": seed} | means)
            report("folders", done, len(folders))
    return rows


def measure_renders(options: argparse.Namespace, runs: Path) -> None:
    """Measure the renders that the ``options`` of the verb name, and print the values."""
    renders = Path(options.renders).expanduser()
    require_folder(renders)
    primary = _asked_metric(options)
    if options.truth is None:
        raise InputError("--truth PLACE is needed: the photographs of the renders")
    truth = _reference_images(options, runs)
    destination = None
    if options.place is not None:
        destination = find_destination(options.place, options.scene, options.seed, truth, runs)
        check_destination(destination, truth, runs)
    pairs, matching = _pair_up(truth, renders, options.by_order)
    odd = check_pairs(pairs, options.renders)
    torch.set_num_threads(available_threads())
    evaluator = _evaluator(truth, options.protocol, options.settings)
    with progress("evaluate") as report:
        per_view = measure(pairs, evaluator, report)
    source = {
        "folder": str(renders.resolve()),
        "names matched": matching.rule or "as they are",
    } | ({"notes": "; ".join(found.line for found in odd)} if odd else {})
    measured = Measured(truth, pairs, per_view, evaluator, source)
    folder = None
    if destination is not None:
        with storage_errors(runs):
            folder = import_trial(destination, measured, runs, primary)
    if options.json:
        print(json.dumps(_as_dict(measured, matching, folder), indent=1))
    else:
        print("\n".join(_lines(measured, matching, folder)))


def _pair_up(
    truth: ReferenceImages, renders: Path, by_order: bool = False
) -> tuple[list[PicturePair], Matching]:
    match = match_by_order if by_order else match_pictures
    matching = match(list(truth.photographs), picture_names(renders))
    return [
        PicturePair(view, path, renders / matching.pairs[view], truth.masks.get(view))
        for view, path in truth.photographs.items()
    ], matching


SETTINGS = [entry.name for entry in fields(EvalConfig)]
# settings of an evaluation that renders of another program do not use
WITHOUT_EFFECT = ("eval.at", "eval.controls", "eval.regions")


def _asked_metric(options: argparse.Namespace) -> str:
    """The metric of the question (``eval.primary``), if it is typed, else "".

    Raises InputError for settings that have no effect on renders.
    """
    for word in options.settings:
        key, _, value = word.lstrip("+").partition("=")
        if key in WITHOUT_EFFECT:
            raise InputError(f"{word}: it has no effect on renders: leave it out")
        if key == "eval.primary" and options.place is None:
            raise InputError(f"{word}: a question is about a trial: add --as EXPERIMENT:ARM")
        if key == "eval.primary":
            return value
    return ""


def _reference_images(options: argparse.Namespace, runs: Path) -> ReferenceImages:
    """The photographs; those of a scene come from trials of the experiment in ``--as``, if any."""
    overrides = [
        word for word in options.settings if not word.startswith(("eval", f"{PERMISSIONS}="))
    ]
    experiment = runs / (options.place or "").partition(":")[0]
    if not overrides and options.place and not Path(options.truth).is_dir() and experiment.is_dir():
        trials = [trial for trial in read_experiment(experiment).trials if not trial.from_renders]
        if same_scene := next((trial for trial in trials if trial.scene == options.truth), None):
            return reference_images_of(same_scene)
    truth = find_reference_images(options.truth, options.settings, runs)
    if truth.init is not None and overrides:
        raise InputError(
            f"{overrides[0]}: the settings of {truth.what} are as they are; only eval.… can be "
            "set here"
        )
    return truth


def _evaluator(truth: ReferenceImages, protocol: str | None, settings: Sequence[str]) -> Evaluator:
    """The evaluator with the settings of the photographs' trial or scene, or with the command's."""
    allowed = typed_permissions([word for word in settings if word.startswith(f"{PERMISSIONS}=")])
    allow_modules(allowed)
    config: Mapping[str, Any] = truth.config
    if any(word.startswith("eval") for word in settings):
        of_evaluation = [word for word in settings if word.startswith(("eval", f"{PERMISSIONS}="))]
        config = compose_one(of_evaluation).values
    # A trial of an earlier version may have settings and metrics that are gone.
    chosen = {key: config["eval"][key] for key in SETTINGS if key in config["eval"]}
    chosen["more"] = [key for key in chosen.get("more", []) if key in further_keys()]
    chosen |= {} if protocol is None else {"protocol": protocol}
    own = build_metrics(chosen, list(allowed))
    chosen["primary"] = None  # nothing is judged here
    return make_evaluator(EvalConfig(**chosen), select_device(config.get("device", "auto")), own)


def _lines(measured: Measured, matching: Matching, folder: Path | None) -> list[str]:
    truth, evaluator, per_view = measured.truth, measured.evaluator, measured.per_view
    metrics = summarize(per_view, evaluator.unavailable)
    width = max(len(view) for view in ("mean", *per_view))
    facts = {entry.key: entry for entry in METRICS} | evaluator.own
    names = {key: facts[key].name for key in metrics}
    lines = [f"{counted(len(per_view), 'view')}: {truth.what}; protocol {evaluator.protocol.id}"]
    if matching.rule:
        lines.append(f"names matched {matching.rule}")
    if matching.left_out:
        lines.append(f"left out, without a photograph: {some_of(matching.left_out)}")
    lines.append("  ".join([" " * width, *names.values()]))
    for view, row in [*per_view.items(), ("mean", metrics)]:
        cells = [view.ljust(width)]
        for key, heading in names.items():
            cells.append(f"{row[key]:.{facts[key].decimals + 1}f}".rjust(len(heading)))
        lines.append("  ".join(cells))
    lines += [f"{key}: n/a, {evaluator.unavailable[key]}" for key in sorted(evaluator.awaited)]
    if folder is not None:
        lines.append(f"entered as {folder}")
    return lines


def _as_dict(measured: Measured, matching: Matching, folder: Path | None) -> dict[str, Any]:
    unavailable = measured.evaluator.unavailable
    return {
        "protocol": measured.evaluator.protocol.id,
        "metrics": summarize(measured.per_view, unavailable),
        "unavailable": unavailable,
        "views": measured.per_view,
        "pictures": dict(matching.pairs),
        "names_matched": matching.rule,
        "notes": measured.source.get("notes", ""),
        "left_out": list(matching.left_out),
        "entered": None if folder is None else str(folder),
    }
