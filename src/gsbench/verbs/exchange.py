"""Verbs for what goes to others or comes from them: evaluate, judge, export and site."""

import argparse
import json
import logging
import shutil
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from gsbench.analysis.frames import COLUMNS, Declared, compare_methods
from gsbench.analysis.results import TrialResult, load_all_trials
from gsbench.errors import InputError
from gsbench.files import atomic, own_output, require_regular, writable_output, write_text
from gsbench.normalization import Normalization
from gsbench.parsing import one_line, read_typed
from gsbench.runs.experiments import DEFAULT_METRIC
from gsbench.settings import is_folder_name
from gsbench.verbs.arguments import options_of
from gsbench.words import counted, listed, printable, readable_bytes

if TYPE_CHECKING:
    import pandas as pd

DONE, LEFT_OUT = 0, 1

log = logging.getLogger(__name__)


def evaluate(argv: Sequence[str], runs: Path) -> int:
    """Run the verb: 0 if every photograph was measured."""
    from gsbench.renders.measure import measure_renders

    measure_renders(options_of("evaluate", argv), runs)
    return 0


def export(argv: Sequence[str], runs: Path) -> int:
    """Run the verb: 0 if the file, or folder, was written."""
    options = options_of("export", argv)
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

    options = options_of("site", argv)
    if options.out is None:
        raise InputError("site needs --out DIR, the folder to write into")
    page = options.out / INDEX
    with tempfile.TemporaryDirectory() as scratch, writable_output(page):
        left_out = write_site(options.archives, options.out, options.title, Path(scratch))
    for line in left_out:
        print(f"gsbench: left out: {line}", file=sys.stderr)
    print(page)
    return LEFT_OUT if left_out else DONE


# ---- the verdict on a table of results of any trainer, or on a folder of renders


def judge(argv: Sequence[str], runs: Path) -> int:
    """Run the verb; raises InputError for bad input."""
    options = options_of("judge", argv)
    if options.declare is not None:
        return _declare(options)
    if options.results is None:
        raise InputError("judge needs RESULTS: a table (.csv) or a folder {arm}/{scene}/{seed}")
    if options.declared is not None:
        if not options.declared.is_file():
            raise InputError(f"{options.declared}: no such file: judge --declare writes it")
        asked = read_typed(options.declared, Declared)
        _require_as_declared(options, asked)
    elif options.baseline is None:
        raise InputError("judge needs --baseline NAME, one of the methods")
    else:
        asked = _asked(options)
    comparison = compare_methods(_frame(options), asked, options.results.stem)
    if options.json:
        print(json.dumps(comparison.to_json(), indent=1))
    else:
        from gsbench.analysis.table_formats import to_markdown
        from gsbench.analysis.tables import build_table

        table = build_table(comparison.experiment, rows=("scene", "densify"), comparison=comparison)
        print(to_markdown(replace(table, row_headings=("scene", "method"))), end="")
    if options.out is not None:
        from gsbench.analysis.report.build import build_report

        with writable_output(options.out):
            write_text(options.out, build_report(comparison.experiment))
        print(options.out, file=sys.stderr)
    return 0


def _declare(options: argparse.Namespace) -> int:
    """Write the question of trainings to come."""
    needed = ("baseline", "methods", "scenes", "seeds")
    if lacking := [f"--{name}" for name in needed if not getattr(options, name)]:
        raise InputError(f"judge --declare needs {listed(lacking)}, too")
    if options.results is not None or options.declared is not None:
        raise InputError("judge --declare comes before the results: leave them out")
    asked = replace(
        _asked(options),
        methods=options.methods,
        scenes=options.scenes,
        seeds=tuple(options.seeds),
    )
    if options.declare.exists():
        raise InputError(f"{options.declare} is there already: a question is not changed")
    write_text(options.declare, json.dumps(asked.to_json(), indent=1) + "\n")
    trials = (1 + len(asked.methods)) * len(asked.scenes) * len(asked.seeds)
    print(f"{options.declare}: {counted(len(asked.methods), 'question')}, {trials} trainings")
    return 0


def _asked(options: argparse.Namespace) -> Declared:
    return Declared(
        baseline=options.baseline,
        metric=options.metric or DEFAULT_METRIC,
        better=options.better or "",
        least=options.least,
    )


def _require_as_declared(options: argparse.Namespace, declared: Declared) -> None:
    """Raise InputError for an option that says something else than what was declared."""
    for name in ("baseline", "metric", "least", "better"):
        value, known = getattr(options, name), getattr(declared, name)
        if value not in (None, known):
            raise InputError(f"--{name} {value}: {known} was declared: leave the option out")


def _frame(options: argparse.Namespace) -> "pd.DataFrame":
    """The table of results; that of a folder is measured now."""
    import pandas as pd  # here, since it is slow to import

    place = options.results
    if place.is_dir():
        from gsbench.renders.measure import measure_folders

        if options.truth is None:
            raise InputError("a folder of renders needs --truth DIR: photographs by scene")
        return pd.DataFrame(measure_folders(place, options.truth, options.settings))
    if options.settings or options.truth is not None:
        raise InputError("KEY=VALUE and --truth are for a folder of renders, not for a table")
    try:
        require_regular(place)
        frame = pd.read_csv(place, dtype=dict.fromkeys(COLUMNS[:2], str), keep_default_na=True)
    except FileNotFoundError:
        raise InputError(f"{place}: no such file") from None
    except (ValueError, UnicodeDecodeError, pd.errors.ParserError) as error:
        raise InputError(
            f"{place} is no table of comma-separated values ({one_line(str(error))}); "
            "`gsbench site` shows archives"
        ) from None
    for name in COLUMNS[:2]:
        if name in frame:
            frame[name] = [printable(" ".join(str(value).split())) for value in frame[name]]
    return frame
