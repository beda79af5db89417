"""``gsbench export``: a trained model, an initial cloud, or an experiment's results, for others."""

from __future__ import annotations

import logging
import math
import shutil
from collections.abc import Sequence
from pathlib import Path

from gsbench.analysis.results import load_experiment
from gsbench.errors import InputError
from gsbench.files import atomic, place_of
from gsbench.runs.layout import STORE
from gsbench.runs.stages import INIT
from gsbench.settings import is_folder_name
from gsbench.verbs.arguments import ArgumentParser, path
from gsbench.view import ADDRESS
from gsbench.words import readable_bytes

log = logging.getLogger(__name__)

FORMATS = {
    "ply": "the 3DGS point cloud, as every viewer and trainer reads it (248 bytes a Gaussian)",
    "spz": "Niantic's .spz: about a tenth of the .ply, harmonics included",
    "compressed": "PlayCanvas's compressed .ply for SuperSplat: about 16 bytes a Gaussian and harmonics",
}
# The command of the program that writes it, from its manual: developer.playcanvas.com/user-manual/splat-transform
SPLAT_TRANSFORM = (
    "gsbench writes no {suffix}: export {ply}, then `npm install -g @playcanvas/splat-transform` and `splat-transform "
    "{ply} {out}`"
)
# A .spz has y up and z backward where a .ply has y down and z forward: signs of (x, y, z), and of the 15 harmonics
# above the constant one, each odd in y and z together or not.
SPZ_AXES = (1.0, -1.0, -1.0)
SPZ_HARMONICS = (-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1)
SPZ_POSITION_BITS, SPZ_MAX_FRACTION_BITS = 24, 20  # signed; a millionth of a unit is enough


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
    options = parser.parse_args(argv)
    if options.results is not None:
        if options.trial or options.to:
            raise InputError("export --results takes an experiment and --out alone")
        return export_results(options.results, runs, options.out)
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
    count = "the initial model" if is_init else f"{trial.record.num_gaussians:,} Gaussians"
    size = sum(path.stat().st_size for path in ([out] if out.is_file() else out.rglob("*")))
    print(f"{out}: {trial.label}, {count}, {readable_bytes(size)}")
    return 0


def export_results(name: str, runs: Path, out: Path | None) -> int:
    """Write the archive of an experiment's results, and say what is not in it; 0."""
    from gsbench.claims.archive import write_archive

    if not is_folder_name(name):
        raise InputError(f"{name!r} is no name of an experiment: give that of its folder below {runs}")
    file = Path(f"{name}.zip") if out is None else out
    if file.is_dir():
        file = file / f"{name}.zip"
    with place_of(file):
        left_out = write_archive(load_experiment(runs, name), file)
    for line in left_out:
        log.warning("left out: %s", line)
    print(f"{file}: results of {name}, {readable_bytes(file.stat().st_size)}")
    return 0


def export_model(ply: Path, form: str, out: Path) -> None:
    """Write the Gaussians of the 3DGS file ``ply`` to ``out``, in one of ``FORMATS``."""
    with atomic(out, sync=False) as temporary:
        if form == "ply":
            shutil.copyfile(ply, temporary)
        else:
            # gsply goes by the name of the file that it writes.
            named = temporary.with_name(f"{temporary.name}.{'spz' if form == 'spz' else 'compressed.ply'}")
            try:
                (write_spz if form == "spz" else write_compressed)(ply, named)
                named.replace(temporary)
            finally:
                named.unlink(missing_ok=True)


def write_spz(ply: Path, out: Path) -> None:
    """Write version 3 of Niantic's format, whose positions have as many bits behind the point as the farthest leaves.

    gsply leaves axes as they are, and takes 12 bits, by which positions beyond 2,048 units would be cut off.
    """
    import gsply
    import numpy as np

    model = gsply.plyread(ply)
    axes = np.array(SPZ_AXES, dtype=np.float32)
    means = model.means * axes  # [N, 3]
    before_the_point = max(0, math.frexp(float(np.abs(means).max()))[1]) + 1  # and the sign
    turned = gsply.GSData(
        means=means,
        scales=model.scales,
        quats=model.quats * np.append(np.float32(1), axes),  # [N, 4] (w, x, y, z)
        opacities=model.opacities,
        sh0=model.sh0,
        shN=model.shN * np.array(SPZ_HARMONICS[: model.shN.shape[1]], dtype=np.float32)[:, None],  # [N, K, 3]
    )
    bits = min(SPZ_MAX_FRACTION_BITS, max(0, SPZ_POSITION_BITS - before_the_point))
    gsply.write_spz(out, turned, fractional_bits=bits)


def write_compressed(ply: Path, out: Path) -> None:
    """Write PlayCanvas's compressed PLY."""
    import gsply

    gsply.plywrite(out, gsply.plyread(ply), compressed=True)


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


def _format_of(out: Path) -> str:
    name = out.name.lower()
    if name.endswith(".compressed.ply"):
        return "compressed"
    form = out.suffix.lower().lstrip(".")
    if form in ("sog", "splat"):
        raise InputError(SPLAT_TRANSFORM.format(suffix=out.suffix, ply=out.with_suffix(".ply"), out=out))
    if form not in FORMATS:
        raise InputError(f"what is {out.name} to hold? give --to {', '.join(FORMATS)}")
    return form
