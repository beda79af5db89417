"""The errors that gsbench raises on purpose."""


class GsbenchError(Exception):
    """Base of every error that gsbench raises on purpose; its text is one line: the cause, then the mend."""


class InputError(GsbenchError, ValueError):
    """The user's files or settings cannot be used (exit code 2)."""


class TrainingError(GsbenchError):
    """A trial started well and could not go on, for example on a non-finite loss (exit code 1)."""
