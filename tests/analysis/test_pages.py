"""Every page that gsbench writes, with hostile text in each of its fields."""

import re
from functools import partial
from pathlib import Path

import pytest
from markupsafe import Markup

from gsbench.analysis import table_formats
from gsbench.analysis.report.build import build_report
from gsbench.claims.export import write_archive
from gsbench.cli import run
from tests.analysis.helpers import loaded
from tests.markup import Page
from tests.trials import write_runs
from tests.view.browser import Browser

ROOT = Path(table_formats.__file__).parents[1]
HOSTILE = (
    "'\"></script></style></title></textarea>--><script>document.title='owned'</script>"
    "<img src=x onerror=\"document.title='owned'\"><svg onload=\"document.title='owned'\">"
    "{{ 7 * 7 }}"
)
# null until the whole page is read; before it, the window has an empty one
LOOK = """
location.protocol === 'file:' && document.readyState === 'complete'
    ? [document.title === 'owned', document.scripts.length]
    : null
"""


def look(browser):
    answer = browser.call("Runtime.evaluate", expression=LOOK, returnByValue=True)
    return answer["result"]["value"]


def shape(page):
    return [(tag, tuple(attributes)) for tag, attributes in page.elements]


def pages(folder, monkeypatch):
    """Each kind of page by its template, written by the verbs or what they call."""
    runs = folder / "runs"
    write_runs(runs, views=7, seeds=(0, 1), pictures=True, effect={"psnr": 1.0})
    monkeypatch.setenv("GSBENCH_RUNS", str(runs))
    trials = loaded(runs)
    write_archive(trials, folder / "exp.zip")
    assert run(["site", str(folder / "exp.zip"), "--out", str(folder / "site")]) == 0
    assert run(["tables", "exp", "--format", "html", "--out", str(folder / "tables")]) == 0
    (table, *_) = sorted((folder / "tables").glob("*.html"))
    return {
        "report.html.j2": build_report(trials),
        "site.html.j2": (folder / "site/index.html").read_text(),
        "table_page.html.j2": table.read_text(),
    }


@pytest.fixture(scope="module")
def both(tmp_path_factory):
    """All pages, as they are and with `HOSTILE` in each field of each template."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        sound = pages(tmp_path_factory.mktemp("sound"), monkeypatch)
        plain = table_formats._environment.__wrapped__

        def hostile(package):
            environment = plain(package)

            def finalize(value):
                # Markup is what gsbench itself wrote: a script, its hash, a chart
                return value if isinstance(value, Markup) else f"{value}{HOSTILE}"

            environment.finalize = finalize
            return environment

        monkeypatch.setattr(table_formats, "_environment", hostile)
        return sound, pages(tmp_path_factory.mktemp("hostile"), monkeypatch)


def test_every_page_is_among_those_that_are_tried(both):
    whole = {
        file.name
        for file in ROOT.rglob("*.j2")
        if "<html" in file.read_text(encoding="utf-8").lower()
    }
    assert whole == both[0].keys()
    written = [file for file in ROOT.rglob("*.py") if "<html" in file.read_text().lower()]
    assert not written


def test_no_text_of_a_page_becomes_an_element_or_a_script(both):
    for name, sound in both[0].items():
        before, after = Page(sound), Page(both[1][name])
        assert shape(after) == shape(before), name
        assert "&lt;/script&gt;" in both[1][name], name
        assert len(after.scripts) == len(before.scripts)
        for tag, attributes in after.elements:
            assert not [key for key in attributes if key.startswith("on")], (name, tag)
            assert "srcdoc" not in attributes
            target = attributes.get("href") or attributes.get("src") or "#"
            assert re.match(r"#|data:|reports/|pictures/|https://", target), (name, target)


def test_every_page_allows_its_own_script_alone(both):
    for name, text in both[0].items():
        parsed = Page(text)
        head = [tag for tag, _ in parsed.elements]
        policy = next(
            attributes["content"] or ""
            for _, attributes in parsed.elements
            if attributes.get("http-equiv") == "Content-Security-Policy"
        )
        assert head[:4] == ["html", "head", "meta", "meta"], name  # before anything that it rules
        assert policy.startswith("default-src 'none'; ")
        run_scripts = [one for one in parsed.scripts if not one.startswith("{")]
        hashes = [f"'sha256-{table_formats._digest(script)}'" for script in run_scripts]
        assert re.findall("script-src ([^;]*)", policy) == hashes, name
        assert "unsafe-inline" not in policy.partition("script-src")[2]


@pytest.mark.browser
def test_no_hostile_text_runs_in_a_browser(both, tmp_path):
    for name, text in both[1].items():
        file = tmp_path / f"{name}.html"
        file.write_text(text, encoding="utf-8")
        with Browser(file.as_uri(), tmp_path / f"profile-{name}") as browser:
            found = browser.wait_for(partial(look, browser), "a whole page")
            assert found == [False, len(Page(text).scripts)], name
