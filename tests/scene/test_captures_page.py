"""docs/captures.md has the present table of rules."""

from scripts import captures_page as captures


def test_the_table_of_rules_in_the_page_is_current():
    text = captures.PAGE.read_text("utf-8")
    assert captures.page(text) == text, "run python -m scripts.captures"
    assert "| `lens-turns-back` | at most 0 | at most 0.01 |" in text
