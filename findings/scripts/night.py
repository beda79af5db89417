"""A night of twelve ideas on two captures, and the confirmation of what was kept on two others.

    python findings/scripts/night.py DATA PREPARED

``DATA`` holds the photographs (`captures.py`). The same command continues after a kill. The ledger
is the experiment ``findings_night`` in the runs folder.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from captures import prepare

NAME = "findings_night"
IDEAS_FROM, CONFIRMED_ON = ("flower", "herz_jesus_p25"), ("fox", "horns")
SETTINGS = [
    *("train=quick", "train.iterations=1500", "train.position_steps=1500", "train.sh_interval=250"),
    *("train.densify_start=150", "train.densify_stop=900", "train.opacity_reset_interval=600"),
    *("scene.max_size=160", "init=dataset", "init.points_from=train", "densify=adc"),
    *("densify.max_gaussians=15000", "eval.lpips=[squeeze]", "tracking=none", "threads=1"),
    "launch=local",
]
OWN = ("densify=adc", "allow_targets=[ideas]")
IDEAS: dict[str, tuple[str, ...]] = {
    "volumetric": ("densify=volumetric",),
    "volumetric_once": ("densify=volumetric_once",),
    "absolute": ("densify.gradient=absolute", "densify.gradient_threshold=0.0004"),
    "revised_opacity": ("densify.revised_opacity=true",),
    "lower_threshold": ("densify.gradient_threshold=0.0001",),
    "no_reset": ("densify.opacity_reset_interval=100000",),
    "three_children": ("densify.split_children=3",),
    "prune_more": ("densify.prune_opacity=0.02",),
    "opaque_only": (*OWN, "densify._target_=ideas.OpaqueOnly"),
    "split_needles": (*OWN, "densify._target_=ideas.SplitNeedles"),
    "seen_often": (*OWN, "densify._target_=ideas.SeenOften"),
    "largest_first": (*OWN, "densify._target_=ideas.LargestFirst"),
}


def ledger(*words: str) -> int:
    """Run ``gsbench ledger`` where it finds the densifiers of `ideas.py`."""
    command = [sys.executable, "-m", "gsbench", "ledger", *words]
    return subprocess.run(command, cwd=Path(__file__).parent, check=False).returncode


def scenes(prepared: Path, names: tuple[str, ...]) -> list[str]:
    """The words for captures, whose folders have their names."""
    folder = prepared.resolve()
    paths = ",".join(str(folder / name) for name in names)
    return ["scene=colmap", f"scene.path={paths}"]


def main(data: Path, prepared: Path) -> None:
    prepare(data, prepared, (*IDEAS_FROM, *CONFIRMED_ON))
    question = ["--metric", "lpips_squeeze", "--least", "0.005", "--ideas", str(len(IDEAS))]
    where = scenes(prepared, IDEAS_FROM)
    if ledger("new", NAME, *question, *where, *SETTINGS, "seed=0,1,2,3,4,5"):
        sys.exit(2)
    for idea, words in IDEAS.items():
        ledger("try", NAME, "--as", idea, *words)
    ledger("confirm", NAME, *scenes(prepared, CONFIRMED_ON), "seed=10,11,12,13")
    ledger("show", NAME)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
