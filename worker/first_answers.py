"""The first answer of a fit: what geometry found, stored before the network is taught."""

import logging
from collections.abc import Callable
from functools import partial

from safetensors.numpy import save

from models.findings import advice
from models.findings.finding import dumped
from models.lifting.film import Film, Shown, film_of
from models.lifting.lift import LiftedFrames, join
from models.training.trainer import Trainer
from store import attempts
from store.attempts import Attempt
from store.database import Store
from store.records import FitRecord
from worker.patience import OUTAGES, is_outage

logger = logging.getLogger(__name__)


class FirstAnswer:
    """What an attempt answers as soon as geometry has found the cameras."""

    def __init__(self, store: Store, attempt: Attempt, trainer: Trainer, shown: Shown) -> None:
        self._store, self._attempt, self._trainer, self._shown = store, attempt, trainer, shown
        self._is_given = False

    def resume(self, fit: FitRecord) -> None:
        """Keep the answer of an attempt before this one, if this has its cameras; else withdraw it.

        Without them the fit starts anew, and might find others.
        """
        if fit.first_key is None:
            return
        self._is_given = self._trainer.has_first_answer
        if not self._is_given:
            attempts.withdraw_first_answer(self._store, self._attempt)

    def go_on(self, stopped: Callable[[], bool]) -> bool:
        """Store the answer once there is one; return whether the attempt goes on."""
        if self._is_given or not self._trainer.has_first_answer:
            return True
        self._is_given = True
        prior = advice.attempt(self._trainer.first_answer, None)
        if prior is None:  # the fit itself does not need it
            return True
        lift = reconstruct(film_of(prior, self._shown), stopped)
        if lift is None:
            return False
        keep = partial(
            attempts.save_first_answer,
            self._store,
            self._attempt,
            model=prior.to_bytes(),
            reconstruction=save(lift.arrays),
            findings=dumped(prior.findings),
        )
        unless_away(f"Fit {self._attempt.fit_id} goes on without a first answer", keep)
        return True


def reconstruct(film: Film, stopped: Callable[[], bool]) -> LiftedFrames | None:
    """Lift every frame of the fitted capture; None if the attempt has to end before."""
    lifts = []
    for part in film.parts:
        if stopped():
            return None
        lifts.append(film.lift(part))
    return join(lifts)


def unless_away(otherwise: str, keep: Callable[[], None]) -> bool:
    """Store something, unless records or objects are away; return whether it was stored."""
    try:
        keep()
    except OUTAGES as error:
        if not is_outage(error):
            raise
        logger.warning("%s: %s", otherwise, error)
        return False
    return True
