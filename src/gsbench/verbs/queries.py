"""Questions on the configuration that Hydra answers: ``--cfg job``, ``--info``, tab completion."""

import os
import re
from contextlib import suppress
from pathlib import Path

from gsbench.app.hydra_main import run_main
from gsbench.config.command_words import check_single, typed_permissions
from gsbench.config.compose import Composer
from gsbench.config.overrides import parse_word
from gsbench.config.search_path import check_search_path, search_path, search_places
from gsbench.errors import InputError
from gsbench.verbs.arguments import ArgumentParser

QUERIES = (
    "--cfg",
    "-c",
    "--info",
    "-i",
    "--hydra-help",
    "--shell-completion",
    "-sc",
    "--resolve",
    "--package",
    "-p",
)
COMPLETION = re.compile(r"(install|uninstall|query)=(bash|zsh|fish)")


def ask_hydra(argv: list[str]) -> int:
    """Let Hydra answer a question about the configuration, and run no trial.

    Raises InputError for bad input.
    """
    options = _parser().parse_args(argv)
    asked = [options.cfg, options.info, options.shell_completion, options.hydra_help]
    if sum(map(bool, asked)) != 1 or ((options.resolve or options.package) and not options.cfg):
        raise InputError(
            "ask one thing: --cfg job (with --resolve or --package KEY), --info, or --hydra-help"
        )
    if options.shell_completion:
        if len(options.overrides) != 1 or not COMPLETION.fullmatch(options.overrides[0]):
            raise InputError("-sc takes install=bash or uninstall=bash, and zsh and fish likewise")
        _check_typed(os.environ.get("COMP_LINE", ""))
    else:
        folders = [options.config_dir] if options.config_dir else []
        check_single(options.overrides, "choose one whose configuration is shown")
        composer = Composer([*search_path(folders, options.overrides), *options.overrides])
        if options.package is not None and not composer.has_key(options.package):
            raise InputError(
                f"--package {options.package}: there is no such part of the configuration"
            )

    def task(config: object) -> None:
        raise AssertionError("Hydra was asked a question, and ran the task instead")

    run_main(task, argv)
    return 0


def _check_typed(line: str) -> None:
    """Refuse to complete a line that makes Hydra read what the line does not allow."""
    words = []
    for word in line.split():
        with suppress(InputError):  # a half-typed word
            parse_word(word)
            words.append(word)
    check_search_path(words, typed_permissions(words))
    if search_places(words):
        Composer([word for word in words if word != line.split()[-1]])


def _parser() -> ArgumentParser:
    rows = {
        "overrides* KEY=VALUE": "settings",
        "--resolve": "with --cfg: show values instead of ${…}",
        "--hydra-help": "Hydra's own options",
    }
    parser = ArgumentParser(rows, add_help=False, allow_abbrev=False)
    parser.add_argument("--cfg", "-c", choices=["job", "hydra", "all"])
    parser.add_argument("--package", "-p")
    info = ["all", "config", "defaults", "defaults-tree", "plugins", "searchpath"]
    parser.add_argument("--info", "-i", nargs="?", const="all", choices=info)
    parser.add_argument("--shell-completion", "-sc", action="store_true")
    parser.add_argument("--config-dir", "-cd", type=Path)
    return parser
