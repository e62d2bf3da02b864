"""Bundle adjustment: structures, poses, lenses and rig from keypoints, as one posterior.

Offers one frame's problem (`frame`), all frames together (`adjustment`), first poses
(`initial_poses`), the Gaussian shape model (`shape_model`) and bone lengths (`bone_lengths`).
"""
