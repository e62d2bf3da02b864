"""The arithmetic below all geometry: compiled functions, small matrices, rotations, threads.

Offers `compiled.compiled` and `compiled.inner`, the 3x3 algebra of `matrices`, rotations from
vectors (Rodrigues) and nearest to matrices (Kabsch) in `rotations`, centred points of unit size in
`normalisation`, `kalman.smooth`, `threads.in_slices`, and tensors as bytes in `tensor_files`.
"""
