"""The page of an experiment in MLflow: its table and verdict, and a view that compares arms.

MLflow's page keeps what it shows (columns, groups, charts) in a tag of the experiment, if somebody
shares that as a link: ``mlflow.sharedViewState.KEY`` holds JSON, and the address has
``viewStateShareKey=KEY``. The format is not documented, and was tried with MLflow 3.17: `addresses`
gives the plain page for other versions.
"""

from __future__ import annotations

import base64
import json
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gsbench.analysis.cells import swept_settings
from gsbench.analysis.comparison import compare
from gsbench.analysis.quantities import metric_keys
from gsbench.analysis.results import Experiment, TrialResult, newest_code, read_experiment
from gsbench.analysis.sentences import headline
from gsbench.analysis.statistics import UNDECIDED
from gsbench.analysis.table_formats import to_markdown
from gsbench.analysis.tables import build_table
from gsbench.errors import InputError
from gsbench.tracking.mlflow_sink import DESCRIPTION, connect, ensure_experiment
from gsbench.tracking.trial import EVAL, arm_name, eval_name

if TYPE_CHECKING:
    from mlflow import MlflowClient

KEY = "gsbench"
VIEW = f"mlflow.sharedViewState.{KEY}"
MAX_TAG = 5000  # characters of an experiment's tag in older versions of MLflow
TRIED = ("3.17.",)  # versions of MLflow whose page was seen to show the views
COLUMNS = ("scene", "init", "densify", "seed")  # tags of a run
ARM = "arm"  # the parameter by which runs are grouped
NO_VERDICT = "No verdict: it needs two arms."
OWN_NOTE = "`gsbench report"  # in a description that `publish` wrote
CHART_HEIGHT = 250  # px
NAME_WIDTH = 290  # px of the runs' names

Sections = dict[str, list[dict[str, Any]]]  # charts by the headings of their sections


def publish(home: Path, uri: str | None) -> str:
    """Renew the page of the experiment in ``home``; returns its id in the tracker ``uri``.

    Raises InputError, and any error of the tracker's client.
    """
    client = connect(uri, home.parent)
    experiment_id = ensure_experiment(client, home.name, home.parent)
    experiment = newest_code(read_experiment(home))
    if experiment.trials:
        _set(
            client,
            experiment_id,
            {DESCRIPTION: description(experiment), VIEW: packed(view_state(experiment.trials))},
        )
    return experiment_id


def _set(client: MlflowClient, experiment_id: str, tags: dict[str, str]) -> None:
    present = client.get_experiment(experiment_id).tags
    note = present.get(DESCRIPTION)
    if note and OWN_NOTE not in note:  # a user wrote the description
        tags = {VIEW: tags[VIEW]}
    for key, value in tags.items():
        if len(value) <= MAX_TAG and present.get(key) != value:
            client.set_experiment_tag(experiment_id, key, value)


def addresses(server: str, experiment_id: str, version: str) -> dict[str, str]:
    """The addresses of the views on a ``server`` with this version of MLflow, by what they show."""
    page = f"{server.rstrip('/')}/#/experiments/{experiment_id}"
    if not version.startswith(TRIED):
        return {"experiment": page}
    shared = f"{page}/runs?viewStateShareKey={KEY}"
    return {
        "arms": f"{shared}&compareRunsMode=CHART",
        "table": f"{shared}&compareRunsMode=TABLE",
    }


def description(experiment: Experiment) -> str:
    """Verdict, table and its notes in Markdown, cut to what a tag may hold."""
    comparison = compare(experiment)
    try:
        lines = to_markdown(build_table(experiment, comparison=comparison)).splitlines()
    except InputError as error:  # cells would average unlike trials
        lines = [f"No table: {error}"]
    rest = [line for line in lines if not line.startswith("#")]
    # The page shows only the first line until it is clicked: decided ideas come first there.
    ordered = sorted(comparison.answers, key=lambda one: one.verdict.outcome == UNDECIDED)
    answer = "; ".join(headline(one.verdict) for one in ordered) or NO_VERDICT
    end = f"\n\n{OWN_NOTE} {experiment.name}` shows more."
    text = "\n".join([f"**{answer}**", "", *rest]).strip()
    if len(text) + len(end) > MAX_TAG:
        text = text[: MAX_TAG - len(end)].rpartition("\n")[0]
    return text + end


def packed(state: dict[str, Any]) -> str:
    """The state of a view as MLflow's page packs it."""
    return "deflate;" + base64.b64encode(zlib.compress(json.dumps(state).encode(), 9)).decode()


def view_state(trials: Sequence[TrialResult]) -> dict[str, Any]:
    """The state of MLflow's page: ``trials`` in groups by arm, with a chart for each result."""
    results = [*map(eval_name, metric_keys(trials)), f"{EVAL}/gaussians", f"{EVAL}/minutes"]
    curves = ["train/gaussians", "train/loss"]
    if any(trial.record.metrics_at for trial in trials):  # eval.at
        curves.insert(0, results[0])
    lines = [_chart("LINE", name, metricKey=name, selectedMetricKeys=[name]) for name in curves]
    arms = {
        "Mean by arm": [_chart("BAR", name, metricKey=name) for name in results],
        "Over iterations (mean, least and largest)": lines,
    }
    swept = swept_settings(trials)
    groups = [{"mode": "param", "groupByData": key} for key in (ARM, *swept)]
    collapsed = {_group_of(trial, swept): False for trial in trials}
    return _state(results, arms, {"aggregateFunction": "average", "groupByKeys": groups}, collapsed)


def _group_of(trial: TrialResult, swept: Sequence[str]) -> str:
    """The id of the trial's group on MLflow's page."""
    values = {ARM: arm_name(trial.densify, trial.init)}
    values |= {key: str(trial.config.get(key, "")) for key in swept}
    return ",".join(f"param.{key}.{value or 'null'}" for key, value in values.items())


def _state(
    results: list[str], sections: Sections, groups: Any, expanded: dict[str, bool]
) -> dict[str, Any]:
    """The state of MLflow's page: metrics in its list, charts in sections, groups of runs."""
    columns = [*(f"tags.`{tag}`" for tag in COLUMNS), *(f"metrics.`{name}`" for name in results)]
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
        "selectedColumns": columns,
        "columnOrder": ["attributes.`Run Name`", *columns],
        "columnWidths": {"attributes.`Run Name`": NAME_WIDTH},
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
        "groupBy": groups,
        "groupsExpanded": expanded,
        "autoRefreshEnabled": True,
        "compareRunCharts": list(_placed(sections)),
        "compareRunSections": [SECTION | {"uuid": name, "name": name} for name in sections],
    }


SECTION: dict[str, Any] = {
    "display": True,
    "isReordered": True,
    "deleted": False,
    "isGenerated": False,
    "columns": 3,
    "cardHeight": CHART_HEIGHT,
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


def _placed(sections: Sections) -> Iterator[dict[str, Any]]:
    for section, charts in sections.items():
        for chart in charts:
            yield chart | {"metricSectionId": section}
