"""Verbs for what goes to others or comes from them: evaluate, export and site."""

import logging
import shutil
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from gsbench.analysis.addresses import TRIAL
from gsbench.analysis.results import TrialResult, load_all_trials
from gsbench.errors import InputError
from gsbench.eval.protocol import PROTOCOLS
from gsbench.files import atomic, own_output, writable_output
from gsbench.normalization import Normalization
from gsbench.settings import is_folder_name
from gsbench.verbs.arguments import ArgumentParser, path
from gsbench.words import readable_bytes

DONE, LEFT_OUT = 0, 1

log = logging.getLogger(__name__)


def evaluate(argv: Sequence[str], runs: Path) -> int:
    """Run the verb: 0 if every photograph was measured."""
    from gsbench.renders.measure import measure_renders

    parser = ArgumentParser(
        "evaluate",
        "Names are matched, never guessed. Sizes must be equal.",
        {
            "renders RENDERS": ("folder of pictures, or of predictions by nerfbaselines"),
            "settings* KEY=VALUE": "settings of the scene, and eval.…",
            "--truth PLACE": "the photographs: a folder, a trial (folder or EXPERIMENT:SCENE:ARM), "
            "or a scene's name, whose test views are taken as a trial sees them; not needed for "
            "predictions",
            "--protocol NAME": ("default: that of the trial, or paper", list(PROTOCOLS)),
            "--by-order": "match sorted pictures with sorted photographs",
            "--as=place EXPERIMENT:ARM": "enter them as a trial; ARM: a name or INIT-NAME",
            "--seed K": ("which repetition of the arm they are (0)", int, 0),
            "--scene NAME": "with --as, where PLACE is a folder: what to call the scene",
            "--json": "print a JSON object instead of a table",
        },
    )
    measure_renders(parser.parse_args(argv), runs)
    return 0


def export(argv: Sequence[str], runs: Path) -> int:
    """Run the verb: 0 if the file, or folder, was written."""
    options = ArgumentParser(
        "export",
        "`gsbench export init TRIAL --out DIR` copies the COLMAP model that the trial started "
        "from. `gsbench export --results EXPERIMENT` writes results, configurations and hashes as "
        "one small archive, without pixels unless --pictures is given.",
        {
            "--results EXPERIMENT": "the archive of its results (default: EXPERIMENT.zip)",
            "trial* TRIAL": f"{TRIAL}; after the word init: its initial model",
            "--out PATH": (
                "the .ply file to write, for init the folder; a TRIAL needs it",
                path,
            ),
            "--pictures": "with --results: the pictures of the test views, too",
        },
    ).parse_args(argv)
    if options.results is not None and not options.trial:
        export_results(options.results, runs, options.out, options.pictures)
        return 0
    *before, address = options.trial or [""]
    if not (address and options.out) or before not in ([], ["init"]) or options.pictures:
        raise InputError(
            "export needs one TRIAL and --out PATH (for an initial model: export init TRIAL), or "
            "--results EXPERIMENT alone, and --pictures with these"
        )
    from gsbench.view.trials import find_trial

    export_model(find_trial(address, runs), options.out, is_init=bool(before))
    return 0


def export_model(trial: TrialResult, out: Path, is_init: bool) -> None:
    """Write the trained model as a PLY file, or the initial model as a folder."""
    from gsbench.view.trials import model_file, model_folder

    if not is_init:
        check_form(out)
    with writable_output(out):
        if is_init:
            export_init(model_folder(trial), out, trial.record.to_training)
        else:
            with atomic(out, sync=False) as temporary:
                shutil.copyfile(model_file(trial), temporary)
    count = "the initial model" if is_init else f"{trial.record.num_gaussians:,} Gaussians"
    size = sum(path.stat().st_size for path in ([out] if out.is_file() else out.rglob("*")))
    print(f"{out}: {trial.label}, {count}, {readable_bytes(size)}")


def export_results(name: str, runs: Path, out: Path | None, pictures: bool = False) -> None:
    """Write the archive of an experiment's results, and warn of what is left out."""
    from gsbench.claims.export import write_archive

    if not is_folder_name(name):
        raise InputError(
            f"{name!r} is not the name of an experiment: give that of its folder below {runs}"
        )
    file = Path(f"{name}.zip") if out is None else out
    if file.is_dir():
        file = file / f"{name}.zip"
    with writable_output(file) if file == out else own_output(file):
        left_out, still_open = write_archive(load_all_trials(runs, name), file, pictures)
    for line in left_out:
        log.warning("left out: %s", line)
    facts = [f"results of {name}", readable_bytes(file.stat().st_size), still_open]
    print(f"{file}: {', '.join(filter(None, facts))}")


def check_form(out: Path) -> None:
    """Raise InputError unless the name of the file is that of a 3DGS PLY."""
    if not out.name.lower().endswith(".ply") or out.name.lower().endswith(".compressed.ply"):
        raise InputError(
            f"--out {out}: name a file that ends in .ply, the 3DGS form, which every viewer and "
            "trainer reads (docs/other_models.md says what makes other forms, and a page)"
        )


def export_init(model: Path, out: Path, normalization: Normalization) -> None:
    """Copy a trial's COLMAP model into ``out``, as 3DGS trainers read it.

    It gets the coordinates in which the scene was given. Raises InputError if ``out`` has a folder
    of models.
    """
    from gsbench.init.base import MODEL_FOLDER

    first = out / MODEL_FOLDER.parts[0]
    if first.exists():
        raise InputError(f"{first} exists already: give another --out")
    shutil.copytree(model, out / MODEL_FOLDER)
    if not normalization.is_identity:
        from gsbench.scene.colmap import normalize_model, read_model

        moved = read_model(model)
        normalize_model(moved, normalization, undo=True)
        moved.write_binary(out / MODEL_FOLDER)


def site(argv: Sequence[str], runs: Path) -> int:
    """Run the verb: 0, or 1 if an archive was left out; raises InputError if none can be read."""
    from gsbench.claims.site import INDEX, write_site  # here, for a quick answer to --help

    options = ArgumentParser(
        "site",
        "It needs no server, and has pictures if the archives have them.",
        {
            "archives+ ARCHIVE": ("of results", path),
            "--out DIR": ("the folder to write into", path),
            "--title TEXT": ("of its first page", str, "Results of gsbench"),
        },
    ).parse_args(argv)
    if options.out is None:
        raise InputError("site needs --out DIR, the folder to write into")
    page = options.out / INDEX
    with tempfile.TemporaryDirectory() as scratch, writable_output(page):
        left_out = write_site(options.archives, options.out, options.title, Path(scratch))
    for line in left_out:
        print(f"gsbench: left out: {line}", file=sys.stderr)
    print(page)
    return LEFT_OUT if left_out else DONE
