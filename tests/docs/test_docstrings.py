"""Docstrings begin with a verb or a noun, and their examples are true."""

import ast
import doctest
import importlib
import re

import pytest

from gsbench.densify import Densifier
from gsbench.eval.metric import Metric
from gsbench.external.settings import External
from gsbench.init.base import Initializer
from gsbench.raster import Rasterizer
from gsbench.tracking.sinks import Sink
from tests.conftest import ROOT

PROMPT = re.compile(r"^\s*>>> ", re.MULTILINE)
SOURCES = {
    ".".join(path.relative_to(ROOT / "src").with_suffix("").parts).removesuffix(".__init__"): path
    for path in sorted((ROOT / "src/gsbench").rglob("*.py"))
    if PROMPT.search(path.read_text(encoding="utf-8"))
}
# First words that are neither verb nor noun, nor lead to a noun: question words, pronouns,
# prepositions, conjunctions.
UNPLAIN = frozenset(
    re.findall(
        r"\w+",
        """what whatever whether how where wherever which whichever why when whenever who whom whose does is are can
        nobody nothing none those these this that such it its he she they we you our here there
        of for from in into on onto at by with within without to up out about above below behind beside between under
        over before after until since as if because unless while than not never once and or but so""",
    )
)
TITLED = (*(ROOT / "conf").rglob("*.yaml"), *(ROOT / "src").rglob("*.yaml"))


def public_docstrings(tree):
    """Line and text of a module's public docstrings, also of its classes, functions and methods."""
    pending = [tree]
    while pending:
        node = pending.pop()
        text = ast.get_docstring(node)
        if text:
            yield node.body[0].lineno, text
        if isinstance(node, ast.Module | ast.ClassDef):
            pending += [
                entry
                for entry in node.body
                if isinstance(entry, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef)
                and not entry.name.startswith("_")
            ]


def comments(text):
    """Line and text of comments on lines of their own; of a block, the first line only."""
    block = False
    for number, line in enumerate(text.splitlines(), 1):
        stripped = line.lstrip()
        if stripped.startswith("#") and not block:
            yield number, stripped.lstrip("#")
        block = stripped.startswith("#") and not stripped.startswith("# @package")


def first_word(text):
    return re.split(r"[^a-z'’]+", text.strip().lower(), maxsplit=1)[0]


def unplain(path):
    text = path.read_text(encoding="utf-8")
    found = [] if path.suffix == ".yaml" else [*public_docstrings(ast.parse(text))]
    bad = [(line, words) for line, words in found if first_word(words) in UNPLAIN]
    # A comment may say when or for what something is; as a title it names it.
    bad += [
        (line, words)
        for line, words in comments(text)
        if first_word(words) in {"what", "whether", "how", "which"}
    ]
    return [
        f"{path.relative_to(ROOT)}:{line}: {words.strip().splitlines()[0]}"
        for line, words in sorted(bad)
    ]


def test_docstrings_and_titles_begin_with_a_verb_or_a_noun():
    paths = sorted({*(ROOT / "src").rglob("*.py"), *(ROOT / "scripts").rglob("*.py"), *TITLED})
    assert len(paths) > 200
    assert [line for path in paths for line in unplain(path)] == []


@pytest.mark.parametrize(
    "source, lines",
    [
        ('"""What it is."""', [1]),
        ('def run():\n    """Whether it runs."""', [2]),
        ('async def run():\n    """``how`` it runs."""', []),
        ('class A:\n    """Nobody."""\n    def a(self):\n        """\n        Of all."""', [2, 4]),
        (
            'class _A:\n    """What."""\n    def a(self):\n        """What."""\ndef _b():\n    """What."""',
            [],
        ),
        ('"""The file.\n\nWhat it holds."""\n# What is next\n# Which\na = 1  # what', [4]),
    ],
)
def test_unplain_words_are_found(source, lines):
    found = [
        line for line, words in public_docstrings(ast.parse(source)) if first_word(words) in UNPLAIN
    ]
    found += [line for line, words in comments(source) if first_word(words) in UNPLAIN]
    assert sorted(found) == lines


@pytest.mark.parametrize("name", SOURCES)
def test_examples_in_docstrings_are_true(name, capsys):
    result = doctest.testmod(importlib.import_module(name))
    assert result.failed == 0, capsys.readouterr().out
    written = len(PROMPT.findall(SOURCES[name].read_text(encoding="utf-8")))
    # No example is where doctest does not look, such as in a decorated function.
    assert result.attempted == written


@pytest.mark.parametrize(
    "extended, word",
    [
        *((extended, "class ") for extended in (Densifier, Initializer, Metric, Rasterizer, Sink)),
        (External, "command="),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_classes_that_users_extend_have_an_example(extended, word):
    assert extended.__module__ in SOURCES
    assert word in (extended.__doc__ or "").partition("Examples:")[2]


BREAK = re.compile(r"[a-z,] ?\n[a-z]")


def broken_texts(source):
    """The texts, without docstrings, that break a line within a sentence."""
    tree = ast.parse(source)
    statements = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        text = getattr(node, "value", None)
        if id(node) not in statements and isinstance(text, str) and BREAK.search(text):
            yield text


def test_no_message_is_printed_with_a_break_within_a_sentence():
    assert list(broken_texts('x = "a word\\nand another"')) == ["a word\nand another"]
    assert not list(broken_texts('"""A docstring\nof two lines."""\nx = "One.\\nTwo."'))
    files = (ROOT / "src").rglob("*.py")
    assert not [text for path in files for text in broken_texts(path.read_text())]


def test_examples_are_sections_so_that_the_site_shows_them_as_code():
    for path in SOURCES.values():
        for before, line in re.findall(
            r"^( *)>>> (.*)$", path.read_text(encoding="utf-8"), re.MULTILINE
        ):
            assert len(before) >= 8, f"{path.name}: {line} stands in no section Examples:"
