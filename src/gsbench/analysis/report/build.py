"""The report as one HTML file: it needs no network and no other file, and can be read without JavaScript."""

from collections.abc import Sequence
from dataclasses import replace

from gsbench.analysis import verdicts
from gsbench.analysis.cells import with_variants
from gsbench.analysis.declaration import active_declaration
from gsbench.analysis.images import png_uri, read_image
from gsbench.analysis.pairing import BASELINE, choose_pairs, controls_of
from gsbench.analysis.paper import layout_of, load_paper, paper_tables
from gsbench.analysis.report.sections import (
    compare_arms,
    event_charts,
    event_table,
    provenance,
    search_summary,
    training_charts,
    volume_charts,
)
from gsbench.analysis.results import Experiment, TrialResult, group_by
from gsbench.analysis.table_formats import Table, fill
from gsbench.analysis.tables import build_table
from gsbench.runs.layout import FIGURES
from gsbench.words import signed


def build_report(experiment: Experiment, baseline: str = BASELINE) -> str:
    """The report as HTML, made from the experiment's files alone; every densifier is compared with ``baseline``."""
    trials = with_variants(experiment.trials)
    arms = sorted({trial.arm for trial in trials})
    declared = active_declaration(experiment.folder, trials)
    search = search_summary(experiment.folder)
    # The points of a search were chosen by results, so no test of them is valid.
    pairs = [] if search else choose_pairs(arms, baseline, controls_of(trials))
    judged = verdicts.judge_pairs(trials, pairs, declared)
    quantity = next((one.declared for one in judged if one.declared is not None), None)
    layout = layout_of(experiment.name)
    tables = [build_table(experiment)] if layout is None else paper_tables(experiment, layout)
    volumes, volume_notes = volume_charts(trials, arms)
    return fill(
        "report.html.j2",
        name=experiment.name,
        arms=[str(arm) for arm in arms],
        scenes=sorted({trial.scene for trial in trials}),
        seeds=experiment.seeds,
        trials=trials,
        versus=[compare_arms(trials, own) for own in judged],
        declared=declared.sentences(quantity.name) if declared and quantity else [],
        families=verdicts.families(judged),
        tables=[_without_verdicts(table) for table in tables],
        contradictions=[] if layout is None else load_paper().contradictions,
        search=search,
        say=verdicts,
        signed=_signed,
        training=training_charts(trials, arms),
        event_table=event_table(trials, arms),
        events=event_charts(trials, arms),
        volumes=volumes,
        volume_notes=volume_notes,
        figures=trial_figures(trials),
        provenance=provenance(trials),
        warnings=experiment.warnings,
    )


def _without_verdicts(table: Table) -> Table:
    """The table without its notes on verdicts: the top of the page has them."""
    return replace(table, notes=tuple(note for note in table.notes if not note.startswith(verdicts.VERDICT)))


def trial_figures(trials: Sequence[TrialResult]) -> list[tuple[str, str]]:
    """(caption, data URI) of the pictures in trials' ``figures`` folders, for one seed of each scene and arm.

    A picture that arms of a scene share, such as that of their initial cloud, appears once.
    """
    sources: dict[tuple[str, str, str], list[str]] = {}  # {(name, scene, data URI): arms and seeds}
    for group in group_by(trials, lambda trial: (trial.scene, trial.arm)).values():
        trial = group[0]
        for path in sorted((trial.path / FIGURES).glob("*.png")):
            key = path.stem.replace("_", " "), trial.scene, png_uri(read_image(path))
            sources.setdefault(key, []).append(f"{trial.init}-{trial.densify}, seed {trial.seed}")
    return [(f"{name}: {scene}, {'; '.join(arms)}", uri) for (name, scene, uri), arms in sources.items()]


def _signed(value: float | None, decimals: int) -> str:
    return "unknown" if value is None else signed(value, f".{decimals}f")
