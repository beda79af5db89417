"""Warnings about growth that feeds itself, and about a limit that stops all growth."""

import logging

from gsbench.events import RefineEvent

log = logging.getLogger(__name__)

# Of the Gaussians that a round splits by volume, the share whose children are still too voluminous.
RUNAWAY_SHARE = 0.5
# Rounds in a row. On bonsai the runaway of eq. 7 keeps such a share for 100 rounds and more.
RUNAWAY_ROUNDS = 10
FEW_SPLITS = 0.01  # of all Gaussians; a rule that splits fewer does not fill the memory
BLOCKED_ITERATIONS = 1000


class GrowthWatch:
    """Looks at the events of a training, and warns once about each kind of trouble."""

    def __init__(self) -> None:
        self._runaway_rounds = 0
        self._blocked_since: int | None = None
        self._warned: set[str] = set()

    def observe(self, event: RefineEvent) -> None:
        """Look at the next refinement."""
        self._watch_splits(event)
        self._watch_limit(event)

    def _watch_splits(self, event: RefineEvent) -> None:
        share = event.isotropic_resplit / max(event.split_volume, 1)
        many = event.split_volume >= FEW_SPLITS * event.before
        self._runaway_rounds = self._runaway_rounds + 1 if share >= RUNAWAY_SHARE and many else 0
        if self._runaway_rounds == RUNAWAY_ROUNDS:
            self._warn(
                "iteration %d: in %d refinements in a row, at least %.0f %% of splits by volume "
                "had children that are over the threshold again, so they split again and again; "
                "densify=volumetric_once does not split near-spheres",
                event.step,
                RUNAWAY_ROUNDS,
                100 * RUNAWAY_SHARE,
            )

    def _watch_limit(self, event: RefineEvent) -> None:
        if not event.grew_or_was_blocked:
            return
        if not event.blocked_by_cap:
            self._blocked_since = None
            return
        if self._blocked_since is None:
            self._blocked_since = event.step
        if event.step - self._blocked_since > BLOCKED_ITERATIONS:
            self._warn(
                "iterations %d to %d: densify.max_gaussians refused growth in every refinement, so "
                "the rule no longer decides where Gaussians are; raise it, or compare at equal "
                "counts with densify.cap=governor",
                self._blocked_since,
                event.step,
            )

    def _warn(self, message: str, *values: float) -> None:
        if message not in self._warned:
            self._warned.add(message)
            log.warning(message, *values)
