"""The errors that gsbench raises on purpose."""


class GsbenchError(Exception):
    """Base of all errors that gsbench raises on purpose.

    The message is one line: the cause, then the remedy.
    """


class InputError(GsbenchError, ValueError):
    """Error in the user's files or settings (exit code 2)."""


class TrainingError(GsbenchError):
    """Error that stops a running trial, for example a non-finite loss (exit code 1)."""
