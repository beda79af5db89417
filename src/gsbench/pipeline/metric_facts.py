"""The facts of a metric that trials compute, of gsbench or of the user's own."""

from collections.abc import Mapping
from typing import Any

from gsbench.eval.facts import MetricFacts, facts_of, find_metric, in_region
from gsbench.runs.experiments import AT


def facts_for(metric: str, values: Mapping[str, Any]) -> MetricFacts:
    """The facts of a metric of trials with the configuration ``values``.

    Raises InputError for an unknown metric.
    """
    shipped = find_metric(metric)
    if shipped is not None:
        return shipped
    # here, since only a user's own metric needs it
    from gsbench.pipeline.parts import build_metrics

    name, _, region = metric.partition(AT)
    metrics = build_metrics(values["eval"], values["allow_targets"])
    return in_region(facts_of(name, metrics[name]), region)
