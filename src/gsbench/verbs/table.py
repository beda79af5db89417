"""The verbs of the command line: for each the module with its ``main(argv, runs)``, and what it is for."""

from __future__ import annotations

VERBS = {
    "fetch": (
        "gsbench.verbs.fetch",
        "download public scenes: Mip-NeRF 360, Tanks and Temples, Deep Blending",
    ),
    "evaluate": (
        "gsbench.verbs.evaluate",
        "measure renders of any program; --as enters them beside an experiment's arms",
    ),
    "tables": ("gsbench.verbs.tables", "Markdown, CSV, LaTeX or HTML tables of an experiment"),
    "report": ("gsbench.verbs.report", "one HTML file with the evidence of an experiment"),
    "check": ("gsbench.verbs.check", "test the claims of a paper, written in a file: supported, refuted or undecided"),
    "gate": ("gsbench.verbs.gate", "for continuous integration: is this version worse than a trusted one?"),
    "bisect": ("gsbench.verbs.bisect", "which commit of a trainer made its results worse?"),
    "plan": ("gsbench.verbs.plan", "how many scenes and seeds you need to see a difference"),
    "ablate": (
        "gsbench.verbs.ablate",
        "which part of a densifier makes its gain: train all combinations of its switches",
    ),
    "pool": (
        "gsbench.verbs.pool",
        "one answer from many archives of results (export --results)",
    ),
    "site": ("gsbench.verbs.site", "a static site from archives: tables that sort, verdicts, reports"),
    "explain": ("gsbench.verbs.explain", "the trials, settings and code behind a number of a table"),
    "status": ("gsbench.verbs.status", "the state of every trial: done, running, failed, missing"),
    "retry": ("gsbench.verbs.retry", "run failed, stopped and missing trials again"),
    "bench": ("gsbench.verbs.bench", "time rasterizers and the training step"),
    "sync": ("gsbench.verbs.sync", "send to MLflow the trials that it lacks"),
    "ui": ("gsbench.verbs.ui", "open the MLflow dashboard on this machine"),
    "export": ("gsbench.verbs.export", "copy a trained model, an initial cloud or an experiment's results for others"),
    "view": ("gsbench.verbs.view", "look at trained models in the browser: one, or two side by side"),
    "doctor": ("gsbench.verbs.doctor", "check this machine and say what is missing"),
}
