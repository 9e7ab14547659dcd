"""Advice for files in formats that torchcover does not read, or does not read at this point."""

from pathlib import Path

_EXPORT = "export it as GLB, OBJ, PLY or STL, for example with Blender"
_MESH = "a mesh belongs in a document, shape: {type: mesh, path: FILE}, or in --vehicle FILE"
# Suffix of a file and the way to use it.
REMEDIES = {
    ".xosc": "OpenSCENARIO is not read: replay it in a simulator (esmini --csv_logger), and write its road users as a "
    "table of boxes, traffic: {type: tracks, path: boxes.csv}",
    ".xodr": "OpenDRIVE is a map: name it in a scenario, traffic: {type: sumo, net: FILE, random: {}}",
    ".osm": "OpenStreetMap is not read: convert it into a network (netconvert --osm-files FILE -o town.net.xml)",
    ".sumocfg": "name its network and routes in a scenario, traffic: {type: sumo, net: FILE, routes: [FILE]}",
    ".xml": "name it in a scenario: a network of SUMO by traffic: {type: sumo, net: FILE, random: {}}, CommonRoad by "
    "traffic: {type: tracks, path: FILE}",
    **dict.fromkeys((".urdf", ".xacro"), "`torchcover robot` reads a URDF, and creates a rig and a vehicle from it"),
    **dict.fromkeys((".sdf", ".world"), "convert SDF into a URDF (sdformat_urdf), for `torchcover robot`"),
    **dict.fromkeys((".glb", ".gltf", ".obj", ".ply", ".stl", ".dae", ".off"), _MESH),
    **dict.fromkeys((".fbx", ".blend", ".3ds", ".max", ".usd", ".usda", ".usdc", ".usdz"), f"{_EXPORT}; {_MESH}"),
    **dict.fromkeys((".step", ".stp", ".iges", ".igs"), f"CAD: {_EXPORT} or FreeCAD; {_MESH}"),
}


def find_remedy(path: str | Path) -> str:
    """Find advice for a file in an unsupported format.

    Args:
        path: File, which need not exist; only its suffix counts.

    Returns:
        A sentence about the way to use the file; empty if its suffix is unknown.

    Example:
        >>> find_remedy("cut_in.xosc")[:25], find_remedy("urban")
        ('OpenSCENARIO is not read:', '')
    """
    return REMEDIES.get(Path(path).suffix.lower(), "")
