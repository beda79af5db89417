"""Reading files that may be strange, up to the limits and one beyond."""

import importlib
import json
import os
import re
from dataclasses import field
from pathlib import Path

import pytest

from gsbench import parsing
from gsbench.parsing import (
    LARGEST_INT,
    MAX_DEPTH,
    MAX_MESSAGE,
    MAX_WORD,
    Amount,
    Count,
    DamagedError,
    Number,
    Record,
    Text,
    Whole,
    adapter,
    fault_of,
    one_line,
    parse_typed,
    read_bytes,
    read_if_sound,
    read_json,
    read_tail,
    read_typed,
    read_yaml,
    resolved,
    without_byte_order_mark,
)
from gsbench.runs.trial_record import iterate_rows
from tests.helpers import refusal, table, write


@pytest.mark.skipif(not Path("/proc/meminfo").exists(), reason="needs /proc")
def test_a_file_that_reports_no_size_is_read_whole():
    path = Path("/proc/version")
    assert path.stat().st_size == 0
    assert read_bytes(path) == path.read_bytes()


def test_a_file_is_read_up_to_its_limit_and_refused_beyond(tmp_path):
    file = tmp_path / "a"
    file.write_bytes(b"x" * 10)
    assert read_bytes(file, most=10) == b"x" * 10
    with pytest.raises(DamagedError, match="more than 9 bytes"):
        read_bytes(file, most=9)
    assert [read_tail(file, count) for count in (3, 10, 11)] == [b"xxx", b"x" * 10, b"x" * 10]


def test_only_regular_files_are_read(tmp_path):
    (tmp_path / "file").write_text("1")
    (tmp_path / "link").symlink_to(tmp_path / "file")
    os.mkfifo(tmp_path / "pipe")
    before = len(os.listdir("/dev/fd"))
    for name in ("link", "pipe", "."):
        with pytest.raises(DamagedError, match="cannot be read: it is not a regular file"):
            read_bytes(tmp_path / name)
    with pytest.raises(DamagedError, match="embedded null"):
        read_bytes(Path("a\0b"))
    for missing in ("none", "file/below"):
        with pytest.raises(FileNotFoundError):
            read_bytes(tmp_path / missing)
    assert read_bytes(resolved(tmp_path / "link")) == b"1"
    assert len(os.listdir("/dev/fd")) == before


def test_a_byte_order_mark_is_removed_and_other_encodings_are_refused():
    assert without_byte_order_mark("\ufeffä".encode()) == "ä".encode()
    assert without_byte_order_mark("ä\ufeff".encode()) == "ä\ufeff".encode()
    for encoding in ("utf-16-le", "utf-16-be", "utf-32-be", "utf-32-le"):
        with refusal("save it as UTF-8"):
            without_byte_order_mark("\ufeffä".encode(encoding))


def test_a_message_about_a_file_is_one_short_line():
    assert one_line(" a\n\tb  c ") == "a b c"
    assert one_line("x" * MAX_MESSAGE) == "x" * MAX_MESSAGE
    assert one_line("x" * (MAX_MESSAGE + 1)) == "x" * MAX_MESSAGE + "…"
    error = DamagedError(Path("a/b"), "is\nwrong")
    assert (str(error), error.path, error.reason) == ("a/b is wrong", Path("a/b"), "is wrong")


def nested(levels, innermost=1):
    """A value within so many lists."""
    for _ in range(levels):
        innermost = [innermost]
    return innermost


def shown(value):
    """The name of a case: pytest takes no surrogates."""
    return str(value)[:20].encode("ascii", "replace").decode()


@pytest.mark.parametrize(
    "value, fault",
    [
        ({"a": [1, 2.5, "b", True, None]}, ""),
        (3, ""),
        ("\ud800", "it is a text with a lone surrogate (half a character)"),
        (nested(MAX_DEPTH), ""),
        (nested(MAX_DEPTH + 1), "it has more than 40 levels"),
        ({"a": {"b": [0, float("nan")]}}, "a.b.1 is nan, which is not a finite number"),
        ([float("-inf")], "0 is -inf, which is not a finite number"),
        ({"a": LARGEST_INT - 1, "b": 1 - LARGEST_INT}, ""),
        ({"a": LARGEST_INT}, "a is an integer of more than 64 bits"),
        ({"a": -LARGEST_INT}, "a is an integer of more than 64 bits"),
        ({"a": {1, 2}}, "a is of type set"),
        ({"a": {1: 2, "b": 3}}, "a has keys that are not all texts, or all integers"),
        ({1.5: 2}, "it has keys that are not all texts, or all integers"),
        ({None: 2}, "it has keys that are not all texts, or all integers"),
        ({1: 2, 3: 4}, ""),
        ({LARGEST_INT: 2}, "it has a key that is an integer of more than 64 bits"),
        (
            {"a": {"\udfff": 2}},
            "a has a key that is a text with a lone surrogate (half a character)",
        ),
    ],
    ids=shown,
)
def test_values_that_are_not_plain_are_named_by_their_place(value, fault):
    assert fault_of(value) == fault


def test_values_are_counted_and_may_be_infinite_where_allowed():
    shared = [1, 2, 3]
    assert fault_of([shared, shared], most=9) == ""  # 1 + 2 + 2 * 3
    assert fault_of([shared, shared], most=8) == "it has more than 8 values"
    assert fault_of([float("inf")], infinite=True) == ""
    assert fault_of(["\ud800"], infinite=True) != ""


@pytest.mark.parametrize(
    "text, fault",
    [
        ("a: !!python/object:os.system x", "is damaged: it has the tag tag:yaml.org,2002:python"),
        ("a: {b: 1, b: 2}", "is not YAML ('b' is in it twice (line 1))"),
        ("x: 1\na: 1\nx: 2", "is not YAML ('x' is in it twice (line 3))"),
        ("a: &a {b: 1}\nc: {<<: *a}", "is damaged: it has a merge key"),
        ("[" * (MAX_DEPTH + 1) + "]" * (MAX_DEPTH + 1), "is damaged: it has more than 40 levels"),
        ("a: " + "1" * (MAX_WORD + 1), "is damaged: it has a word of 4,001 characters without"),
        ("a: [", "is not YAML ("),
        ("a: 2020-13-50", "is not YAML ("),
        ("a: 2020-01-01", "is damaged: a is of type date"),
        ("a: \udcff", "is not YAML ("),
    ],
    ids=shown,
)
def test_dangers_in_yaml_are_named(tmp_path, text, fault):
    (tmp_path / "a.yaml").write_text(text, errors="surrogateescape")
    with pytest.raises(DamagedError) as error:
        read_yaml(tmp_path / "a.yaml")
    assert error.value.reason.startswith(fault)


def test_yaml_up_to_the_limits_is_read(tmp_path, monkeypatch):
    file = tmp_path / "a.yaml"
    shallow = (
        "[" + ",".join(["[]"] * (MAX_DEPTH + 5)) + "]"
    )  # a level that has ended counts no more
    for text, value in (
        ("[" * MAX_DEPTH + "]" * MAX_DEPTH, nested(MAX_DEPTH - 1, [])),
        ("a: " + "b" * MAX_WORD, {"a": "b" * MAX_WORD}),
        (f'a: "{"1" * (MAX_WORD + 1)}"', {"a": "1" * (MAX_WORD + 1)}),
        ('a: "<<"', {"a": "<<"}),
        (shallow, [[]] * (MAX_DEPTH + 5)),
        ("a: .inf", {"a": float("inf")}),
        ("? [1]\n: 2\n? [2]\n: 3", None),
        ("", None),
    ):
        file.write_text(text)
        if text.startswith("?"):
            with pytest.raises(DamagedError):
                read_yaml(file)
        else:
            assert read_yaml(file) == value
    monkeypatch.setattr(parsing, "MAX_YAML_BYTES", 4)
    file.write_text("a: 1")
    assert read_yaml(file) == {"a": 1}
    file.write_text("a: 12")
    with pytest.raises(DamagedError, match="more than 4 bytes"):
        read_yaml(file)


def test_json_is_read_if_it_is_plain(tmp_path):
    file = tmp_path / "a.json"
    for text, said in (
        ("{", r"is not JSON \("),
        ('{"a": 1e999}', "is damaged: a is inf, which"),
        ("[" * 300 + "]" * 300, "is not JSON|more than"),
    ):
        file.write_text(text)
        with pytest.raises(DamagedError, match=said):
            read_json(file)
    file.write_text('{"a": [1, null]}')
    assert read_json(file) == {"a": [1, None]}


def test_no_record_has_a_decorator_of_its_own():
    """`Record` makes the dataclass; a second one would lose the defaults made by factories."""
    for file in Path(parsing.__file__).parent.rglob("*.py"):
        text = file.read_text(encoding="utf-8")
        assert not re.search(r"^@dataclass.*\nclass \w+\(Record\)", text, re.MULTILINE), file


class Row(Record):
    amount: Amount
    name: Text = "a"
    counts: dict[str, Count] = field(default_factory=dict)
    whole: Whole = 0
    number: Number = 0.0

    def __post_init__(self):
        if self.name == "wrong":
            raise ValueError("Name is wrong")


@pytest.mark.parametrize(
    "content, reason",
    table(__file__, "records"),
)
def test_a_record_that_does_not_fit_is_described(content, reason):
    with pytest.raises(DamagedError) as error:
        parse_typed(content.encode(), Row, Path("a.json"))
    assert error.value.reason.startswith(reason)


def test_a_record_is_kept_without_its_defaults_and_unknown_keys_are_ignored(tmp_path):
    row = Row(amount=0, counts={"b": 2**63 - 1}, whole=1 - 2**63)
    assert row.to_json() == {"amount": 0, "counts": {"b": 2**63 - 1}, "whole": 1 - 2**63}
    assert Row(amount=0, name="b").to_json() == {"amount": 0, "name": "b"}
    file = tmp_path / "a.json"
    assert read_if_sound(file, Row) is None
    write(file, row.to_json() | {"later": 1})
    assert read_typed(file, Row) == read_if_sound(file, Row) == row
    file.write_text("{")
    assert read_if_sound(file, Row) is None


@pytest.mark.parametrize(
    "content, amounts, warned",
    table(__file__, "rows"),
)
def test_rows_are_read_up_to_the_first_damaged_one(content, amounts, warned, caplog):
    rows = list(iterate_rows(content.encode(), Row, Path("a.jsonl")))
    assert [row.amount for _, row in rows] == amounts
    assert [json.loads(line)["amount"] for line, _ in rows] == amounts
    assert not any(line.endswith(("\n", "\r")) for line, _ in rows)
    assert len(caplog.messages) == bool(warned)
    assert warned in caplog.text


def kinds_below(kind):
    return {kind}.union(*map(kinds_below, kind.__subclasses__()))


def strict_parts(schema):
    """The tuples and dataclasses of a schema that accept nothing else than instances."""
    if isinstance(schema, list):
        return [part for item in schema for part in strict_parts(item)]
    if not isinstance(schema, dict):
        return []
    is_own = schema.get("type") in ("tuple", "dataclass") and schema.get("strict") is not False
    return [schema] * is_own + strict_parts(list(schema.values()))


def test_all_records_accept_the_lists_and_objects_of_json():
    """A dataclass within a record that is no record itself needs Record's schema."""
    for name in ("gsbench.pipeline.trial", "gsbench.analysis.frames", "gsbench.tracking.sync"):
        importlib.import_module(name)  # between them they import all that is written
    kinds = kinds_below(Record) - {Record}
    assert len(kinds) > 20
    for kind in kinds:
        assert strict_parts(adapter(kind).core_schema) == [], kind
