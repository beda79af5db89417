"""The table of verbs against what other tables and constants of the package have."""

import pytest

from gsbench.analysis.frames import DIRECTIONS
from gsbench.analysis.pairs import BASELINE
from gsbench.analysis.paper import published_names
from gsbench.analysis.tables import DEFAULT_ROWS
from gsbench.datasets.catalog import read_catalog
from gsbench.raster.executors import EXECUTORS
from gsbench.runs.commands import BASELINE as LEDGERS_BASELINE
from gsbench.verbs import VERBS
from gsbench.verbs.results import REPORT_NAME

NAMED = {
    ("fetch", "dataset? DATASET"): ", ".join(read_catalog()),
    ("tables", "--paper NAME"): f"published numbers, too: {', '.join(published_names())}",
    ("tables", "--rows A,B"): f"default {','.join(DEFAULT_ROWS)}",
    ("report", "--out PATH"): REPORT_NAME,
    ("report", "--baseline NAME"): f"({BASELINE})",
    ("plan", "--baseline NAME"): f"({BASELINE})', 'text', '{BASELINE}'",
    ("bench", "--raster A,B"): ", ".join(one.name for one in EXECUTORS),
}


@pytest.mark.parametrize("verb, argument", NAMED)
def test_an_argument_names_what_there_is(verb, argument):
    assert NAMED[verb, argument] in str(VERBS[verb]["arguments"][argument])


def test_defaults_and_choices_are_those_of_the_code():
    assert VERBS["ledger"]["of_actions"]["--against IDEA"][-1] == LEDGERS_BASELINE
    assert str([word for word in DIRECTIONS if word]) in str(VERBS["judge"]["arguments"])
