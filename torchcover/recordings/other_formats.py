"""Formats that are not read, or not where they are given, and how to use files of them."""

from pathlib import Path

# Suffix of a format that is not read, or not where it is given -> how to use such a file.
_EXPORT = "export it as GLB, OBJ, PLY or STL, as by Blender"
_MESH = "a mesh is named in a document, shape: {type: mesh, path: FILE}, or by --vehicle FILE"
REMEDIES = {
    ".xosc": "OpenSCENARIO is not read: let a simulator play it (esmini --csv_logger), and write its road users as a "
    "table of boxes, traffic: {type: tracks, path: boxes.csv}",
    ".xodr": "OpenDRIVE is a map: name it in a scenario, traffic: {type: sumo, net: FILE, random: {}}",
    ".osm": "OpenStreetMap is not read: make a network of it (netconvert --osm-files FILE -o town.net.xml)",
    ".sumocfg": "name its network and routes in a scenario, traffic: {type: sumo, net: FILE, routes: [FILE]}",
    ".xml": "name it in a scenario: a network of SUMO by traffic: {type: sumo, net: FILE, random: {}}, CommonRoad by "
    "traffic: {type: tracks, path: FILE}",
    **dict.fromkeys((".urdf", ".xacro"), "`torchcover robot` reads a URDF, and makes a rig and a vehicle of it"),
    **dict.fromkeys((".sdf", ".world"), "convert SDF into a URDF (sdformat_urdf), for `torchcover robot`"),
    **dict.fromkeys((".glb", ".gltf", ".obj", ".ply", ".stl", ".dae", ".off"), _MESH),
    **dict.fromkeys((".fbx", ".blend", ".3ds", ".max", ".usd", ".usda", ".usdc", ".usdz"), f"{_EXPORT}; {_MESH}"),
    **dict.fromkeys((".step", ".stp", ".iges", ".igs"), f"CAD: {_EXPORT}, or by FreeCAD; {_MESH}"),
}


def find_remedy(path: str | Path) -> str:
    """Return how to use a file of another format; empty if its suffix is not known.

    Example:
        >>> find_remedy("cut_in.xosc")[:25], find_remedy("urban")
        ('OpenSCENARIO is not read:', '')
    """
    return REMEDIES.get(Path(path).suffix.lower(), "")
