"""Messages of several lines in the source: none is left ragged, none is printed with a break."""

import ast
import re
from itertools import pairwise

import pytest

from gsbench.words import split_outside_brackets
from tests.conftest import ROOT

WIDTH, SPARE = 100, 10
PART = re.compile(r'^ *(f?)"((?:[^"\\]|\\.)*)"$')  # a line that is one part of a text
BREAK = re.compile(r"[a-z,] ?\n[a-z]")
ENDS = tuple(".,:;)")  # a line may be short after one of these


def first_word(text):
    """The first word of a part; a replacement field is not broken."""
    return split_outside_brackets(text, " ")[0]


def ragged_lines(source):
    """The numbers of the lines that break a sentence early: the next word has ample room."""
    lines = source.split("\n")
    for number, (line, after) in enumerate(pairwise(lines), 1):
        one, other = PART.match(line), PART.match(after.rstrip(",)"))
        if one is None or other is None or one[2].rstrip().endswith(ENDS) or "\\n" in one[2]:
            continue
        if len(line) + len(first_word(other[2])) + SPARE <= WIDTH:
            yield number


def broken_texts(source):
    """The texts, without docstrings, that break a line within a sentence."""
    tree = ast.parse(source)
    statements = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        text = getattr(node, "value", None)
        if id(node) not in statements and isinstance(text, str) and BREAK.search(text):
            yield text


FILES = sorted((ROOT / "src").rglob("*.py"))


def test_no_message_is_ragged():
    found = [f"{path}:{line}" for path in FILES for line in ragged_lines(path.read_text())]
    assert not found


def test_no_message_is_printed_with_a_break_within_a_sentence():
    assert not [text for path in FILES for text in broken_texts(path.read_text())]


@pytest.mark.parametrize(
    "source, lines",
    [
        ('"a setting that had "\n"no effect at this size"', [1]),
        ('f"of {a!r} and "\nf"{listed(b)} are"', [1]),
        ('"the end of a sentence. "\n"Another one."', []),
        (f'"{"x " * 45}"\n"and so on"', []),
        ('"a line\\n"\n"b"', []),
    ],
)
def test_a_ragged_message_is_found(source, lines):
    assert list(ragged_lines(source)) == lines


def test_a_text_with_a_break_is_found():
    assert list(broken_texts('x = "a word\\nand another"')) == ["a word\nand another"]
    assert not list(broken_texts('"""A docstring\nof two lines."""\nx = "One.\\nTwo."'))
