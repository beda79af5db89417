"""Every sentence of a note, read aloud: grammar, units, and no word that only insiders know."""

import ast
import re

import pytest

from gsbench.analysis.notes import SENTENCES, Note
from gsbench.words import FORM
from tests.analysis.tables import TABLES
from tests.conftest import ROOT

FIELD = re.compile(r"\{(\w+)(?::([^{}]*))?\}")
# words of the source that a reader does not know, and abbreviations of its authors
PRIVATE = ("room", "rooms", "ingredient", "verdicts.py", "None", "record", "kwargs", "cfg", "impl")
COUNTED = (
    "trials",
    "pairs",
    "seeds",
    "scenes",
    "rounds",
    "points",
    "photographs",
    "choices",
    "views",
)
NUMBERS = ("missing", "near", "tested", "trials", "more", "limit", "largest")  # facts
PLURAL = "(are|were|have|count|differ|do)"


def read_aloud(kind, number):
    """The sentence of a kind with made-up facts, of which numbers are ``number``."""
    facts = {}
    for name, spec in FIELD.findall(SENTENCES[kind]):
        if spec in ("few", "all", "list", "parts"):
            facts[name] = tuple(f"{name} {k}" for k in range(number))
        elif spec.startswith("n ") or name in NUMBERS:
            facts[name] = number
        else:
            facts.setdefault(name, f"<{name}>")
    return str(Note.of(kind, **facts))


@pytest.mark.parametrize("number", [1, 2, 5])
@pytest.mark.parametrize("kind", SENTENCES)
def test_a_sentence_reads_well(kind, number):
    said = read_aloud(kind, number)
    assert not re.search(r"[{}]|  |\.\.| [.,;:)]|\( ", said), said
    assert said == said.strip()
    words = re.findall(r"[\w.]+", re.sub(r"<\w+>|`[^`]*`", "", said))
    assert not set(words) & set(PRIVATE), said
    one = re.findall(r"\b1 (\w+)", said)
    assert not set(one) & set(COUNTED), said
    # neither does one thing, nor a list of one, have the verb of many
    assert not re.search(rf"\b1 (\w+|of [^.,:;()]*) {PLURAL}\b", said), said
    if number == 1:
        assert not re.search(rf"(?<!of )\b\w+ 0 {PLURAL}\b", said), said
    # a unit follows its number after a blank, and a percentage too
    assert not re.search(r"\d(dB|px|s|%)(\W|$)", said), said
    # a sentence begins with a capital, a name, a number or a mark, and a fragment has no full stop
    if said[0].islower():
        assert not said.endswith("."), said
    assert said.count("(") == said.count(")"), said


def test_the_facts_of_a_note_are_kept_and_compared():
    note = Note.of("uneven", least=1, scenes=["a", "b"], most=3)
    assert note == Note.of("uneven", least=1, scenes=("a", "b"), most=3)
    assert note != Note.of("uneven", least=2, scenes=["a", "b"], most=3)
    assert (note["scenes"], len({note, note})) == (("a", "b"), 1)
    assert str(note) == (
        "1 seed of each scene can count: there are no more of a, b (others have up to 3)"
    )


@pytest.mark.parametrize(
    "form, said",
    TABLES["forms of facts"],
)
def test_facts_are_formatted(form, said):
    facts = {"n": 1, "names": tuple("abcd"), "none": "", "share": 0.5}
    assert FORM.format(form, **facts) == said


def test_every_sentence_is_used_and_every_note_has_one():
    used = set()
    for path in (ROOT / "src").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Constant) and path.name != "notes.py":
                used.add(node.value)
            if isinstance(node, ast.Call) and ast.unparse(node.func) == "Note.of":
                kinds = [
                    one.value for one in ast.walk(node.args[0]) if isinstance(one, ast.Constant)
                ]
                names = isinstance(node.args[0], ast.Name)
                assert names or set(kinds) & SENTENCES.keys(), ast.unparse(node)
    assert not SENTENCES.keys() - used
