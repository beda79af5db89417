"""How verbs read their words: argparse, whose errors are gsbench's, one line long."""

from __future__ import annotations

import argparse
from typing import NoReturn

from gsbench.errors import InputError


class ArgumentParser(argparse.ArgumentParser):
    """An argparse parser that raises InputError for what it does not understand; ``--help`` prints and exits."""

    def error(self, message: str) -> NoReturn:
        raise InputError(f"{self.prog.removeprefix('gsbench ')}: {message} (see {self.prog} --help)")
