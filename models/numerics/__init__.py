"""The arithmetic below all geometry: compiled functions, small matrices, rotations, threads.

Offers `compiled.compiled` and `compiled.inner`, the 3x3 algebra of `matrices`, the one Rodrigues
and the one Kabsch in `rotations`, `threads.in_slices`, and tensors as bytes in `tensor_files`.
"""
