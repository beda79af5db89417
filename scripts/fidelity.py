"""docs/fidelity.md: each arm, its source, what of it was compared with a restatement, and the largest difference found.

    python scripts/fidelity.py            say whether the page is what the tests measure
    python scripts/fidelity.py --write    write it

The restatements are those of the tests below tests/densify: one Gaussian at a time in numpy, from the facts of the
source, no code shared with gsbench or with the source. Differences are relative to the larger of 1 and the value, over
all raw parameters and both Adam moments of every Gaussian after a round, in float64; the page states the next power of
ten. Of the cases of a test the first and the last are measured; the test itself holds for all.
"""

from __future__ import annotations

import importlib
import inspect
import itertools
import math
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "fidelity.md"
ROW = re.compile(r"^\| `(\w+)` \|.*\| (0|1e-\d+) \|[^|]*\|$", re.MULTILINE)
HEAD = """# How near each arm is to its source

Made by `scripts/fidelity.py --write`; a test makes it again and compares. Sources were read for facts; nothing was
copied, and none of them was run here. So a row says: what the source does, as it was understood, was written down a
second time, one Gaussian at a time in numpy (`tests/densify/`), and gsbench's arm did the same on made-up Gaussians
with uneven Adam moments: the same Gaussians in the same order, the same parameters and moments, the same counts. The
largest difference is relative to the larger of 1 and the value, in float64, rounded up to a power of ten. Draws are
those of gsbench's generator: a source draws others.

| `densify=` | source | compared | largest difference | not implemented, or otherwise |
|---|---|---|---|---|
"""
TAIL = """
What the rasterizer and the optimiser do is compared elsewhere: every executor with the float64 reference
(`tests/raster`), the learning rates and the schedule in `tests/pipeline`. Presets of learning rates stand in
`conf/train/` with their sources.

DashGaussian's schedule of sizes (`train.resolution_schedule`; YouyuChen0207/DashGaussian 4e3b560,
`utils/schedule_utils.py`, `train_dash.py:75`, `:182`) is stated again in `tests/train/test_resolution.py`: the
same size at every iteration. Otherwise there: it prunes before it grows, by opacity alone, and growth at the limit
replaces what was pruned; clones and splits each take the whole allowance, and the window over a spectrum of odd sides
is a pixel off its mean. Here small pictures have 8 bits.
"""


@dataclass(frozen=True)
class Arm:
    """A row: where the rule is from, the tests of ``module`` that compare it, and what is left out."""

    source: str
    compared: str
    tests: tuple[tuple[str, str], ...]  # module below tests.densify, function
    otherwise: str


ROUND = "a whole round, pruning included"
ARMS = {
    "adc": Arm(
        "graphdeco-inria/gaussian-splatting 1152adc, `scene/gaussian_model.py` (`densify_and_clone`, "
        "`densify_and_split`, `densify_and_prune`), `train.py`",
        f"{ROUND}; the 144 rounds and 4 resets of the schedule",
        (("test_rounds", "test_adc_round"),),
        "a cap (theirs has none); pruning by radius on the screen is off, as it never acts there",
    ),
    "volumetric": Arm(
        "arXiv 2508.05187, eq. 5 to 7, Fig. 4; no code was published",
        f"{ROUND}, in three orders",
        (
            ("test_rounds", "test_volumetric_round"),
            ("test_rounds", "test_volumes_may_be_split_before_the_gradient_rule"),
            ("test_rounds", "test_volumes_may_be_split_after_pruning"),
        ),
        "what the paper leaves open is an option; our choices stand below its table",
    ),
    "volumetric_once": Arm(
        "ours: `volumetric` without splits that would be split again",
        ROUND,
        (("test_rounds", "test_volumetric_once_round"),),
        "",
    ),
    "absgrad": Arm(
        "nerfstudio-project/gsplat, `absgrad` with `grow_grad2d=0.0008`",
        ROUND,
        (("test_rounds", "test_absgrad_round"),),
        "gsplat's own order of a round (`train.step_after_refine=true` has it)",
    ),
    "absgs": Arm(
        "TY424/AbsGS 87d7a5a, `scene/gaussian_model.py:461` and `:260`, `train.py:119`",
        f"{ROUND}; the ceiling of opacities",
        (("test_absgs", "test_absgs_round"),),
        "a cap; pruning by the largest weight, which is off there",
    ),
    "revised": Arm(
        "arXiv 2404.06109, its opacity correction",
        ROUND,
        (("test_rounds", "test_revised_round"),),
        "its error-based growth, its limit of growth",
    ),
    "pixelgs": Arm(
        "zhengzhang01/Pixel-GS 05c9d55, `scene/gaussian_model.py:405`, `train.py:86`",
        f"{ROUND}, for several depths",
        (("test_pixel_gs", "test_pixel_gs_round"),),
        "a cap; the gradients of the optimiser stay as they are near a camera",
    ),
    "longaxis": Arm(
        "XiaoBin2001/Improved-GS d008d11, `scene/gaussian_model.py:425`",
        f"{ROUND}; the split is theirs, the rest is `adc`'s",
        (("test_long_axis", "test_long_axis_round"),),
        "all but the split: `edgeaware` has it",
    ),
    "edgeaware": Arm(
        "XiaoBin2001/Improved-GS d008d11, `train.py:123`, `:129` to `:159`, `:195`, `:205`; "
        "`scene/gaussian_model.py:367`, `:391`",
        f"{ROUND}, closing rounds too; scores; growth control; the prunings around",
        (("test_edge_aware", "test_edge_aware_round"), ("test_edge_aware", "test_the_prunings_of_the_schedule")),
        "fewer optimiser steps after the window; views are drawn anew; no edges in the outermost pixels",
    ),
    "taming": Arm(
        "humansensinglab/taming-3dgs fd0f7d9, `utils/taming_utils.py:40`, `:100`; `scene/gaussian_model.py:459`",
        "scores term by term, and a round without its pruning; the pruning by counts",
        (("test_scores", "test_taming_round"),),
        "opacities above 1 after the window, `--sh_lower`; scores follow their Gaussians through a round",
    ),
    "mcmc": Arm(
        "ubc-vision/3dgs-mcmc 7b4fc9f, `scene/gaussian_model.py:411`, `:472`, `:503`; `train.py:140`; "
        "`utils/reloc_utils.py`",
        "relocation and addition of a round; the noise",
        (("test_mcmc", "test_mcmc_round"), ("test_mcmc", "test_mcmc_noise")),
        "moments of the dead, which are kept there; order of the Gaussians",
    ),
    "resgs": Arm(
        "yanzhelyu/ResGS 6f9b2da, `scene/gaussian_model.py:319`, `:464`, `:483`; `train.py:92` to `:202`",
        f"{ROUND}; the stage at each round of its loop; fading; pauses",
        (("test_res_gs", "test_res_gs_round"),),
        "smaller pictures in the first two phases; a cap",
    ),
    "fastgs": Arm(
        "fastgs/FastGS 44e02a5, `utils/fast_utils.py:45`; `scene/gaussian_model.py:468`, `:533`",
        f"counts and scores; {ROUND}; the final pruning",
        (
            ("test_fast_gs", "test_fast_gs_round"),
            ("test_fast_gs", "test_after_the_window_the_rather_faint_and_those_that_err_most_go"),
        ),
        "fewer optimiser steps, its compact box, flags that differ from scene to scene; scores follow their Gaussians",
    ),
    "gns": Arm(
        "XiaoBin2001/GNS 0c8e7dc, `train.py:105` to `:205`; `scene/gaussian_model.py:471`",
        "growth as `edgeaware`; the pressure with its gradient, its weight over the whole schedule, and the selection "
        "(by tests of their own, to 1e-9)",
        (("test_edge_aware", "test_edge_aware_round"),),
        "as `edgeaware`",
    ),
    "mrnf": Arm(
        "LichtFeld-Studio of April 2026 (th555/lichtfeld-studio 90a8acc), `src/training/strategies/mrnf.cpp:463`, "
        "`:540`; `src/training/kernels/mrnf_kernels.cu:40`, `:97`; no paper",
        f"weights, {ROUND}, decay; noise by its spread",
        (("test_mrnf", "test_mrnf_round"),),
        "weights of all iterations (views are drawn in the round), Canny's edges, of another number of views; rates "
        "that follow the cloud; bounds of every fifth round; noise before the step; pruning of quaternions near zero; "
        "what the version of August 2026 changed (its pull request 1839)",
    ),
    "steepgs": Arm(
        "arXiv 2505.05587, its splitting matrix and halves; facebookresearch/SteepGS 63eee45, `arguments/__init__.py`, "
        "`scene/gaussian_model.py:530`",
        f"{ROUND}; the matrix with second derivatives by autograd (`tests/raster/test_splitting.py`, to 1e-9) and with "
        "what halves do to a loss",
        (("test_steep_gs", "test_steep_gs_round"),),
        "the three estimators of the matrix in its code, each of which departs from the paper's formula; there "
        "opacities stay whole unless asked; its condition of a vanishing gradient, which is off there; a cap",
    ),
    "quantile": Arm(
        "nerfstudio-project/gsplat, pull request 941 (open), its description",
        ROUND,
        (("test_quantile", "test_quantile_round"),),
        "its own constants; opacity resets are `adc`'s",
    ),
    "none": Arm("ours", "nothing changes", (), ""),
}


def calls_of(function: Any) -> Iterator[dict[str, Any]]:
    """The arguments of a test, as pytest would give them."""
    tables = []
    for mark in getattr(function, "pytestmark", []):
        if mark.name == "parametrize":
            names, values = mark.args
            names = [name.strip() for name in names.split(",")] if isinstance(names, str) else list(names)
            tables.append([dict(zip(names, value if len(names) > 1 else [value], strict=True)) for value in values])
    for parts in itertools.product(*tables):
        yield {name: value for part in parts for name, value in part.items()}


def measured(arm: str) -> float:
    """The largest difference that the tests of an arm find. Raises AssertionError where one fails."""
    sys.path.insert(0, str(ROOT))
    try:
        restatement = importlib.import_module("tests.densify.restatement")
        restatement.DIFFERENCES.clear()
        for module, name in ARMS[arm].tests:
            function = getattr(importlib.import_module(f"tests.densify.{module}"), name)
            cases = list(calls_of(function))
            for arguments in cases[:1] + cases[1:][-1:]:
                assert set(arguments) == set(inspect.signature(function).parameters), (
                    f"{name}: fixtures cannot be given"
                )
                function(**arguments)
        if ARMS[arm].tests and not restatement.DIFFERENCES:
            raise AssertionError(f"{arm}: nothing was compared")
        return max(restatement.DIFFERENCES, default=0.0)
    finally:
        sys.path.remove(str(ROOT))


def bound(difference: float) -> str:
    """The next power of ten, as text; 0 where there is none."""
    return "0" if difference == 0 else f"1e{math.ceil(math.log10(difference)):+03d}".replace("e-0", "e-")


def page(bounds: dict[str, str]) -> str:
    """The page, with the largest difference of each arm as text."""
    rows = (f"| `{k}` | {a.source} | {a.compared} | {bounds[k]} | {a.otherwise} |" for k, a in ARMS.items())
    return HEAD + "\n".join(rows) + "\n" + TAIL


def bounds_of(text: str) -> dict[str, str]:
    """The largest differences that a page states."""
    return dict(ROW.findall(text))


def main(argv: list[str]) -> int:
    if argv not in ([], ["--write"]):
        print(__doc__)
        return 2
    text = page({arm: bound(measured(arm)) for arm in ARMS})
    if argv:
        PAGE.write_text(text, encoding="utf-8")
    same = PAGE.exists() and PAGE.read_text(encoding="utf-8") == text
    print("the page is what was measured" if same else "the page differs: --write")
    return 0 if same else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
