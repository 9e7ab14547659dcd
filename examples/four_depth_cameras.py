"""From four depth cameras of CARLA to one cloud to a number: `python examples/four_depth_cameras.py front.png ...`.

Four images of one instant, of cameras at one place that look to the front, right, rear and left (yaw 0, 90, 180 and 270
degrees in CARLA). What they see together is the reference; the number is how much of it each of them, and front and
rear together, detect: which share has a point of theirs within 0.4 m.
"""

import argparse
from pathlib import Path

import torch

from torchcover import BevGrid, CoverageMetric, Region
from torchcover.cameras import Camera, convert_carla_pose, read_depth

YAWS_DEG = {"front": 0.0, "right": 90.0, "rear": 180.0, "left": 270.0}
REGION = Region("20 m around", (-20.0, 20.0), (-20.0, 20.0))


def clouds_of(images, fov_deg, location_m):
    """Name of each camera -> (N, 3) its points in the vehicle frame."""
    clouds = {}
    for (name, yaw_deg), path in zip(YAWS_DEG.items(), images, strict=True):
        depth = read_depth(path)  # z-depth in metres; the sky is infinite and makes no points
        height, width = depth.shape
        pose = convert_carla_pose(location_m, yaw_deg=yaw_deg)  # CARLA's left-handed axes to the vehicle's
        camera = Camera.from_fov(width, height, fov_deg, vehicle_T_camera=pose, name=name)
        clouds[name] = camera.to_vehicle(camera.unproject(depth))
    return clouds


def detected(sensor, reference):
    """Share of the reference in each height band that has a sensor point within 0.4 m, a mean over cells of 0.25 m."""
    metric = CoverageMetric(BevGrid(x_m=REGION.x_m, y_m=REGION.y_m, cell_m=0.25))
    metric.update(sensor, reference)
    return {row.band: row.cell_averages["detection_0.4m"].value for row in metric.compute().summary([REGION])}


def main(arguments=None):
    """Print the numbers."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("images", nargs=4, type=Path, metavar="IMAGE", help="of the front, right, rear, left camera")
    parser.add_argument("--fov", type=float, default=90.0, help="degrees")
    parser.add_argument("--height", type=float, default=2.8, help="of the cameras above the ground, metres")
    options = parser.parse_args(arguments)

    clouds = clouds_of(options.images, options.fov, [0.0, 0.0, options.height])
    merged = torch.cat(list(clouds.values()))
    print(f"{len(merged):,} points of four cameras")
    for name, cloud in {**clouds, "front and rear": torch.cat([clouds["front"], clouds["rear"]])}.items():
        shares = ", ".join(f"{band} {share:.1%}" for band, share in detected(cloud, merged).items())
        print(f"{name}: {shares}")


if __name__ == "__main__":
    main()
