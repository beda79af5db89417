"""The site from archives: content of its pages, escaped texts of strangers, sorted tables."""

import json
import re
from shlex import split

import pytest
import yaml

from gsbench.analysis.results import load_experiment
from gsbench.claims.archive import unpack_archive
from gsbench.claims.export import write_archive
from gsbench.claims.site import _unique_key
from gsbench.cli import run
from tests.analysis.helpers import loaded, trials_of
from tests.claims.test_archive import rewrite
from tests.helpers import refusal, table
from tests.markup import Page
from tests.trials import ask_about, write_runs
from tests.view.browser import Browser

HOSTILE = "<img src=x onerror=alert(1)>&\"'"


def archive(tmp_path, experiment="exp", **plan):
    """The archive of made-up trials, with a question about them."""
    runs, file = tmp_path / f"runs-{experiment}", tmp_path / f"{experiment}.zip"
    write_runs(runs, experiment=experiment, **plan)
    ask_about(runs, experiment=experiment)
    write_archive(load_experiment(runs, experiment), file, plan.get("pictures", False))
    return file


def site(tmp_path, *archives):
    assert run(["site", *map(str, archives), "--out", str(tmp_path / "site")]) == 0
    return (tmp_path / "site/index.html").read_text()


def test_the_first_page_has_arms_scenes_claims_and_working_links(tmp_path):
    files = archive(tmp_path), archive(tmp_path, "other", effect={"psnr": 2})
    page = site(tmp_path, *files)
    found = Page(page)
    for words in (
        "PSNR (dB)",
        "better in",
        *split("courtyard garden sfm volumetric paper-1"),
    ):
        assert words in found.text
    for _, attributes in found.elements:
        target = attributes.get("href") or attributes.get("src") or ""
        if target.startswith("#"):
            assert f'id="{target[1:]}"' in page
        elif target != "data:," and target:
            assert (tmp_path / f"site/{target}").is_file()
    assert found.elements.count(("table", {"class": "sorts"})) > 8
    assert "http://" not in page
    assert "https://" not in page


def test_the_table_of_the_metric_that_was_asked_about_is_open(tmp_path):
    runs, file = tmp_path / "runs", tmp_path / "exp.zip"
    write_runs(runs)
    ask_about(runs, metric="ssim")
    write_archive(load_experiment(runs, "exp"), file)
    page = site(tmp_path, file)
    assert re.findall(r"<details open><summary>([^<]*): arms", page) == ["SSIM ↑"]


@pytest.mark.parametrize(
    "name, taken, key",
    table(__file__, "keys"),
)
def test_the_key_of_an_experiment_is_plain_and_not_taken(name, taken, key):
    assert _unique_key(name, taken) == key


def test_the_report_has_pictures_if_the_archive_has_them(tmp_path):
    file = archive(tmp_path, seeds=(0,), scenes=("courtyard",), pictures=True)
    site(tmp_path, file)
    # whole views
    assert "data:image/jpeg" in (tmp_path / "site/reports/exp.html").read_text()
    without = tmp_path / "without.zip"
    write_archive(loaded(tmp_path / "runs-exp"), without)
    assert without.stat().st_size < file.stat().st_size / 2
    back = unpack_archive(file, tmp_path / "back").trials[0]
    there = trials_of(tmp_path / "runs-exp")[0]
    for kind in ("renders", "ground_truth"):
        assert [one.read_bytes() for one in back.folder.pictures(kind)] == [
            one.read_bytes() for one in there.folder.pictures(kind)
        ]


def test_an_archive_of_too_many_bytes_is_neither_written_nor_read(tmp_path, monkeypatch):
    file = archive(tmp_path)
    monkeypatch.setattr("gsbench.claims.archive.MAX_TOTAL_BYTES", 1000)
    with refusal("more than the limit of 1 kB"):
        unpack_archive(file, tmp_path / "back")
    with refusal("more than the limit of 1 kB"):
        write_archive(loaded(tmp_path / "runs-exp"), tmp_path / "again.zip")


def test_html_in_texts_of_a_stranger_is_escaped(tmp_path):
    def spoil(content):
        for name in list(content):
            if name.endswith("/results.json"):
                results = json.loads(content[name])
                results["versions"]["gsbench"] = HOSTILE
                results |= {"protocol": HOSTILE, "unavailable": {"lpips_alex": HOSTILE}}
                content[name] = json.dumps(results).encode()
            if name.endswith("/config.yaml"):
                values = yaml.safe_load(content[name])
                values["densify"][HOSTILE] = HOSTILE
                content[name] = yaml.safe_dump(values).encode()

    file = archive(tmp_path)
    rewrite(file, spoil, resigned=True)
    page = site(tmp_path, file)
    pages = [page, (tmp_path / "site/reports/exp.html").read_text()]
    for text in pages:
        elements = Page(text).elements
        assert not [tag for tag, named in elements if "onerror" in named or tag == "img"]
    assert HOSTILE in Page(page).text
    assert page.count("<script>") == 1


@pytest.mark.parametrize("name", ["index", "Con Trol%20#x", "é<>".replace("<>", "")])
def test_names_of_experiments_become_plain_names_of_files(tmp_path, name):
    one, other = archive(tmp_path, name), tmp_path / "again.zip"
    other.write_bytes(one.read_bytes())
    site(tmp_path, one, other)
    reports = sorted(path.name for path in (tmp_path / "site/reports").glob("*.html"))
    assert len(reports) == 2
    assert all(re.fullmatch(r"[a-z0-9_-]+\.html", report) for report in reports)


def test_damaged_archives_are_left_out_and_a_site_without_any_is_refused(tmp_path, capsys, refused):
    good, bad = archive(tmp_path), tmp_path / "bad.zip"
    bad.write_bytes(good.read_bytes()[:100])
    out = str(tmp_path / "site")
    assert run(["site", str(bad), str(good), "--out", out]) == 1
    assert "left out" in capsys.readouterr().err
    assert "bad.zip" in (tmp_path / "site/index.html").read_text()
    assert "no archive can be shown" in refused("site", bad, "--out", out)
    (tmp_path / "file").touch()
    assert run(["site", str(good), "--out", str(tmp_path / "file")]) == 2


@pytest.mark.slow
def test_a_click_on_a_heading_sorts_the_table(tmp_path):
    archives = [archive(tmp_path, name, seeds=range(k + 1)) for k, name in enumerate("cab")]
    site(tmp_path, *archives)

    def evaluated(browser, script):
        return str(browser.call("Runtime.evaluate", expression=script)["result"]["value"])

    names = (
        "[...document.querySelector('table').tBodies[0].rows].map((row) => "
        "row.cells[0].textContent).join('')"
    )
    with Browser(
        (tmp_path / "site/index.html").as_uri(), tmp_path / "profile", (400, 800)
    ) as browser:
        browser.wait_until(lambda picture: bool((picture < 100).any()), "text")
        assert evaluated(browser, names) == "cab"
        for column, shown in ((0, "abc"), (0, "cba"), (1, "cab"), (1, "bac")):
            click = f"document.querySelectorAll('thead')[0].querySelectorAll('button')[{column}].click()"
            browser.call("Runtime.evaluate", expression=click)
            assert evaluated(browser, names) == shown
        wide = "document.documentElement.scrollWidth > document.documentElement.clientWidth"
        assert evaluated(browser, wide) == "False"
