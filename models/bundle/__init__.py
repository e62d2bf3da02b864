"""Bundle adjustment: structures, poses, lenses and rig from keypoints, as one posterior.

Offers the unknowns and what is known (`problem`), one frame's cost and optimum (`frame`,
`frame_equations`), all frames on their own (`scene_adjustment`, `structure_covariances`) or
together with what they share (`elimination`, `adjustment`), first poses (`initial_poses`), the
Gaussian shape model (`shape_model`) and bone lengths (`bone_lengths`).
"""
