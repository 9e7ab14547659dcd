"""Make the body of the delivery robot: `python examples/robot/body.py` writes body.ply beside this file.

A case with slanted front and rear on six wheels, 0.70 x 0.58 x 0.66 m; the size is that of robots that deliver on
pavements, its shape is an assumption.
"""

from pathlib import Path

import numpy as np
import trimesh

# Corners of the case from below to above: half length at the front and at the rear, half width, height, in metres.
LEVELS_M = ((0.26, 0.28, 0.20, 0.12), (0.35, 0.35, 0.22, 0.20), (0.34, 0.35, 0.24, 0.38), (0.24, 0.33, 0.22, 0.58))
MAST_M = (-0.10, 0.06, 0.08)  # where, its radius and height
WHEEL_M = (0.11, 0.08)  # radius and width
AXLES_M = (-0.24, 0.0, 0.24)


def body():
    """A closed mesh of the case, the mast and the wheels, on z = 0."""
    corners = [
        (x, y, height)
        for front, rear, half_width, height in LEVELS_M
        for x in (-rear, front)
        for y in (-half_width, half_width)
    ]
    case = trimesh.PointCloud(corners).convex_hull
    at, radius, height = MAST_M
    mast = trimesh.creation.cylinder(radius, height, sections=16)
    mast.apply_translation([at, 0.0, LEVELS_M[-1][-1] + height / 2])
    wheels = []
    for x in AXLES_M:
        for y in (-0.25, 0.25):
            wheel = trimesh.creation.cylinder(WHEEL_M[0], WHEEL_M[1], sections=16)
            wheel.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0]))
            wheel.apply_translation([x, y, WHEEL_M[0]])
            wheels.append(wheel)
    return trimesh.util.concatenate([case, mast, *wheels])


if __name__ == "__main__":
    body().export(Path(__file__).with_name("body.ply"))
