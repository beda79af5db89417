"""Keys of ``results.json`` for a trial that gsbench did not train itself."""

from __future__ import annotations

from typing import Final

# ``evaluated_from``: the model was rendered here, or renders are all that is known.
FROM_MODEL: Final = "model"
FROM_RENDERS: Final = "renders"
MADE_ELSEWHERE = "made by another program"  # how the reason of a quantity starts that nobody can know of such a trial
RENDERS_ALONE = f"{MADE_ELSEWHERE}, of which only the renders are known"
