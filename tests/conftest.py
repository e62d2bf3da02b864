import os
from pathlib import Path

# As the service and its workers do: tests must not depend on how busy the other cores are.
os.environ["OPENBLAS_NUM_THREADS"] = "1"  # NumPy's and SciPy's, before they are imported

# The processes that tests start are of this copy of the code, too, whichever is installed.
os.environ["PYTHONPATH"] = str(Path(__file__).parent.parent)

from models.numerics.threads import use_threads

use_threads(1)
