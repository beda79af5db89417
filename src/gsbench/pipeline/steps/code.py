"""Steps that know which code they are made by: gsbench's own, and the user's."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from gsbench.errors import InputError
from gsbench.runs.code import changed_while_running, edited, files_of
from gsbench.runs.source import OWN, gsbench_imports, source_of
from gsbench.runs.step import Stage, Step


def step_of_code(
    stage: Stage,
    inputs: dict[str, Any],
    build: Callable[[Path], None],
    module: str,
    components: Sequence[Any] = (),
    in_processes: bool = False,
) -> Step:
    """A step whose inputs also name the files of gsbench that ``module`` and the ``components`` of the trial reach,
    where these are not as released.

    ``in_processes``: the work is done in processes of their own, which load the code anew.
    """
    targets = sorted({f"{type(component).__module__}.{type(component).__qualname__}" for component in components})
    own = [target for target in targets if not target.startswith(OWN)]
    roots: list[tuple[str, str | None]] = [(module, None)]
    roots += [(target.rpartition(".")[0], None) for target in targets if target.startswith(OWN)]
    for target in own:
        roots += gsbench_imports(target)
    code, sources = files_of(roots), {target: source_of(target) for target in own}

    def check() -> None:
        late = [f"gsbench's {file}" for file in changed_while_running(code, in_processes)]
        late += [f"the code of {target}" for target in own if source_of(target) != sources[target]]
        if late:
            raise InputError(f"{', '.join(late)} changed while {stage.name} ran, which may have used both: start again")

    changed = edited(code)
    return Step(stage, inputs | ({"code": changed} if changed else {}), build, code, check)
