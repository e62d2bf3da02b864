"""Looking for causes: which hypotheses of single views' pixels explain all views best."""

from models.calibrating.problem import CalibrationProblem
from models.causes.cause import Cause
from models.numerics.steps import Steps


def find_causes(problem: CalibrationProblem) -> Steps[tuple[Cause, ...]]:
    """Find what is wrong with the pixels of single views; yields now and then, to be stopped.

    `problem` has its geometry. The causes are to be undone in their order.
    """
    yield
    return ()
