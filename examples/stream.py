"""A capture loop: `python stream.py MODEL < keypoints.npy`.

Lifts frame by frame as cameras take them, and prints of each its number and its points, x y z
after x y z. In place of a file, a frame is what your detector finds: (K, P, 2) pixels, NaN where
not observed. FEWVIEW_URL is the address of the service, by default http://127.0.0.1:8000.
"""

import io
import sys

import numpy as np
from fewview import Client

model = sys.argv[1]
frames = np.load(io.BytesIO(sys.stdin.buffer.read()))

with Client() as client, client.stream(model) as stream:
    for frame in frames:
        answer = stream.lift(frame)
        print(answer.sequence, *answer.points3d.ravel().tolist())
