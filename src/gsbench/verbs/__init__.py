"""The verbs of the command line: functions ``VERB(argv, runs) -> exit code`` on ``runs``."""

import importlib
from collections.abc import Callable
from pathlib import Path

VERBS = {  # their modules, with their purposes as `gsbench --help` lists them
    "fetch": ("fetch", "download public scenes: Mip-NeRF 360, Tanks and Temples, Deep Blending"),
    "evaluate": (
        "exchange",
        "measure renders of any program; --as enters them beside an experiment's arms",
    ),
    "tables": ("results", "Markdown, CSV, LaTeX or HTML tables of an experiment"),
    "report": ("results", "one HTML file with the evidence of an experiment"),
    "declare": ("trials", "write a sweep's questions and train nothing, for loops and arrays"),
    "judge": ("judge", "is a method better? the verdict on a table of results of any trainer"),
    "gate": ("gate", "for continuous integration: is this version worse than a trusted one?"),
    "ledger": ("ledger", "try many ideas under one false discovery rate, and confirm those kept"),
    "plan": ("plan", "how many scenes and seeds you need to see a difference"),
    "ablate": (
        "ablate",
        "which part of a densifier makes its gain: train all combinations of its switches",
    ),
    "site": ("exchange", "a static site from archives: tables that sort, verdicts, reports"),
    "explain": ("results", "the trials, settings and code behind a number of a table"),
    "status": ("trials", "the state of every trial: done, running, failed, missing"),
    "retry": ("trials", "run failed, stopped, damaged and missing trials again"),
    "bench": ("machine", "time rasterizers and the training step"),
    "clean": ("clean", "what the store holds, and removing what no trial refers to"),
    "sync": ("trials", "send to MLflow the trials that it lacks"),
    "ui": ("servers", "compare the arms of an experiment in MLflow, in a browser"),
    "export": (
        "exchange",
        "copy a trained model, an initial cloud or an experiment's results for others",
    ),
    "view": ("servers", "look at trained models in the browser: one, or two side by side"),
    "doctor": ("machine", "check this machine and say what is missing"),
}


def load_verb(name: str) -> Callable[[list[str], Path], int]:
    """The function of a verb; its module is imported only now."""
    module, _ = VERBS[name]
    function: Callable[[list[str], Path], int] = getattr(
        importlib.import_module(f"gsbench.verbs.{module}"), name
    )
    return function
