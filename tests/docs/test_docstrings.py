"""The examples in docstrings are true, and the classes that users extend have one."""

from __future__ import annotations

import doctest
import importlib
import re

import pytest

from gsbench.densify import Densifier
from gsbench.eval.metric import Metric
from gsbench.init.base import Initializer
from gsbench.raster import Rasterizer
from gsbench.tracking.sink import Sink
from tests.conftest import ROOT

PROMPT = re.compile(r"^\s*>>> ", re.MULTILINE)
SOURCES = {
    ".".join(path.relative_to(ROOT / "src").with_suffix("").parts).removesuffix(".__init__"): path
    for path in sorted((ROOT / "src" / "gsbench").rglob("*.py"))
    if PROMPT.search(path.read_text(encoding="utf-8"))
}


@pytest.mark.parametrize("name", SOURCES)
def test_examples(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    result = doctest.testmod(importlib.import_module(name))
    assert result.failed == 0, capsys.readouterr().out
    written = len(PROMPT.findall(SOURCES[name].read_text(encoding="utf-8")))
    assert result.attempted == written  # none stands where doctest does not look, such as in a decorated function


@pytest.mark.parametrize(
    "extended", [Densifier, Initializer, Metric, Rasterizer, Sink], ids=lambda extended: extended.__name__
)
def test_what_users_extend_has_an_example(extended: type) -> None:
    assert extended.__module__ in SOURCES
    assert "class" in (extended.__doc__ or "").partition("Examples:")[2]


def test_examples_are_sections_so_that_the_site_shows_them_as_code() -> None:
    for path in SOURCES.values():
        for before, line in re.findall(r"^( *)>>> (.*)$", path.read_text(encoding="utf-8"), re.MULTILINE):
            assert len(before) >= 8, f"{path.name}: {line} stands in no section Examples:"
