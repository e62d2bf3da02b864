"""Skeletons of animals and faces. Numbers of keypoints do not mean them: names have to."""

from fewview.readers.chains import both, sides, skeleton

# The names and their order are those of the models and data sets named. What is joined is ours:
# DeepLabCut's SuperAnimal models, for one, join nothing.
OTHERS = {
    "superanimal-quadruped-39": skeleton(
        "SuperAnimal-Quadruped",  # DeepLabCut's; "thai" is how it spells the thigh
        "nose upper_jaw lower_jaw mouth_end_right mouth_end_left right_eye right_earbase "
        "right_earend right_antler_base right_antler_end left_eye left_earbase left_earend "
        "left_antler_base left_antler_end neck_base neck_end throat_base throat_end back_base "
        "back_end back_middle tail_base tail_end front_left_thai front_left_knee front_left_paw "
        "front_right_thai front_right_knee front_right_paw back_left_paw back_left_thai "
        "back_right_thai back_left_knee back_right_knee back_right_paw belly_bottom "
        "body_middle_right body_middle_left",
        sides(
            "nose-*_eye-*_earbase-*_earend *_earbase-*_antler_base-*_antler_end *_earbase-neck_end "
            "back_base-front_*_thai-front_*_knee-front_*_paw "
            "back_end-back_*_thai-back_*_knee-back_*_paw back_middle-body_middle_*-belly_bottom "
            "upper_jaw-mouth_end_*"
        )
        + " nose-upper_jaw-lower_jaw neck_end-neck_base-back_base-back_middle-back_end-tail_base"
        + "-tail_end neck_end-throat_base-throat_end-neck_base",
    ),
    "superanimal-topviewmouse-27": skeleton(
        "SuperAnimal-TopViewMouse",  # DeepLabCut's, of mice and other rodents from above
        "nose left_ear right_ear left_ear_tip right_ear_tip left_eye right_eye neck mid_back "
        "mouse_center mid_backend mid_backend2 mid_backend3 tail_base tail1 tail2 tail3 tail4 "
        "tail5 left_shoulder left_midside left_hip right_shoulder right_midside right_hip "
        "tail_end head_midpoint",
        sides(
            "head_midpoint-*_ear-*_ear_tip head_midpoint-*_eye "
            "neck-*_shoulder-*_midside-*_hip-tail_base"
        )
        + " nose-head_midpoint-neck-mid_back-mouse_center-mid_backend-mid_backend2-mid_backend3"
        + "-tail_base-tail1-tail2-tail3-tail4-tail5-tail_end",
    ),
    "superanimal-bird-42": skeleton(
        "SuperAnimal-Bird",  # DeepLabCut's
        "back bill belly breast crown forehead left_eye left_leg left_wing_tip left_wrist nape "
        "right_eye right_leg right_wing_tip right_wrist tail_tip throat neck tail_left tail_right "
        "upper_spine upper_half_spine lower_half_spine right_foot left_foot left_half_chest "
        "right_half_chest chin left_tibia right_tibia lower_spine upper_half_neck lower_half_neck "
        "left_chest right_chest upper_neck left_wing_shoulder left_wing_elbow "
        "right_wing_shoulder right_wing_elbow upper_cere lower_cere",
        sides(
            "forehead-*_eye upper_spine-*_wing_shoulder-*_wing_elbow-*_wrist-*_wing_tip "
            "lower_spine-*_leg-*_tibia-*_foot lower_spine-tail_* breast-*_chest-*_half_chest"
        )
        + " bill-upper_cere-forehead-crown-nape-upper_neck-upper_half_neck-lower_half_neck"
        + "-upper_spine-upper_half_spine-lower_half_spine-lower_spine-tail_tip"
        + " bill-lower_cere-chin-throat-breast-belly nape-neck upper_half_spine-back",
    ),
    "horse-22": skeleton(
        "Horse-10",  # the data set; its near side is the left one
        "Nose Eye Nearknee Nearfrontfetlock Nearfrontfoot Offknee Offfrontfetlock Offfrontfoot "
        "Shoulder Midshoulder Elbow Girth Wither Nearhindhock Nearhindfetlock Nearhindfoot Hip "
        "Stifle Offhindhock Offhindfetlock Offhindfoot Ischium",
        "Nose-Eye-Wither-Midshoulder-Shoulder-Elbow-Girth Wither-Hip-Ischium Hip-Stifle "
        "Elbow-Nearknee-Nearfrontfetlock-Nearfrontfoot Elbow-Offknee-Offfrontfetlock-Offfrontfoot "
        "Stifle-Nearhindhock-Nearhindfetlock-Nearhindfoot "
        "Stifle-Offhindhock-Offhindfetlock-Offhindfoot",
    ),
    "ap-10k-17": skeleton(
        "AP-10K",  # the data set, of mammals
        "L_Eye R_Eye Nose Neck Root_of_tail L_Shoulder L_Elbow L_F_Paw R_Shoulder R_Elbow R_F_Paw "
        "L_Hip L_Knee L_B_Paw R_Hip R_Knee R_B_Paw",
        both("Nose-*_Eye Neck-*_Shoulder-*_Elbow-*_F_Paw Root_of_tail-*_Hip-*_Knee-*_B_Paw")
        + " Nose-Neck-Root_of_tail",
    ),
    "openmonkey-17": skeleton(
        "OpenMonkeyChallenge",  # the data set, of monkeys and apes
        "nose left_eye right_eye head neck left_shoulder left_elbow left_wrist right_shoulder "
        "right_elbow right_wrist hip left_knee left_ankle right_knee right_ankle tail",
        sides("nose-*_eye neck-*_shoulder-*_elbow-*_wrist hip-*_knee-*_ankle")
        + " nose-head-neck-hip-tail",
    ),
    "openmonkeystudio-13": skeleton(
        "OpenMonkeyStudio",  # the data set, of macaques
        "nose head neck right_shoulder right_hand left_shoulder left_hand hip right_knee "
        "right_foot left_knee left_foot tail",
        sides("neck-*_shoulder-*_hand hip-*_knee-*_foot") + " nose-head-neck-hip-tail",
    ),
    "fly-32": skeleton(
        "Vinegar fly",  # of LEAP and DeepPoseKit
        "head eyeL eyeR neck thorax abdomen forelegR1 forelegR2 forelegR3 forelegR4 midlegR1 "
        "midlegR2 midlegR3 midlegR4 hindlegR1 hindlegR2 hindlegR3 hindlegR4 forelegL1 forelegL2 "
        "forelegL3 forelegL4 midlegL1 midlegL2 midlegL3 midlegL4 hindlegL1 hindlegL2 hindlegL3 "
        "hindlegL4 wingL wingR",
        both(
            "head-eye* thorax-wing* thorax-foreleg*1-foreleg*2-foreleg*3-foreleg*4 "
            "thorax-midleg*1-midleg*2-midleg*3-midleg*4 "
            "thorax-hindleg*1-hindleg*2-hindleg*3-hindleg*4"
        )
        + " head-neck-thorax-abdomen",
    ),
    "face-5": skeleton(
        "Face",  # as MTCNN and RetinaFace mark it
        "left_eye right_eye nose mouth_left mouth_right",
        sides("nose-*_eye nose-mouth_*") + " mouth_left-mouth_right left_eye-right_eye",
    ),
}
