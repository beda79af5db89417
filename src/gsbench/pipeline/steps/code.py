"""Steps that know which code they are made by: gsbench's own, and the user's."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from gsbench.errors import InputError
from gsbench.pipeline.components import own_names
from gsbench.runs.code import changed_while_running, edited, files_of
from gsbench.runs.source import OWN, gsbench_imports, source_of
from gsbench.runs.step import Stage, Step


def step_of_code(
    stage: Stage,
    inputs: dict[str, Any],
    build: Callable[[Path], None],
    module: str,
    components: Sequence[tuple[Any, str | None]] = (),
    in_processes: bool = False,
) -> Step:
    """A step whose inputs also name the files of gsbench that ``module`` and the ``components`` of the trial reach,
    where these are not as released.

    Each component comes with the import path by which the configuration names its class, if it does so.
    ``in_processes``: the work is done in processes of their own, which load the code anew.
    """
    modules = {type(component).__module__ for component, _ in components}
    roots: list[tuple[str, str | None]] = [(module, None)]
    roots += [(name, None) for name in sorted(modules) if f"{name}.".startswith(OWN)]
    own = sorted({tuple(names) for component, target in components if (names := own_names(component, target))})
    asked = [imported for names in own for imported in gsbench_imports(*names)]
    code, sources = files_of(roots, asked), {names: source_of(*names) for names in own}

    def check() -> None:
        late = [f"gsbench's {file}" for file in changed_while_running(code, in_processes)]
        late += [f"the code of {names[0]}" for names in own if source_of(*names) != sources[names]]
        if late:
            raise InputError(f"{', '.join(late)} changed while {stage.name} ran, which may have used both: start again")

    changed = edited(code)
    return Step(stage, inputs | ({"code": changed} if changed else {}), build, code, check)
