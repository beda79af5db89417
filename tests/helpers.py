"""What tests of all packages need: an expected refusal, and files that are written and read."""

import json
from contextlib import contextmanager
from pathlib import Path
from shlex import split

import pytest

from gsbench.errors import InputError
from gsbench.parsing import table_beside


@contextmanager
def refusal(pattern):
    """Expect an error of the user's in the block: one line, in which ``pattern`` is found.

    If that is None, expect none.
    """
    if pattern is None:
        yield
        return
    with pytest.raises(InputError, match=pattern) as caught:
        yield caught
    assert "\n" not in str(caught.value)


def table(test, name):
    """The cases ``name`` in the YAML file beside a test's file, which has its name."""
    return table_beside(test, f"{Path(test).stem}.yaml")[name]


def write(path, content):
    """Write a text, bytes or JSON values to a file and return its path; its folder is made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def write_lines(path, rows):
    """Write JSON values to a file, one a line."""
    return write(path, "".join(json.dumps(row) + "\n" for row in rows))


def change_json(path, **changes):
    """Change keys of the object in a JSON file; returns the object as it was."""
    before = read_json(path)
    write(path, before | changes)
    return before


def words_of(first, *more):
    """The words of a command; the first argument may be a verb or an option with words after it."""
    return [*([first] if "=" in first.partition(" ")[0] else split(first)), *map(str, more)]


def read_json(path):
    return json.loads(path.read_text())
