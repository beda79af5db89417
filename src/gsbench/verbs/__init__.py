"""The verbs of the command line, one module each: ``main(argv, runs) -> exit code``, ``runs`` being the runs folder."""
