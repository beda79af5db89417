"""The verbs of the command line: modules with ``main(argv, runs) -> exit code``, where ``runs`` is the runs folder."""

VERBS = {  # their purposes, as `gsbench --help` lists them
    "fetch": "download public scenes: Mip-NeRF 360, Tanks and Temples, Deep Blending",
    "evaluate": "measure renders of any program; --as enters them beside an experiment's arms",
    "tables": "Markdown, CSV, LaTeX or HTML tables of an experiment",
    "report": "one HTML file with the evidence of an experiment",
    "check": "test the claims of a paper, written in a file: supported, refuted or undecided",
    "gate": "for continuous integration: is this version worse than a trusted one?",
    "bisect": "which commit of a trainer made its results worse?",
    "plan": "how many scenes and seeds you need to see a difference",
    "ablate": "which part of a densifier makes its gain: train all combinations of its switches",
    "pool": "one answer from many archives of results (export --results)",
    "site": "a static site from archives: tables that sort, verdicts, reports",
    "explain": "the trials, settings and code behind a number of a table",
    "status": "the state of every trial: done, running, failed, missing",
    "retry": "run failed, stopped and missing trials again",
    "bench": "time rasterizers and the training step",
    "sync": "send to MLflow the trials that it lacks",
    "ui": "open the MLflow dashboard on this machine",
    "export": "copy a trained model, an initial cloud or an experiment's results for others",
    "view": "look at trained models in the browser: one, or two side by side",
    "doctor": "check this machine and say what is missing",
}
