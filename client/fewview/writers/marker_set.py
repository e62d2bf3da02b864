"""OpenSim's marker set: where in its models the markers of a TRC are, for its Scale and IK tools.

Limbs' joints are the origins of bodies in Rajagopal2016, LaiUhlrich2022, Hamner2010 and models made
from these: the knee is the tibia's, the wrist the hand's. Their markers are fixed there. Heels and
toes lie near origins; these markers are not fixed, so that Scale moves them to where they are.
Other keypoints are no part of the set, and the tools take no notice of them.

Source: OpenSim's `Marker.h`, and the joints' child frames in the models named above.
"""

from pathlib import Path
from xml.etree import ElementTree as Xml

from fewview.animation import Animation
from fewview.errors import FormatError
from fewview.writers.body_tree import usual_name

# Of each joint the body whose origin it is.
JOINTS = {
    "shoulder": "humerus",
    "elbow": "ulna",
    "wrist": "hand",
    "hip": "femur",
    "knee": "tibia",
    "ankle": "talus",
}
NEAR = {"heel": "calcn", "big_toe": "toes", "small_toe": "toes", "foot_index": "toes"}
REFUSED = set(" \t\r\n/\\*+")  # in the names of OpenSim's components


def write(path: Path, animation: Animation) -> None:
    """Write the markers of an animation's keypoints that have a place in OpenSim's models.

    Raises
    ------
    FormatError
        If none has, or OpenSim refuses the name of one.
    """
    document = Xml.Element("OpenSimDocument", Version="40000")
    markers = Xml.SubElement(Xml.SubElement(document, "MarkerSet", name="markerset"), "objects")
    for name in animation.names:
        side, _, part = usual_name(name).partition("_")
        body = JOINTS.get(part) or NEAR.get(part)
        if side not in ("left", "right") or body is None:
            continue
        if REFUSED & set(name):
            raise FormatError(
                f"OpenSim refuses the name {name!r}; it has no blanks, slashes, * and + in names"
            )
        marker = Xml.SubElement(markers, "Marker", name=name)
        Xml.SubElement(marker, "socket_parent_frame").text = f"/bodyset/{body}_{side[0]}"
        Xml.SubElement(marker, "location").text = "0 0 0"
        Xml.SubElement(marker, "fixed").text = str(part in JOINTS).lower()
    if not len(markers):
        raise FormatError(
            "no keypoint has a place in OpenSim's models: shoulders, elbows, wrists, hips, knees, "
            "ankles, heels and toes have, by names such as left_knee"
        )
    Xml.indent(document)
    Xml.ElementTree(document).write(path, encoding="utf-8", xml_declaration=True)
