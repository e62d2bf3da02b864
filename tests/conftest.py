import os
from pathlib import Path

# As the service and its workers do: tests must not depend on how busy the other cores are.
os.environ["OPENBLAS_NUM_THREADS"] = "1"  # NumPy's and SciPy's, before they are imported

# The processes that tests start are of this copy of the code, too, whichever is installed.
os.environ["PYTHONPATH"] = os.pathsep.join(
    str(Path(__file__).parents[1] / at) for at in (".", "client")
)

from models.numerics.threads import use_threads

use_threads(1)
