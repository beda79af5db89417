"""The page of MLflow that compares the trials of an experiment: final metrics first.

MLflow draws one chart for each metric, in alphabetical sections, the final ones last. A view that is shared under a
name is a tag of its experiment, from which the page takes sections, charts and columns. An MLflow that cannot read the
tag shows its own page.
"""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

if TYPE_CHECKING:
    from mlflow import MlflowClient

NAME = "gsbench"
TAG = f"mlflow.sharedViewState.{NAME}"
SECTION = "Final metrics"
BARS = ("psnr", "ssim", "lpips_vgg_raw", "lpips_vgg", "flip", "num_gaussians", "seconds_train")
COLUMNS = ("arm", "scene.name", "seed")  # parameters, beside the runs
MAX_RUNS = 100


def comparison_url(base: str, client: MlflowClient, experiment_id: str) -> str:
    """The page's address on the server ``base``; the experiment is given its view, if it lacks it."""
    wanted = json.dumps(_view(), separators=(",", ":"))
    if client.get_experiment(experiment_id).tags.get(TAG) != wanted:
        client.set_experiment_tag(experiment_id, TAG, wanted)
    ordered = f"orderByKey={quote('params.`arm`')}&orderByAsc=true"
    words = f"viewStateShareKey={NAME}&compareRunsMode=CHART&workflowType=machine_learning&{ordered}"
    return f"{base}/#/experiments/{experiment_id}/runs?{words}"


def _view() -> dict[str, Any]:
    charts = [_chart("BAR", key, metricKey=key, displayName=key) for key in BARS]
    charts.append(
        _chart("PARALLEL", "all", selectedParams=["arm"], selectedMetrics=["num_gaussians", "psnr"], showAllRuns=True)
    )
    section = {"uuid": NAME, "name": SECTION, "display": True, "isReordered": True, "deleted": False}
    return {
        "compareRunSections": [section],
        "compareRunCharts": charts,
        "isAccordionReordered": True,  # else sections are sorted by name
        "hideEmptyCharts": True,
        "runsHiddenMode": "SHOW_ALL",  # else charts show the ten youngest runs, and the baseline is mostly the oldest
        "selectedColumns": [f"params.`{name}`" for name in COLUMNS] + [f"metrics.`{name}`" for name in BARS],
    }


def _chart(kind: str, name: str, **settings: Any) -> dict[str, Any]:
    common = {"runsCountToCompare": MAX_RUNS, "metricSectionId": NAME, "deleted": False, "isGenerated": False}
    return {"type": kind, "uuid": f"{NAME}-{name}"} | common | settings
