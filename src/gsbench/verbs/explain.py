"""``gsbench explain``: how a table's number came about; with ``--stale``, why a stage is computed anew."""

from __future__ import annotations


def main(argv: list[str]) -> int:
    from gsbench.cli import runs_dir

    if "--stale" in argv:
        from gsbench.verbs.stale import main_stale

        return main_stale([word for word in argv if word != "--stale"], runs_dir())
    from gsbench.analysis.explain import main_explain

    return main_explain(argv, runs_dir())
