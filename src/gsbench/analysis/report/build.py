"""Putting the report together: one HTML file that needs no network, no script to be read, and no other file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from importlib.resources import files

from jinja2 import Environment, StrictUndefined

from gsbench.analysis.cells import with_variants
from gsbench.analysis.declaration import standing
from gsbench.analysis.images import read_image
from gsbench.analysis.pairing import BASELINE, choose_pairs, controls_of
from gsbench.analysis.paper import layout_of, load_paper, paper_tables
from gsbench.analysis.report.pictures import data_uri
from gsbench.analysis.report.sections import (
    compare_arms,
    event_charts,
    provenance,
    search_part,
    training_charts,
    volume_charts,
)
from gsbench.analysis.results import Experiment, TrialResult, by_key
from gsbench.analysis.table_formats import to_html
from gsbench.analysis.tables import Table, build_table
from gsbench.analysis.verdicts import (
    SYMBOLS,
    VERDICT,
    WORDS,
    by_scene_lines,
    detail_lines,
    families,
    headline,
    judge_pairs,
    secondary,
    seeds_to_resolve,
)
from gsbench.runs.layout import FIGURES
from gsbench.words import signed


def build_report(experiment: Experiment, baseline: str = BASELINE) -> str:
    """The report as HTML, with every densifier held against ``baseline``; a pure function of the experiment's files."""
    trials = with_variants(experiment.trials)
    arms = sorted({trial.arm for trial in trials})
    declared = standing(experiment.folder, trials)
    search = search_part(experiment.folder)
    # Among points of a search, which were chosen by results, no test holds.
    pairs = [] if search else choose_pairs(arms, baseline, controls_of(trials))
    judged = judge_pairs(trials, pairs, declared)
    versus = [compare_arms(trials, own) for own in judged]
    quantity = next((one.declared for one in judged if one.declared is not None), None)
    layout = layout_of(experiment.name)
    tables = [build_table(experiment)] if layout is None else paper_tables(experiment, layout)
    volumes, volume_notes = volume_charts(trials, arms)
    rows = provenance(trials)
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    environment.filters["signed"] = _signed
    return environment.from_string(_resource("template.html.j2")).render(
        name=experiment.name,
        style=_resource("style.css"),
        script=_resource("script.js"),
        arms=[str(arm) for arm in arms],
        scenes=sorted({trial.scene for trial in trials}),
        seeds=experiment.seeds,
        trials=trials,
        versus=versus,
        declared=declared.sentences(quantity.name) if declared and quantity else [],
        families=families(judged),
        tables=[to_html(_without_verdicts(table)) for table in tables],
        contradictions=[] if layout is None else load_paper().contradictions,
        search=search,
        to_html=to_html,
        words=WORDS,
        symbols=SYMBOLS,
        headline=headline,
        secondary=secondary,
        by_scene_lines=by_scene_lines,
        detail_lines=detail_lines,
        seeds_to_resolve=seeds_to_resolve,
        training=training_charts(trials, arms),
        events=event_charts(trials, arms),
        volumes=volumes,
        volume_notes=volume_notes,
        figures=trial_figures(trials),
        provenance=rows,
        columns=list(dict.fromkeys(key for row in rows for key in row)),
        warnings=experiment.warnings,
    )


def _without_verdicts(table: Table) -> Table:
    """The table without the notes that repeat the verdicts, which stand at the top of the page."""
    return replace(table, notes=tuple(note for note in table.notes if not note.startswith(VERDICT)))


def trial_figures(trials: Sequence[TrialResult]) -> list[tuple[str, str]]:
    """(caption, data URI) of the pictures that trials left for the report; one seed of each scene and arm.

    A picture that several arms of a scene share, such as that of their initial cloud, is there once.
    """
    found: dict[tuple[str, str, str], list[str]] = {}  # by name, scene and picture: the arms and seeds
    for group in by_key(trials, lambda trial: (trial.scene, trial.arm)).values():
        trial = group[0]
        for path in sorted((trial.path / FIGURES).glob("*.png")):
            key = path.stem.replace("_", " "), trial.scene, data_uri(read_image(path))
            found.setdefault(key, []).append(f"{trial.init}-{trial.densify}, seed {trial.seed}")
    return [(f"{name}: {scene}, {'; '.join(arms)}", uri) for (name, scene, uri), arms in found.items()]


def _resource(name: str) -> str:
    return files("gsbench.analysis.report").joinpath(name).read_text(encoding="utf-8")


def _signed(value: float | None, decimals: int) -> str:
    return "unknown" if value is None else signed(value, f".{decimals}f")
