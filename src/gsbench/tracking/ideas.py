"""The ideas of an experiment in MLflow: a parent run for each, with its trials nested below.

That is MLflow's own habit for sweeps, so its first page compares the ideas, as rows and as bars. A
parent has the means of its trials and their deviations; a superseded trial is tagged and is in no
mean. Only public functions of MLflow are used.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

from filelock import FileLock

from gsbench.analysis.cells import make_cell
from gsbench.analysis.comparison import Comparison, compare
from gsbench.analysis.quantities import Quantity
from gsbench.analysis.results import (
    Arm,
    Experiment,
    TrialResult,
    group_by,
    newest_code,
    read_experiment,
)
from gsbench.analysis.sentences import headline
from gsbench.analysis.table_formats import to_markdown
from gsbench.analysis.tables import build_table
from gsbench.analysis.trial_result import seeds_text
from gsbench.errors import InputError
from gsbench.tracking.mlflow_sink import LOCK, MAX_TAG, connect, ensure_experiment
from gsbench.tracking.trial import EVAL, numbers_of
from gsbench.words import counted, markdown_code, markdown_text

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import Run

IDEA = "gsbench.idea"  # the tag of a parent run
PARENT = "mlflow.parentRunId"  # MLflow's tag of a nested run
DESCRIPTION = "mlflow.note.content"  # and of what its page says
SUPERSEDED = "superseded"  # the tag of a trial that later code repeated
DEVIATION = "deviation"  # MLflow shows the charts of such a prefix together
OWN_NOTE = "`gsbench report"  # in a description that gsbench wrote
NO_VERDICT = "No verdict: it needs two arms."
RUNS_AT_ONCE = 1000


def show_ideas(home: Path, uri: str | None) -> str:
    """Renew the parent runs and the page of the experiment in ``home``; returns MLflow's id of it.

    Raises InputError, and any error of the tracker's client.
    """
    client = connect(uri, home.parent)
    experiment_id = ensure_experiment(client, home.name, home.parent)
    experiment = newest_code(read_experiment(home))
    comparison = compare(experiment)
    if experiment.trials:
        _describe(client, experiment_id, description(experiment, comparison))
    with FileLock(home / LOCK):  # several jobs of a cluster may do this at once
        runs = list(_all_runs(client, experiment_id))
        parents = _renew_parents(client, experiment_id, comparison, runs)
        _nest(client, experiment, comparison, runs, parents)
    return experiment_id


def _all_runs(client: MlflowClient, experiment_id: str) -> Iterator[Run]:
    page = None
    while True:
        found = client.search_runs([experiment_id], max_results=RUNS_AT_ONCE, page_token=page)
        yield from found
        if not (page := found.token):
            return


def _renew_parents(
    client: MlflowClient, experiment_id: str, comparison: Comparison, runs: Sequence[Run]
) -> dict[str, str]:
    """The ids of the parent runs by idea; each shows what its trials say now."""
    by_arm = group_by(comparison.trials, "arm")
    single_init = len({arm.init for arm in by_arm}) == 1
    present: dict[str, Run] = {}
    for run in runs:
        name = run.data.tags.get(IDEA)
        if name is not None and (name in present or name not in map(str, by_arm)):
            client.delete_run(run.info.run_id)  # of another day's names, or made twice
        elif name is not None:
            present[name] = run
    ids = {}
    for arm, trials in by_arm.items():
        label = arm.short if single_init else str(arm)
        run = present.get(str(arm)) or client.create_run(
            experiment_id, run_name=label, tags={IDEA: str(arm), "kind": "idea"}
        )
        ids[str(arm)] = str(run.info.run_id)
        _update(client, run, _means(trials), _tags(arm, trials, comparison))
        if run.info.status != "FINISHED":
            client.set_terminated(run.info.run_id, "FINISHED")
    return ids


def _update(
    client: MlflowClient, run: Run, numbers: Mapping[str, float], tags: Mapping[str, str]
) -> None:
    """Send the numbers and tags that the run does not show yet."""
    from mlflow.entities import Metric, RunTag

    now = int(time.time() * 1000)
    shown, named = run.data.metrics, run.data.tags
    metrics = [Metric(key, new, now, 0) for key, new in numbers.items() if shown.get(key) != new]
    texts = {key: text[:MAX_TAG] for key, text in tags.items()}
    changed = [RunTag(key, text) for key, text in texts.items() if named.get(key) != text]
    if metrics or changed:
        client.log_batch(run.info.run_id, metrics=metrics, tags=changed)


def _means(trials: Sequence[TrialResult]) -> dict[str, float]:
    """Means over scenes of the means over seeds, deviations over seeds, and the count of trials."""
    measured = {trial.path: numbers_of(trial.record) for trial in trials}
    scenes = sorted({trial.scene for trial in trials})
    numbers: dict[str, float] = {"trials": len(trials)}
    for name in dict.fromkeys(chain(*measured.values())):

        def read(trial: TrialResult, name: str = name) -> float | None:
            return measured[trial.path].get(name)

        cell = make_cell(trials, Quantity(name, name, 0, 0, read), scenes, len(trials))
        if cell.mean is not None:
            numbers[name] = cell.mean
        if cell.std is not None:
            numbers[name.replace(EVAL, DEVIATION, 1)] = cell.std
    return numbers


def _tags(arm: Arm, trials: Sequence[TrialResult], comparison: Comparison) -> dict[str, str]:
    """The verdict on an idea, and the note that MLflow's page shows of its run."""
    own = [answer for answer in comparison.answers if answer.arm == arm]
    is_baseline = any(answer.baseline == arm for answer in comparison.answers)
    verdict = "; ".join(answer.badge for answer in own)
    verdict = verdict or ("baseline" if is_baseline else NO_VERDICT)
    scenes = sorted({trial.scene for trial in trials})
    seeds = {trial.seed for trial in trials}
    lines = [
        *[markdown_text(answer.sentence) for answer in own],
        markdown_text(
            f"{counted(len(trials), 'trial')} on {', '.join(scenes)}, {seeds_text(seeds)}: means "
            f"over scenes, and standard deviations over seeds."
        ),
        _more(comparison.experiment.name),
    ]
    return {"arm": str(arm), "verdict": verdict, DESCRIPTION: "\n\n".join(lines)}


def _nest(
    client: MlflowClient,
    experiment: Experiment,
    comparison: Comparison,
    runs: Sequence[Run],
    parents: Mapping[str, str],
) -> None:
    """Put the trials' runs below those of their ideas, and tag those that later code repeated."""
    place = experiment.folder.parent
    arms = {trial.path.relative_to(place).as_posix(): trial.arm for trial in comparison.trials}
    older = {trial.path.relative_to(place).as_posix() for trial in experiment.older}
    # a trial without a result belongs to the idea whose trials have its settings, else its name
    known = {path.rpartition("-seed")[0]: str(arm) for path, arm in arms.items()}
    for run in runs:
        folder = run.data.tags.get("folder")
        if folder is None:
            continue
        named = folder.split("/")[2] if folder.count("/") > 2 else ""
        idea = str(arms.get(folder) or known.get(folder.rpartition("-seed")[0]) or named)
        tags = {PARENT: parents[idea]} if idea in parents else {}
        if folder in older:
            tags[SUPERSEDED] = "by trials of later code; in no mean"
        elif SUPERSEDED in run.data.tags:
            client.delete_tag(run.info.run_id, SUPERSEDED)
        _update(client, run, {}, tags)


# ---- the experiment's page


def _describe(client: MlflowClient, experiment_id: str, text: str) -> None:
    present = client.get_experiment(experiment_id).tags.get(DESCRIPTION)
    by_user = present and OWN_NOTE not in present
    if not by_user and present != text:
        client.set_experiment_tag(experiment_id, DESCRIPTION, text)


def _more(name: str) -> str:
    return f"{markdown_code(f'gsbench report {name}')} shows more."


def description(experiment: Experiment, comparison: Comparison) -> str:
    """Verdicts, table and its notes in Markdown, cut to what a tag may hold."""
    try:
        lines = to_markdown(build_table(experiment, comparison=comparison)).splitlines()
    except InputError as error:  # cells would average unlike trials
        lines = [markdown_text(f"No table: {error}")]
    rest = [line for line in lines if not line.startswith("#")]
    # The page shows only the first line until it is clicked: decided ideas come first there.
    ordered = sorted(comparison.answers, key=lambda one: one.verdict.outcome == "undecided")
    first = "; ".join(headline(one.verdict) for one in ordered) or NO_VERDICT
    end = f"\n\n{_more(experiment.name)}"
    text = "\n".join([f"**{markdown_text(first)}**", "", *rest]).strip()
    if len(text) + len(end) > MAX_TAG:
        text = text[: MAX_TAG - len(end)].rpartition("\n")[0]
    return text + end


def addresses(server: str, experiment_id: str) -> dict[str, str]:
    """The page of an experiment on a server of MLflow: its ideas as rows, and as bars."""
    page = f"{server.rstrip('/')}/#/experiments/{experiment_id}/runs"
    return {"ideas": page, "bars": f"{page}?compareRunsMode=CHART"}
