"""The renders of trials under the conventions of other programs, and what of the difference each convention makes."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from gsbench.analysis.results import TrialResult, load_experiment
from gsbench.errors import InputError
from gsbench.eval.evaluator import Evaluator, quantize, summarize
from gsbench.eval.protocol import OTHERS, Protocol, get_protocol, protocol_of
from gsbench.files import write_json
from gsbench.gaussians.model import MAX_SH_DEGREE
from gsbench.gaussians.ply import read_ply
from gsbench.init.base import MODEL_FOLDER
from gsbench.pipeline.parts import Parts
from gsbench.pipeline.steps.scene import makers_of_views
from gsbench.pipeline.wiring import TrialSteps
from gsbench.runs.layout import GROUND_TRUTH, MASKS, POINT_CLOUD, PROTOCOLS, RENDERS, STORE, VIEWS
from gsbench.runs.store import Store
from gsbench.runs.translation_record import VERSION, Translation, Translations, made_of, read_translations
from gsbench.runs.trial_folder import TrialFolder
from gsbench.scene.images import read_image
from gsbench.scene.load import load_scene
from gsbench.scene.masks import Mask, read_mask
from gsbench.scene.names import png_name
from gsbench.scene.types import Scene
from gsbench.system.resources import available_threads
from gsbench.view.trials import find_trial
from gsbench.words import signed

log = logging.getLogger(__name__)

SHARED_METRICS = ("psnr", "ssim")  # whose difference is shared; LPIPS by another network is another metric
WITHOUT_EFFECT = {"psnr": ("SSIM padding",)}
ROUNDING_TOLERANCE = 1  # 8-bit levels by which a render that is made again may differ from its file

Run = frozenset[str]  # the conventions that are those of the other program
Picture = NDArray[np.uint8]
Pictures = Mapping[str, Picture]  # by view


@dataclass
class Material:
    """The images that a trial's test views are measured from, by view, [H, W, 3] each.

    ``renders`` and ``photographs`` are those of the trial's files, ``exact`` the renders before rounding (float32, in
    [0, 1]), ``shrunk`` gives the photographs as a protocol shrinks them. The last two raise InputError for what cannot
    be had. ``masks`` are those of the views that ignore some pixels.
    """

    renders: Pictures
    photographs: Pictures
    exact: Callable[[], Mapping[str, NDArray[np.float32]]]
    shrunk: Callable[[Protocol], Pictures]
    masks: Mapping[str, Mask] = field(default_factory=dict)


def translate_trials(place: str, protocol: str | None, runs: Path) -> None:
    """Measure the trials of an experiment, or one trial, by ``protocol`` or all of `OTHERS`; keep and print it."""
    torch.set_num_threads(available_threads())
    trials = [find_trial(place, runs)] if ":" in place else list(load_experiment(runs, place).trials)
    wanted = list(OTHERS.values()) if protocol in (None, "all") else [get_protocol(str(protocol))]
    for trial in trials:
        base = protocol_of(trial.record.protocol)
        if base is None:
            raise InputError(f"{trial.label} was measured by {trial.record.protocol}, which is not known here")
        material = material_of(trial, runs)
        found = {one.id: translate(material, base, one, _lpips_evaluator(trial)) for one in wanted}
        _keep(trial, found)
        print(
            f"{trial.label}, measured by {base.id}: PSNR {trial.metrics['psnr']:.2f}, SSIM {trial.metrics['ssim']:.4f}"
        )
        for name, one in found.items():
            print(f"  {name}: {in_words(one)}")


def translate(
    material: Material, base: Protocol, protocol: Protocol, make: Callable[[Protocol], Evaluator]
) -> Translation:
    """The metrics of ``material`` by ``protocol``, and the shares of its conventions in the change from ``base``.

    ``make`` gives the evaluator that also computes the LPIPS of ``protocol``.
    """
    unknown: dict[str, str] = {}
    photographs, masks, exact = material.photographs, material.masks, None
    try:
        photographs = material.shrunk(protocol)
    except InputError as error:
        unknown["resampling"] = str(error)
    if not protocol.eight_bit:
        try:
            exact = material.exact()
        except InputError as error:
            unknown["rounding"] = str(error)
    switches: dict[str, dict[str, Any]] = {
        "resampling": {"photographs": photographs} if photographs is not material.photographs else {},
        "rounding": {"renders": exact, "eight_bit": False} if exact is not None else {},
        "SSIM padding": {"ssim_padding": protocol.ssim_padding} if protocol.ssim_padding != base.ssim_padding else {},
        "crop": {"crop": protocol.crop} if protocol.crop != base.crop else {},
    }
    used = [name for name, changes in switches.items() if changes]

    @cache
    def values(run: Run) -> dict[str, float]:
        state: dict[str, Any] = {"renders": material.renders, "photographs": material.photographs}
        for name in used:
            state |= switches[name] if name in run else {}
        renders, truths = state.pop("renders"), state.pop("photographs")
        evaluator = Evaluator(replace(base, **state), lpips=(), flip=False)
        per_view = {
            view: evaluator.evaluate_view(render, truths[view], masks.get(view)) for view, render in renders.items()
        }
        return summarize(per_view, evaluator.unavailable)

    shares = {}
    for metric in SHARED_METRICS:
        matter = [name for name in used if name not in WITHOUT_EFFECT.get(metric, ())]
        runs = [Run(chosen) for size in range(len(matter) + 1) for chosen in combinations(matter, size)]
        if all(metric in values(run) for run in runs):
            shares[metric] = shapley(matter, {run: values(run)[metric] for run in runs})
    final = make(replace(protocol, eight_bit=protocol.eight_bit or exact is None))
    renders = material.renders if exact is None else exact
    per_view = {
        view: final.evaluate_view(render, photographs[view], masks.get(view)) for view, render in renders.items()
    }
    return Translation(
        metrics=summarize(per_view, final.unavailable),
        unavailable=dict(final.unavailable),
        shares=shares,
        unknown=unknown,
    )


def shapley(switches: Sequence[str], values: Mapping[Run, float]) -> dict[str, float]:
    """The share of each switch in ``values[all] - values[none]``, from the values of all 2^n sets (Shapley 1953).

    It is the mean, over all orders of turning switches on, of what one adds when its turn comes. The shares add up to
    the whole difference, and interactions are split evenly among those that have them.
    """
    count, shares = len(switches), {}
    for switch in switches:
        others = [name for name in switches if name != switch]
        total = 0.0
        for size in range(count):
            weight = 1 / (count * math.comb(count - 1, size))
            for chosen in combinations(others, size):
                total += weight * (values[frozenset((*chosen, switch))] - values[frozenset(chosen)])
        shares[switch] = total
    return shares


def material_of(trial: TrialResult, runs: Path) -> Material:
    """The test views of a finished trial; what is in its folder is read now, the rest when it is asked for."""
    names = sorted(path.name for path in (trial.path / RENDERS).glob("*.png"))
    if not names:
        raise InputError(f"{trial.label} holds no renders")
    renders, photographs = (
        {name: read_image(trial.path / folder / name) for name in names} for folder in (RENDERS, GROUND_TRUTH)
    )

    @cache
    def source() -> tuple[Parts, TrialSteps]:
        config = TrialFolder(trial.path).configuration() | {"runs": str(runs)}
        if trial.from_renders:
            raise InputError("renders of another program are what they are")
        parts = Parts(config)
        steps = TrialSteps(parts, Store(runs / STORE))
        for step in steps.steps():
            if steps.store.find(step) is None:
                raise InputError(f"the stage {step.stage.name} of the trial is not in the store any more")
        return parts, steps

    @cache
    def exact() -> Mapping[str, NDArray[np.float32]]:
        parts, steps = source()
        if not (trial.path / POINT_CLOUD).is_file():
            raise InputError("the renders are 8-bit files and the model is not there")
        model = read_ply(trial.path / POINT_CLOUD, parts.device)
        background = torch.tensor(list(parts.train.background), device=parts.device)  # [3]
        found = {}
        for view in steps.views.scene.test:
            with torch.no_grad():
                image = parts.rasterizer.render(model, view.camera, MAX_SH_DEGREE, background).image.clamp(0, 1)
            name = png_name(view.name)
            apart = np.abs(quantize(image).cpu().numpy().astype(int) - renders[name]).max()
            if apart > ROUNDING_TOLERANCE:
                raise InputError(f"made again, the render of {view.name} differs from its file by {apart} levels")
            found[name] = image.cpu().numpy()
        return found

    @cache
    def shrunk(protocol: Protocol) -> Pictures:
        _, steps = source()
        return resampled(steps, protocol, photographs)

    there = {path.name: read_mask(path) for path in sorted((trial.path / MASKS).glob("*.png"))}
    return Material(renders, photographs, exact, shrunk, there)


def resampled(steps: TrialSteps, protocol: Protocol, photographs: Pictures) -> Pictures:
    """The test photographs at the size of ``photographs``, made smaller as ``protocol`` does it.

    They are ``photographs`` themselves where it would do nothing else. Raises InputError where the files that it
    starts from are not there.
    """
    views, options = steps.views, steps.views.options
    capture, downscale, longest = views.capture, options.downscale, options.max_size
    folder = None if options.path is None else Path(options.path).expanduser() / "images"
    if protocol.full_size and options.images not in (None, "images") and folder is not None:
        if capture.masks:
            raise InputError(f"{protocol.name} shrinks photographs of the full size, and masks are of {options.images}")
        if missing := [name for name in capture.image_names if not (folder / name).is_file()]:
            raise InputError(
                f"{protocol.name} shrinks photographs of the full size, and {folder / missing[0]} is missing"
            )
        capture = replace(capture, images=folder, fingerprint=f"{capture.fingerprint}-full-size")
        downscale, longest = 1, max(next(iter(photographs.values())).shape)
    elif protocol.shrinking is None or protocol.shrinking == options.resample:
        return photographs
    assert protocol.shrinking is not None
    scene = load_scene(
        capture,
        views.store.path(views.init) / MODEL_FOLDER,
        views.store.root / VIEWS,
        downscale=downscale,
        max_size=longest,
        resample=protocol.shrinking,
        principal_point=options.principal_point,
        made_by=makers_of_views(),
    )
    return _same_views(scene, photographs, protocol)


def _same_views(scene: Scene, photographs: Pictures, protocol: Protocol) -> Pictures:
    found = {png_name(view.name): view.image for view in scene.test}
    for name, photograph in photographs.items():
        if name not in found or found[name].shape != photograph.shape:
            raise InputError(f"shrunk as {protocol.name} does it, {name} is not of the size of the render")
    if all(np.array_equal(found[name], photograph) for name, photograph in photographs.items()):
        return photographs  # nothing was shrunk
    return {name: found[name] for name in photographs}


def in_words(one: Translation) -> str:
    """``PSNR 27.41 (+0.31: resampling +0.27, rounding +0.04), SSIM …; rounding: not known, …``"""
    parts = []
    for metric, digits in (("psnr", 2), ("ssim", 4)):
        if metric not in one.metrics:
            continue
        shares = one.shares.get(metric, {})
        spec = f".{digits + 1}f"
        listed = ", ".join(f"{name} {signed(value, spec)}" for name, value in shares.items())
        change = f" ({signed(sum(shares.values()), spec)}: {listed})" if shares else " (no other convention)"
        parts.append(f"{metric.upper()} {one.metrics[metric]:.{digits}f}{change}")
    parts += [f"LPIPS {value:.4f}" for key, value in one.metrics.items() if key.startswith("lpips")]
    unknown = "".join(f"; {name} as it was, since {reason}" for name, reason in one.unknown.items())
    return f"{', '.join(parts)}{unknown}"


def _lpips_evaluator(trial: TrialResult) -> Callable[[Protocol], Evaluator]:
    """Makes the evaluator of a protocol with its LPIPS, if the trial asked for any LPIPS."""
    asked = bool(trial.config.get("eval.lpips"))
    weights = trial.config.get("eval.weights")
    folder = None if weights is None else Path(str(weights)).expanduser()

    def make(protocol: Protocol) -> Evaluator:
        lpips = (protocol.lpips,) if protocol.lpips and asked else ()
        return Evaluator(protocol, "cpu", lpips, False, folder, bool(trial.config.get("eval.download", True)))

    return make


def _keep(trial: TrialResult, found: Mapping[str, Translation]) -> None:
    """Write what was found beside what the trial's folder has of other protocols, if that is of the same renders."""
    known = read_translations(trial.path, trial.record)
    kept = Translations(version=VERSION, made_of=made_of(trial.record), protocols=known | dict(found))
    write_json(trial.path / PROTOCOLS, kept.to_json())
