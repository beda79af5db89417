"""``gsbench export``: a trained model, an initial cloud, or an experiment's results, for others."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from gsbench.analysis.results import load_experiment, read_experiment
from gsbench.errors import InputError
from gsbench.files import atomic, place_of
from gsbench.runs.experiments import list_experiments
from gsbench.runs.layout import STORE
from gsbench.runs.stages import INIT
from gsbench.settings import is_folder_name
from gsbench.verbs.arguments import ArgumentParser, path
from gsbench.view import ADDRESS

if TYPE_CHECKING:
    from gsbench.gaussians.model import Gaussians

log = logging.getLogger(__name__)

FORMATS = {
    "ply": "the 3DGS point cloud, as every viewer and trainer reads it (248 bytes a Gaussian)",
    "splat": "antimatter15's .splat for browsers: 32 bytes a Gaussian, colour without view dependence",
    "spz": "Niantic's .spz: about a tenth of the .ply, harmonics included",
    "compressed": "PlayCanvas's compressed .ply for SuperSplat: about 16 bytes a Gaussian and harmonics; needs gsplat",
}
# The command of the program that writes it, from its manual: developer.playcanvas.com/user-manual/splat-transform
SOG = (
    "gsbench writes no .sog: export {ply}, then `npm install -g @playcanvas/splat-transform` and `splat-transform "
    "{ply} {sog}`"
)


def main(argv: Sequence[str], runs: Path) -> int:
    """Run the verb: 0 if the file, or folder, was written."""
    parser = ArgumentParser(
        prog="gsbench export",
        description="Write a trained model for other programs; `gsbench export init TRIAL --out DIR` copies the COLMAP "
        "model that the trial started from; `gsbench export --results EXPERIMENT` writes results, configurations and "
        "hashes, without pixels, as one small archive.",
    )
    parser.add_argument("--results", metavar="EXPERIMENT", help="the archive of its results (default: EXPERIMENT.zip)")
    parser.add_argument("trial", nargs="*", metavar="TRIAL", help=f"{ADDRESS}; after the word init: its initial model")
    parser.add_argument(
        "--to", choices=list(FORMATS), help="; ".join(f"{name}: {text}" for name, text in FORMATS.items())
    )
    parser.add_argument(
        "--out", type=path, metavar="PATH", help="the file, or for init the folder, to write; needed for a TRIAL"
    )
    parser.add_argument(
        "--with",
        dest="shares",
        type=path,
        nargs="+",
        action="extend",
        default=[],
        metavar="ARCHIVE",
        help="with --results: also what these archives of the same experiment hold, from other machines or days",
    )
    options = parser.parse_args(argv)
    if options.results is not None:
        if options.trial or options.to:
            raise InputError("export --results takes an experiment, --with and --out alone")
        return export_results(options.results, runs, options.out, options.shares)
    if options.shares:
        raise InputError("--with goes with --results EXPERIMENT")
    if not options.trial or options.out is None:
        raise InputError("export needs a TRIAL and --out PATH, or --results EXPERIMENT (see gsbench export --help)")
    from gsbench.view.trials import find_trial, model_file

    is_init = len(options.trial) == 2 and options.trial[0] == "init"
    if len(options.trial) > 1 and not is_init:
        raise InputError(f"one TRIAL is exported, not {len(options.trial)}; for an initial model: export init TRIAL")
    trial = find_trial(options.trial[-1], runs)
    out = options.out
    if out.is_dir() and not is_init:
        raise InputError(f"--out {out} is a folder: name the file to write")
    with place_of(out):
        if is_init:
            export_init(trial.path.parents[3] / STORE / INIT.name / trial.record.hashes[INIT.name], out)
        else:
            export_model(model_file(trial), options.to or _format_of(out), out)
    log.info("%s", trial.label)
    print(out)
    return 0


def export_results(name: str, runs: Path, out: Path | None, shares: Sequence[Path] = ()) -> int:
    """Write the archive of an experiment's results and of its ``shares``, and say what is not in it; 0.

    Of an experiment without a whole trial in ``runs`` the shares alone make the archive.
    """
    from gsbench.claims.archive import write_archive

    if not is_folder_name(name):
        raise InputError(f"{name!r} is no name of an experiment: give that of its folder below {runs}")
    file = Path(f"{name}.zip") if out is None else out
    if file.is_dir():
        file = file / f"{name}.zip"
    with place_of(file):
        if shares:
            left_out = _export_together(name, runs, shares, file)
        else:
            left_out = write_archive(load_experiment(runs, name), file)
    for line in left_out:
        log.warning("left out: %s", line)
    print(file)
    return 0


def _export_together(name: str, runs: Path, shares: Sequence[Path], file: Path) -> list[str]:
    """Write one archive of the trials here and in ``shares``; returns what is not in it."""
    from gsbench.claims.archive import write_archive
    from gsbench.claims.shares import merge

    own = read_experiment(runs / name) if name in list_experiments(runs) else None
    if own is None or not own.trials:
        log.warning("%s has no whole trial here: the archive is of what the others hold", name)
        return merge(shares, name, file)
    with TemporaryDirectory() as folder:
        archive = Path(folder) / f"{name}.zip"
        return write_archive(own, archive) + merge([archive, *shares], name, file)


def export_model(ply: Path, form: str, out: Path) -> None:
    """Write the Gaussians of the 3DGS file ``ply`` to ``out``, in one of ``FORMATS``."""
    if form == "ply":
        _write(out, lambda temporary: shutil.copyfile(ply, temporary))
        return
    from gsbench.gaussians.ply import read_ply
    from gsbench.gaussians.spz import spz_bytes

    writers = {"splat": splat_bytes, "spz": spz_bytes, "compressed": compressed_bytes}
    content = writers[form](read_ply(ply))
    _write(out, lambda temporary: temporary.write_bytes(content))


def export_init(entry: Path, out: Path) -> None:
    """Copy the COLMAP model of the stage result ``entry`` to `MODEL_FOLDER` of ``out``, as 3DGS trainers read it."""
    from gsbench.init.base import MODEL_FOLDER

    model = entry / MODEL_FOLDER
    if not model.is_dir():
        raise InputError(f"the initial model is no longer in the store ({model}): run the trial again")
    first = out / MODEL_FOLDER.parts[0]
    if first.exists():
        raise InputError(f"{first} exists already: give another --out")
    shutil.copytree(model, out / MODEL_FOLDER)


def splat_bytes(gaussians: Gaussians) -> bytes:
    """antimatter15's layout, 32 bytes a Gaussian, the most important first.

    Position and scale are 3 + 3 float32, colour and opacity 4 bytes (RGBA), the rotation 4 bytes, (w, x, y, z) of the
    unit quaternion as 128 + 128 q. Importance is opacity times volume, as his ``convert.py`` orders them (viewers may
    draw the first part of a file only).
    """
    import numpy as np
    import torch

    from gsbench.gaussians.spherical_harmonics import dc_to_rgb

    raw = gaussians.detach()
    record = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("rotation", "u1", 4)])
    table = np.empty(len(raw), record)
    opacity = torch.sigmoid(raw.opacity_logits)  # [N]
    colors = torch.cat([dc_to_rgb(raw.sh_dc), opacity[:, None]], dim=1)  # [N, 4]
    rotation = torch.nn.functional.normalize(raw.quaternions, dim=1)  # [N, 4]
    table["mean"] = raw.means.numpy()
    table["scale"] = raw.log_scales.exp().numpy()
    table["rgba"] = (colors * 255).clamp(0, 255).to(torch.uint8).numpy()
    table["rotation"] = (rotation * 128 + 128).clamp(0, 255).to(torch.uint8).numpy()
    importance = raw.log_scales.sum(dim=1).exp() * opacity
    order = torch.argsort(importance, descending=True, stable=True).numpy()
    return table[order].tobytes()


def compressed_bytes(gaussians: Gaussians) -> bytes:
    """PlayCanvas's compressed PLY, as gsplat writes it. Raises InputError where gsplat is not installed."""
    try:
        from gsplat.exporter import export_splats
    except ImportError:
        raise InputError("--to compressed needs gsplat: pip install gsplat (its CUDA part is not used)") from None
    raw = gaussians.detach()
    return export_splats(
        raw.means,
        raw.log_scales,
        raw.quaternions,
        raw.opacity_logits,
        raw.sh_dc[:, None],
        raw.sh_rest,
        "ply_compressed",
    )


def _format_of(out: Path) -> str:
    name = out.name.lower()
    if name.endswith(".compressed.ply"):
        return "compressed"
    if name.endswith(".sog"):
        raise InputError(SOG.format(ply=out.with_suffix(".ply"), sog=out))
    form = out.suffix.lower().lstrip(".")
    if form not in FORMATS:
        raise InputError(f"what is {out.name} to hold? give --to {', '.join(FORMATS)}")
    return form


def _write(out: Path, write: Callable[[Path], object]) -> None:
    with atomic(out, sync=False) as temporary:
        write(temporary)
