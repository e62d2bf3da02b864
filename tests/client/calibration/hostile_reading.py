"""A child with little memory and time, which reads each file of a folder and prints the error."""

import resource
import sys
from pathlib import Path

from fewview.calibration import read_cameras
from fewview.errors import FormatError

MEMORY = 2**30  # bytes beyond what the process has
SECONDS = 60  # of the processor

used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, used + MEMORY))
resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS))
for path in sorted(Path(sys.argv[1]).iterdir()):
    try:
        read_cameras(path)
    except FormatError as error:
        print(path.name, " ".join(str(error).split()), sep="\t", flush=True)
