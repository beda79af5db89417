"""Pages of the site that are generated from the code.

They list all settings, the keys of ``results.json``, the rules of captures, and the public names.
``python scripts/reference.py settings|results|rules|api`` prints one of them as Markdown,
``schema`` the JSON Schema.
"""

from __future__ import annotations

import ast
import dataclasses
import importlib
import inspect
import io
import json
import math
import re
import sys
import textwrap
import tokenize
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from string import Formatter
from typing import Any, get_type_hints

import yaml

from gsbench.config.schema import GROUP_SCHEMAS, Config
from gsbench.parsing import adapter
from gsbench.runs.trial_record import TrialRecord
from gsbench.scene.rules import RULES
from gsbench.settings import MISSING, describe, option_fields

ROOT = Path(__file__).resolve().parents[1]
PYTHON_BLOCK = re.compile(r"^```python\n(.*?)^```$", re.DOTALL | re.MULTILINE)


# --- comments of fields ---------------------------------------------------------------------------


@cache
def comments_of(cls: type) -> dict[str, str]:
    """The comments above fields and at the ends of their lines, of a class and its base classes."""
    comments: dict[str, str] = {}
    for kind in reversed(cls.__mro__):
        if not kind.__module__.startswith("gsbench"):
            continue
        source = Path(str(inspect.getsourcefile(kind))).read_text(encoding="utf-8")
        source_lines = source.splitlines()
        at_line = {
            token.start[0]: token.string.lstrip("# ")
            for token in tokenize.generate_tokens(io.StringIO(source).readline)
            if token.type == tokenize.COMMENT
        }
        (node,) = (
            n
            for n in ast.walk(ast.parse(source))
            if isinstance(n, ast.ClassDef) and n.name == kind.__name__
        )
        for entry in node.body:
            if isinstance(entry, ast.AnnAssign) and isinstance(entry.target, ast.Name):
                first = entry.lineno
                while source_lines[first - 2].lstrip().startswith("#"):
                    first -= 1
                lines = range(first, (entry.end_lineno or entry.lineno) + 1)
                words = " ".join(
                    at_line[line]
                    for line in lines
                    if line in at_line and "noqa" not in at_line[line]
                )
                comments[entry.target.id] = words.removeprefix("type: ignore[misc]").strip()
    return comments


def row(*cells: str) -> str:
    """One row of a table, with pipes and line breaks escaped."""
    return "| " + " | ".join(cell.replace("|", "\\|").replace("\n", " ") for cell in cells) + " |"


def table(*heads: str) -> list[str]:
    return [row(*heads), row(*("---" for _ in heads))]


def default_text(value: Any) -> str:
    """A default, nearly as YAML writes it."""
    if value == MISSING or value is dataclasses.MISSING:
        return ""
    text = json.dumps(value, default=str)
    return f"`{text if len(text) <= 60 else text[:57] + '...'}`"


# --- settings -------------------------------------------------------------------------------------

HEADS = ("setting", "allowed", "default", "meaning")


def settings_of(cls: type, group: str, leave_out: frozenset[str] = frozenset()) -> Iterator[str]:
    """The settings of a dataclass, one row each."""
    hints = get_type_hints(cls, include_extras=True)
    for entry in option_fields(cls):
        if entry.name in leave_out or entry.name.startswith("_"):
            continue
        default = (
            entry.default
            if entry.default_factory is dataclasses.MISSING
            else entry.default_factory()
        )
        key = f"{group}.{entry.name}" if group else entry.name
        meaning = comments_of(cls).get(entry.name, "")
        yield row(f"`{key}`", describe(hints[entry.name]), default_text(default), meaning)


def classes_of(group: str) -> dict[str, tuple[type, list[str]]]:
    """The classes that a group's files name, each with the choices that name it."""
    classes: dict[str, tuple[type, list[str]]] = {}
    for file in sorted((ROOT / "conf" / group).glob("*.yaml")):
        target = str((yaml.safe_load(file.read_text(encoding="utf-8")) or {}).get("_target_", ""))
        if target:
            module, _, name = target.rpartition(".")
            cls = getattr(importlib.import_module(module), name)
            classes.setdefault(target, (cls, []))[1].append(file.stem)
    return classes


def settings_page() -> str:
    """All settings: of the root, of each group, and of each class that a group's files name."""
    lines = [
        "Defaults are those of the class; a file below `conf/` may set another.",
        "",
    ]
    groups = frozenset({*GROUP_SCHEMAS, "init", "densify"})
    lines += [
        "### The root",
        "",
        *table(*HEADS),
        *settings_of(Config, "", groups),
        "",
    ]
    for group, cls in GROUP_SCHEMAS.items():
        lines += [f"### {group}", "", *table(*HEADS), *settings_of(cls, group), ""]
    for group in ("init", "densify"):
        lines += [f"### {group}", "", "A class also has the settings of its base class.", ""]
        listed: set[type] = set()
        for cls, choices in classes_of(group).values():
            for kind in reversed(cls.__mro__):
                if kind in listed or not dataclasses.is_dataclass(kind):
                    continue
                listed.add(kind)
                bases = [base for base in kind.__mro__[1:] if dataclasses.is_dataclass(base)]
                own = set(inspect.get_annotations(kind))
                inherited = frozenset(f.name for f in dataclasses.fields(kind) if f.name not in own)
                rows = list(settings_of(kind, group, inherited))
                named = f" (`{group}={'`, `'.join(choices)}`)" if kind is cls else ""
                based = f", base class `{bases[0].__name__}`" if bases else ""
                if rows or named:
                    summary = as_markdown((inspect.getdoc(kind) or "").partition("\n")[0])
                    lines += [f"**`{kind.__name__}`**{named}{based}. {summary}", ""]
                lines += [*table(*HEADS), *rows, ""] if rows else []
    return "\n".join(lines) + "\n"


# --- results.json ---------------------------------------------------------------------------------


def schema() -> dict[str, Any]:
    """The JSON Schema of ``results.json``."""
    title = {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "results.json of gsbench",
    }
    return title | adapter(TrialRecord).json_schema(ref_template="#/$defs/{model}")


def schema_text() -> str:
    return json.dumps(schema(), indent=1) + "\n"


def type_text(part: dict[str, Any]) -> str:
    """The type of a value in words, from its JSON Schema."""
    if "$ref" in part:
        return f"[{part['$ref'].rpartition('/')[2]}](#{part['$ref'].rpartition('/')[2].lower()})"
    if "anyOf" in part:
        return " or ".join(type_text(option) for option in part["anyOf"])
    if "const" in part or "enum" in part:
        return " or ".join(f'`"{value}"`' for value in part.get("enum", [part.get("const")]))
    kind = part.get("type", "anything")
    if kind == "object":
        inner = part.get("additionalProperties")
        return f"{{text: {type_text(inner)}}}" if isinstance(inner, dict) else "object"
    if kind == "array":
        inner = part.get("prefixItems") or [part.get("items") or {}]
        return f"[{', '.join(type_text(item) for item in inner)}]"
    least = " ≥ 0" if part.get("minimum") == 0 else ""
    return {
        "string": "text",
        "integer": "whole number",
        "number": "number",
        "boolean": "true or false",
    }.get(kind, kind) + least


def results_page() -> str:
    """The keys of ``results.json``, followed by the keys of its nested objects."""
    whole = schema()
    records = importlib.import_module(TrialRecord.__module__)
    lines: list[str] = []
    for name, part in {"TrialRecord": whole, **whole.get("$defs", {})}.items():
        cls = getattr(records, name)
        lines += [
            f"### {'The file' if cls is TrialRecord else name}",
            "",
            as_markdown(inspect.getdoc(cls) or ""),
            "",
        ]
        lines += table("key", "value", "", "meaning")
        required = set(part.get("required", ()))
        for key, value in part["properties"].items():
            presence = "always" if key in required else "optional"
            lines.append(row(f"`{key}`", type_text(value), presence, comments_of(cls).get(key, "")))
        lines.append("")
    return "\n".join(lines) + "\n"


def as_markdown(text: str) -> str:
    """A docstring as Markdown."""
    return text.replace("``", "`")


# --- rules of captures ----------------------------------------------------------------------------


def limits(values: tuple[float, float]) -> str:
    """A range of values in words, to four digits."""
    low, high = (f"{round(value, 9):.4g}" for value in values)
    if 0 < values[0] < 1e-300:
        return "above 0"
    if math.isinf(values[0]):
        return "" if math.isinf(values[1]) else f"at most {high}"
    return f"at least {low}" if math.isinf(values[1]) else f"{low} to {high}"


def rules_page() -> str:
    """The rules of captures; a sentence has an ellipsis for each fact."""
    lines = table("rule", "a line, unless", "refused, unless", "what it says")
    for rule in RULES:
        refused = limits(rule.usable) + " (always)" * rule.fixed or "never"
        parts = [text + "…" * bool(name) for text, name, *_ in Formatter().parse(rule.say)]
        said = textwrap.shorten("".join(parts), 80, placeholder=" …")
        lines.append(row(f"`{rule.id}`", limits(rule.fine), refused, said))
    return "\n".join(lines).replace("at most 1 (always)", "below 1 (always)") + "\n"


# --- public names ---------------------------------------------------------------------------------


def public_names() -> dict[str, list[str]]:
    """The public names by module: a package's ``__all__``, and what the documents import."""
    public: dict[str, set[str]] = {}
    for file in sorted((ROOT / "src" / "gsbench").glob("*/__init__.py")):
        module = f"gsbench.{file.parent.name}"
        for node in ast.parse(file.read_text(encoding="utf-8")).body:
            if (
                isinstance(node, ast.Assign)
                and isinstance(node.targets[0], ast.Name)
                and node.targets[0].id == "__all__"
            ):
                public.setdefault(module, set()).update(ast.literal_eval(node.value))
    for page in (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))):
        for block in PYTHON_BLOCK.findall(page.read_text(encoding="utf-8")):
            for node in ast.walk(ast.parse(block)):
                if isinstance(node, ast.ImportFrom) and str(node.module).startswith("gsbench."):
                    public.setdefault(str(node.module), set()).update(
                        alias.name for alias in node.names
                    )
    # packages with an `__all__` for the program's own use
    internal = ("gsbench.bench", "gsbench.tracking")
    return {
        module: sorted(names) for module, names in sorted(public.items()) if module not in internal
    }


def api_page() -> str:
    """A page of mkdocstrings: each public name under its module."""
    lines = [
        "# Public names",
        "",
        "A program may rely on these names, and on no others "
        "([how long](contributing.md#what-stays-stable)).",
        "",
    ]
    for module, names in public_names().items():
        lines += [f"## {module}", ""]
        for name in names:
            lines += [f"::: {module}.{name}", "    options:", "      heading_level: 3", ""]
    return "\n".join(lines)


PAGES = {
    "settings": settings_page,
    "results": results_page,
    "rules": rules_page,
    "api": api_page,
}

if __name__ == "__main__":
    if sys.argv[1:2] == ["schema"]:
        print(schema_text(), end="")
    else:
        print(PAGES[sys.argv[1]]())
