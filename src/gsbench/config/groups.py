"""The groups of the configuration and their choices. Loads neither Hydra nor the schema."""

from collections.abc import Sequence
from pathlib import Path

from gsbench.system.install import conf_dir

GROUPS = ("scene", "init", "densify", "raster", "train", "eval", "tracking", "launch", "experiment")
REMOVABLE = ("init", "densify", "raster")  # groups whose options ~KEY can remove
EXTERNAL_FOLDER = "external"  # subfolder of a group for other programs; glob(*) does not list it


def options(group: str, folders: Sequence[Path] = ()) -> list[str]:
    """The choices of a group: gsbench's YAML files, then those in the user's ``folders``.

    Other programs are named with their subfolder, ``external/NAME``.
    """
    names: dict[str, None] = {}  # a set that keeps its order
    for folder in (Path(conf_dir()), *folders):
        names |= dict.fromkeys(sorted(path.stem for path in Path(folder, group).glob("*.yaml")))
        programs = Path(folder, group, EXTERNAL_FOLDER).glob("*.yaml")
        names |= dict.fromkeys(sorted(f"{EXTERNAL_FOLDER}/{path.stem}" for path in programs))
    return list(names)


def options_text(folders: Sequence[Path] = ()) -> str:
    """The choices of every group: gsbench's own, and those in the user's ``folders``."""
    lines = ["Groups:"]
    for group in GROUPS:
        prefix = "+experiment" if group == "experiment" else group
        lines.append(f"  {prefix + '=':<13}{', '.join(options(group, folders))}")
    return "\n".join(lines)


def hint_for(word: str) -> str:
    """A hint for a word that is no setting: the nearest choice, or how to choose in a group.

    Empty for any other word.
    """
    if word in GROUPS:
        return f"; {word} is a group: choose one by {word}=NAME ({', '.join(options(word))})"
    groups = [group for group in GROUPS if word in options(group)]
    meant = [f"{'+' * (group == 'experiment')}{group}={word}" for group in groups]
    return f"; did you mean {' or '.join(meant)}?" if meant else ""
