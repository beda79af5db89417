"""A damaged file of a runs folder does not harm the reading of the others.

It causes neither a crash nor a hang, but one line that names the file.
"""

import ast
import os
from pathlib import Path

import pytest

import gsbench
from gsbench import cli
from tests.fuzz.records import EXPERIMENT, NAMES, write_original

pytestmark = pytest.mark.slow

DEEP = b"[" * 100_000
DAMAGES = {
    "deep": DEEP,
    "long integer": b'{"status": ' + b"9" * 5000 + b"}",
    "infinite": b'{"status": "complete", "seed": 1e400}',
    "null": b"null",
    "empty object": b"{}",
    "list": b"[]",
    "number": b"17",
    "binary": bytes(range(256)),
    "empty": b"",
}


@pytest.fixture
def places(tmp_path, monkeypatch):
    monkeypatch.setenv("GSBENCH_RUNS", str(tmp_path))
    monkeypatch.setattr("gsbench.launch.states.read_queue", lambda users: {})
    return write_original(tmp_path)


@pytest.mark.parametrize("damage", [*DAMAGES, "fifo", "folder"])
@pytest.mark.parametrize("name", ["results.json", "commands.jsonl", "config.yaml", "metrics.jsonl"])
def test_verbs_print_one_line_for_a_damaged_file(name, damage, places, capsys):
    path = places[name]
    if damage in DAMAGES:
        path.write_bytes(DAMAGES[damage])
    else:
        path.unlink()
        (os.mkfifo if damage == "fifo" else os.mkdir)(path)
    is_plan = name == "commands.jsonl" and damage != "empty"  # without a line, nothing is lost
    is_result = name in ("results.json", "config.yaml")
    table, status = ["tables", EXPERIMENT], ["status", EXPERIMENT]
    for argv in (table, status, ["status"], [*table, "--format=trials"]):
        assert cli.run(argv) in (0, 1)
        captured = capsys.readouterr()
        said = [line for line in captured.err.splitlines() if line.startswith("left out")]
        assert len(said) <= 2  # one of these trials has failed, and tables report it
        if argv[0] == "tables":
            assert "psnr" in captured.out.lower()
        if is_plan or (argv[0] == "tables" and is_result):
            assert any(name in line for line in said)
        if argv == status:
            assert ("damaged" in captured.out) == (name == "results.json")
    assert cli.run(["explain", f"{EXPERIMENT}:courtyard:psnr:adc"]) == 0


def test_every_kind_of_file_is_damaged_in_turn(places):
    assert set(places) == set(NAMES)


# gsbench's own files are read by the typed readers. These modules parse other files, or text of their
# own process.
READS_ITSELF = {
    "analysis/paper.py",
    "datasets/catalog.py",  # of the package
    "launch/estimates.py",  # text of this process
    "init/base.py",
    "runs/keys.py",  # text of this very process
    "runs/code.py",  # tables of the package
    "system/install.py",  # files that pip wrote about the package
    "claims/archive.py",  # archives, which anybody may have made
    "config/schema.py",  # of the package
    "parsing.py",
}
LOADERS = {"json.loads", "json.load", "yaml.load", "yaml.safe_load", "yaml.full_load"}


def test_only_typed_readers_parse_gsbenchs_files():
    package = Path(gsbench.__file__).parent
    found = set()
    for path in package.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Attribute) and ast.unparse(node) in LOADERS:
                found.add(path.relative_to(package).as_posix())
            if isinstance(node, ast.ImportFrom):
                assert not {f"{node.module}.{alias.name}" for alias in node.names} & LOADERS, path
    assert found == READS_ITSELF
