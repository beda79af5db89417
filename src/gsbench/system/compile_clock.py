"""The time that compiling takes, which belongs to no stage of a trial."""

from dataclasses import dataclass


@dataclass
class CompileClock:
    """Seconds in which this process compiled kernels, loaded them, or waited for another process.

    It does not know how kernels are compiled, so that whoever reads it need not load numba.
    """

    seconds: float = 0.0
    reported: float = 0.0

    def report(self) -> float:
        """The seconds since the last report."""
        earlier, self.reported = self.reported, self.seconds
        return self.seconds - earlier


CLOCK = CompileClock()
