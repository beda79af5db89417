"""The page of an experiment in MLflow: table and verdict as its description, and a view that compares the arms.

MLflow's page keeps what it shows (columns, groups, charts) in a tag of the experiment, if somebody shares that as a
link: ``mlflow.sharedViewState.KEY`` holds JSON, and the address has ``viewStateShareKey=KEY``. The format is not
documented, and was tried with MLflow 3.17. `address_of` gives the plain page for versions before 3.10 and from 4 on.
"""

from __future__ import annotations

import base64
import json
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gsbench.analysis.cells import swept_settings
from gsbench.analysis.results import Experiment, TrialResult, read_experiment
from gsbench.analysis.table_formats import to_markdown
from gsbench.analysis.tables import build_table
from gsbench.errors import InputError
from gsbench.eval.facts import known_keys
from gsbench.tracking.mlflow_sink import NOTE, connect, ensure_experiment
from gsbench.tracking.sinks import EVAL, eval_name

if TYPE_CHECKING:
    from mlflow import MlflowClient

KEY = "gsbench"
VIEW = f"mlflow.sharedViewState.{KEY}"
MAX_TAG = 5000  # characters of an experiment's tag in older versions of MLflow
TRIED = ("3.17",)  # versions of MLflow whose page was seen to show the view
COLUMNS = ("scene", "init", "densify", "seed")  # tags of a run
COSTS = {"gaussians": "Gaussians", "minutes": "training time (minutes)"}
ARM = "arm"  # the parameter by which runs are grouped
COMPLETE = "tags.kind = 'trial'"
VERDICT = "Verdict"  # how the notes begin that belong above the table


def publish(home: Path, uri: str | None) -> str:
    """Renew the page of the experiment in ``home``; returns the experiment's id in the tracker ``uri``.

    Raises InputError, and any error of the tracker's client.
    """
    client = connect(uri, home.parent)
    experiment_id = ensure_experiment(client, home.name, home.parent)
    experiment = read_experiment(home)
    if experiment.trials:
        _set(client, experiment_id, {NOTE: description(experiment), VIEW: packed(view_state(experiment.trials))})
    return experiment_id


def _set(client: MlflowClient, experiment_id: str, tags: dict[str, str]) -> None:
    present = client.get_experiment(experiment_id).tags
    for key, value in tags.items():
        if len(value) <= MAX_TAG and present.get(key) != value:
            client.set_experiment_tag(experiment_id, key, value)


def address_of(server: str, experiment_id: str, version: str, charts: bool = True) -> str:
    """The address of the view on a ``server`` with this version of MLflow: its charts, or its list of runs."""
    page = f"{server.rstrip('/')}/#/experiments/{experiment_id}"
    if not version.startswith(tuple(f"{tried}." for tried in TRIED)):
        return page
    return f"{page}/runs?viewStateShareKey={KEY}&compareRunsMode={'CHART' if charts else 'TABLE'}"


def description(experiment: Experiment) -> str:
    """Verdict, table and its notes in Markdown, cut to what a tag may hold."""
    try:
        lines = to_markdown(build_table(experiment)).splitlines()
    except InputError as error:  # cells would average unlike trials
        return f"No table: {error}"
    verdicts = [line for line in lines if line.startswith(f"- {VERDICT}")]
    rest = [line for line in lines if line not in verdicts and not line.startswith("#")]
    end = f"\n\n`gsbench report {experiment.name}` shows more."
    text = "\n".join([*verdicts, "", *rest]).strip()
    if len(text) + len(end) > MAX_TAG:
        text = text[: MAX_TAG - len(end)].rpartition("\n")[0]
    return text + end


def packed(state: dict[str, Any]) -> str:
    """The state of a view as MLflow's page packs it."""
    return "deflate;" + base64.b64encode(zlib.compress(json.dumps(state).encode(), 9)).decode()


def view_state(trials: Sequence[TrialResult]) -> dict[str, Any]:
    """The state of MLflow's page that compares the arms of ``trials``."""
    measured = {key for trial in trials for key in trial.metrics}
    metrics = [eval_name(key) for key in known_keys() if key in measured]
    metrics += [eval_name(key) for key in sorted(measured - set(known_keys()))]
    results = [*metrics, *(f"{EVAL}/{key}" for key in COSTS)]
    curves = ["train/gaussians", "train/loss"]
    if any(trial.record.metrics_at for trial in trials):  # eval.at
        curves.insert(0, metrics[0])
    pictures = sorted({path.stem for path in trials[0].folder.pictures("renders")})[:1]
    sections = {
        "Results: mean over the trials of an arm": [_chart("BAR", name, metricKey=name) for name in results],
        "Over iterations": [_chart("LINE", name, metricKey=name, selectedMetricKeys=[name]) for name in curves],
        "Test views": [
            _chart("IMAGE", f"{view} {kind}", imageKeys=[f"{view}/{kind}"])
            for view in pictures
            for kind in ("1 render", "2 photograph", "3 error")
        ],
    }
    return {
        # the search
        "searchFilter": "",
        "orderByKey": f"metrics.`{results[0]}`",
        "orderByAsc": False,
        "startTime": "ALL",
        "lifecycleFilter": "Active",
        "datasetsFilter": [],
        "modelVersionFilter": "All Runs",
        # the page
        "selectedColumns": [*(f"tags.`{tag}`" for tag in COLUMNS), *(f"metrics.`{name}`" for name in results)],
        "columnOrder": [],
        "columnWidths": {},
        "runsExpanded": {},
        "runsPinned": [],
        "runsHidden": [],
        "runsVisibilityMap": {},
        "runsHiddenMode": "SHOW_ALL",
        "viewMaximized": False,
        "runListHidden": False,
        "isAccordionReordered": True,
        "useGroupedValuesInCharts": True,
        "hideEmptyCharts": True,
        "groupBy": {
            "aggregateFunction": "average",
            "groupByKeys": [{"mode": "param", "groupByData": key} for key in (ARM, *swept_settings(trials))],
        },
        "groupsExpanded": {},
        "autoRefreshEnabled": True,
        "compareRunCharts": list(_placed(sections)),
        "compareRunSections": [
            {"uuid": name, "name": name, "display": True, "isReordered": True, "deleted": False, "isGenerated": False}
            for name in sections
        ],
    }


def _chart(kind: str, name: str, **options: Any) -> dict[str, Any]:
    return {
        "uuid": f"{kind} {name}",
        "type": kind,
        "runsCountToCompare": 100,
        "deleted": False,
        "isGenerated": False,
        **options,
    }


def _placed(sections: dict[str, list[dict[str, Any]]]) -> Iterator[dict[str, Any]]:
    for section, charts in sections.items():
        for chart in charts:
            yield chart | {"metricSectionId": section}
