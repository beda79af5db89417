"""Limits of ``${…}`` in a configuration, by whomever it was written. Loads no Hydra."""

from collections.abc import Iterator, Sequence
from typing import Any

from omegaconf.errors import GrammarParseError
from omegaconf.grammar_parser import parse

from gsbench.config.permissions import permission_advice
from gsbench.config.programs import is_readable, reading
from gsbench.errors import InputError
from gsbench.runs.nested import entries_of

# Resolvers that make only texts and numbers. Resolvers that turn texts into mappings (oc.create,
# oc.decode, oc.dict) could create a `_target_` after the check; resolvers of plug-ins could do
# anything.
RESOLVERS = ("hydra", "now", "oc.env", "oc.select", "python_version")
# Hydra 1.4's own values, whose resolvers join the words of a job. With arguments they would call
# other resolvers.
HYDRAS_VALUES = ("${hydra_override_dirname:}", "${hydra_deprecated_override_dirname:}")


def check_texts(values: Any, allowed: Sequence[str], file: str = "") -> None:
    """Refuse a ``${…}`` at any depth of ``values``, also in a key, that may not be resolved.

    ``file`` is named in the InputError.
    """
    for place, key, value in entries_of(values):
        where = f"{file}: " * bool(file) + ".".join((*place, key))
        for text in (key, value):
            if isinstance(text, str) and "${" in text:
                check_interpolation(where, key, text, allowed)


def check_interpolation(where: str, key: str, value: str, allowed: Sequence[str]) -> None:
    if value in HYDRAS_VALUES:
        return
    if key.startswith("_") and key.endswith("_"):  # the checked name would not be the imported one
        raise InputError(
            f"{where}={value}: write the name itself here, since ${{…}} may become another"
        )
    try:
        calls = list(_calls(parse(value)))
    # OmegaConf cannot resolve it either, and says so when the value is read
    except GrammarParseError:
        return
    for name, first in calls:
        if name not in RESOLVERS:
            raise InputError(
                f"{where}={value}: ${{{name}:…}} is not resolved here, only {', '.join(RESOLVERS)}"
            )
        # Its value would stand in results, archives and trackers, where others read it.
        if name == "oc.env" and not is_readable(first, allowed):
            advice = permission_advice([reading(first)], allowed)
            raise InputError(
                f"{where}={value} reads the variable {first}, which may be secret; if you want "
                f"its value in results, {advice}"
            )


def _calls(tree: Any) -> Iterator[tuple[str, str]]:
    """The resolvers in a parsed text, each with its first argument.

    What is itself an interpolation is yielded as written.
    """
    parts = list(getattr(tree, "children", None) or [])
    for name, *rest in (parts[k:] for k in range(len(parts))):
        if type(name).__name__ == "ResolverNameContext":
            listed = [part for part in rest if type(part).__name__ == "SequenceContext"]
            first = listed[0].getChild(0).getText() if listed else ""
            yield name.getText(), first.strip().strip("'\"")
        yield from _calls(name)
