"""The errors that gsbench raises on purpose."""


class GsbenchError(Exception):
    """Base of every error that gsbench raises on purpose; its text is one line: the cause, then the mend."""


class InputError(GsbenchError, ValueError):
    """Error of the user's files or settings (exit code 2)."""


class TrainingError(GsbenchError):
    """Error of a trial that started well and could not go on, for example on a non-finite loss (exit code 1)."""
