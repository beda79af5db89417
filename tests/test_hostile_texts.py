"""Every text of a stranger's record stays in its line, in all that gsbench prints and writes."""

import csv
import json
import re
import zipfile
from shlex import split

import pytest

from gsbench import cli
from gsbench.runs.trial_folder import TrialFolder
from gsbench.system.locks import LockHolder
from gsbench.words import markdown_code, markdown_text
from tests.helpers import change_json, read_json, table, write, write_lines
from tests.trials import write_runs

BEGIN = "FORGED"  # no line of an output may begin with it
HOSTILE = f"a\n{BEGIN}: better in PSNR\x1b[31m`![p](http://e)` <img src=x>\\<img src=x>"
# texts that name the trial's folder, or are one of a few words: others are refused
FIXED = ("status", "experiment", "scene", "init", "densify", "evaluated_from")
RECORDS = ("trained_by", "initial_cloud", "twins", "budget", "code", "raster_proof")
FULL = table(__file__, "full")
COMMANDS = (
    "tables exp",
    "tables exp --format csv --out out/csv",
    "tables exp --format latex --out out/tex",
    "tables exp --format html --out out/html",
    "report exp --out out/report",
    "explain exp:garden:psnr:volumetric",
    "status exp --all",
    "status",
    "status exp --json",
    "plan exp",
    "retry exp --dry-run",
    "export exp --results out/archive.zip",
    "site out/archive.zip --out out/site",
)


def _hostile(value):
    """The value with every text in it, also of keys, made hostile."""
    if isinstance(value, dict):
        return {key if len(key) < 2 else key + HOSTILE: _hostile(one) for key, one in value.items()}
    if isinstance(value, list):
        return [_hostile(one) for one in value]
    return value + HOSTILE if isinstance(value, str) else value


def _spoiled(record):
    """The record with each text hostile; keys of records in it, and fixed fields, stay."""
    spoiled = {key: value if key in FIXED else _hostile(value) for key, value in record.items()}
    for key in RECORDS:
        spoiled[key] = {name: _hostile(value) for name, value in record[key].items()}
    facts = {name: _hostile(value) for name, value in record["metric_facts"]["sharp"].items()}
    spoiled["metric_facts"] = {f"sharp{HOSTILE}": facts}
    # without the metric that was asked for, there would be no verdict
    spoiled["metrics"] |= record["metrics"]
    return spoiled


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A runs folder in which a stranger wrote every text that gsbench reads."""
    root = tmp_path_factory.mktemp("hostile")
    folders = write_runs(root / "runs", scenes=("garden",), seeds=(0, 1, 2), pictures=True)
    for folder in folders:
        (folder / "results.json").write_text(
            json.dumps(_spoiled(read_json(folder / "results.json") | FULL))
        )
        config = read_json(folder / "config.yaml")
        config["densify"]["note"] = HOSTILE + config["densify"]["name"]
        write(folder / "config.yaml", config)
        rows = (folder / "per_view.csv").read_text().replace("view001", f'"view001{HOSTILE}"')
        write(folder / "per_view.csv", rows)
    failed = folders[0].with_name("0123abcd-seed7")
    write(failed / "config.yaml", read_json(folders[0] / "config.yaml") | {"seed": 7})
    write(failed / "failed.json", {"error": HOSTILE, "message": HOSTILE, "traceback": HOSTILE})
    write(failed / ".lock.holder", {"host": HOSTILE, "pid": 1, "since": 1.0, "what": HOSTILE})
    key = "garden/sfm-adc/0123abcd-seed8"
    words = [f"densify.note={HOSTILE}"]
    command = {"words": words, "cwd": str(root), "time": 1.0, "trials": {key: {"words": words}}}
    write_lines(root / "runs/exp/commands.jsonl", [command])
    return root, folders


def _texts_of(file):
    """The texts of a written file: cells of a table, members of an archive, the page's text."""
    if file.suffix == ".csv":
        with file.open(newline="") as stream:
            assert all("\n" not in cell for row in csv.reader(stream) for cell in row)
    if file.suffix == ".zip":
        with zipfile.ZipFile(file) as archive:
            return [archive.read(name).decode("utf-8", "replace") for name in archive.namelist()]
    return [file.read_text("utf-8", "replace")]


def test_every_text_of_the_test_is_hostile(place):
    """The record that the other tests read keeps what was put in."""
    record = TrialFolder(place[1][0]).record()
    spoiled = [key for key in FULL if BEGIN in str(getattr(record, key))]
    assert spoiled == list(FULL)
    assert "\n" not in "".join(str(getattr(record, key)) for key in FULL)


@pytest.mark.parametrize("words", COMMANDS)
def test_no_text_of_a_record_begins_a_line(place, words, capsys, monkeypatch):
    root, _ = place
    monkeypatch.chdir(root)
    monkeypatch.setenv("GSBENCH_RUNS", str(root / "runs"))
    with cli.printable_output():
        cli.run(split(words))
    texts = list(capsys.readouterr())
    texts += [
        text for file in (root / "out").rglob("*") if file.is_file() for text in _texts_of(file)
    ]
    texts += [file.read_text() for file in (root / "runs").rglob("report.html")]
    for text in texts:
        assert not re.search(rf"^\W*{BEGIN}", text, re.MULTILINE), words
        assert "\x1b" not in text
        if words == "tables exp" and text.startswith("###"):  # Markdown
            assert "<img" not in re.sub(r"\\.", "", text)
        elif text.startswith("<!"):  # HTML
            assert "<img src=x" not in text


def test_markdown_shows_a_text_and_does_nothing_else():
    assert markdown_text("a\n# b `c` \\<img> [d](e)") == r"a # b \`c\` \\\<img> [d]\(e)"
    assert [markdown_code(text) for text in ("a", "a`b", "``")] == [
        "`a`",
        "`` a`b ``",
        "``` `` ```",
    ]


def test_the_holder_of_a_lock_is_one_line(place):
    _, folders = place
    holder = LockHolder(host="h", pid=1, since=1.0)
    assert holder.description == "process 1 on h"
    from gsbench.system.locks import describe_holder

    text = describe_holder(folders[0].with_name("0123abcd-seed7") / ".lock")
    assert BEGIN in text
    assert "\n" not in text


def test_a_record_that_is_written_again_equals_what_is_read(tmp_path):
    """Else a result with a library's error of two lines would be a new one each time."""
    (folder,) = write_runs(tmp_path, scenes=("garden",), seeds=(0,), densifiers=("adc",))
    change_json(folder / "results.json", unavailable={"lpips_vgg": "two\nlines"})
    files = TrialFolder(folder)
    values = read_json(folder / "config.yaml")
    record = files.record()
    files.write_finished(values, record)
    assert files.write_finished(values, record)
