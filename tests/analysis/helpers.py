"""The experiment ``exp`` of a runs folder: its trials, its table and its page."""

from gsbench.analysis.report.build import build_report
from gsbench.analysis.results import load_experiment
from gsbench.analysis.tables import build_table
from gsbench.runs.experiments import Arm

ADC, VOLUMETRIC = Arm("sfm", "adc"), Arm("sfm", "volumetric")


def loaded(runs):
    return load_experiment(runs, "exp")


def trials_of(runs):
    return loaded(runs).trials


def page_of(runs):
    return build_report(loaded(runs))


def table_of(runs, *metrics, **how):
    """The table with these metrics, or all."""
    return build_table(loaded(runs), metrics=metrics or None, **how)


def rows_of(table):
    """The texts of a table's entries by the first label of their row."""
    return {row.labels[0]: [entry.text for entry in row.entries] for row in table.rows}
