import os

# As the service and its workers do: tests must not depend on how busy the other cores are.
os.environ["OPENBLAS_NUM_THREADS"] = "1"  # NumPy's and SciPy's, before they are imported

import torch

torch.set_num_threads(1)
