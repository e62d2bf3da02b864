"""Bundle adjustment: structures, poses, lenses and rig from keypoints, as one posterior.

Offers the unknowns, data and priors (`problem`), one frame's cost and optimum (`frame`,
`frame_equations`), all frames separately (`separate_frames`, `structure_covariances`) or together
with their shared numbers (`elimination`, `adjustment`), first poses (`initial_poses`), the Gaussian
shape model (`shape_model`) and bone lengths (`bone_lengths`).
"""
