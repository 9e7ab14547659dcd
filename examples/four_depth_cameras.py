"""Coverage of four depth cameras of CARLA: `python examples/four_depth_cameras.py FRONT RIGHT REAR LEFT`.

The four images show one frame from one position, facing front, right, rear and left (yaw 0, 90, 180 and 270 degrees in
CARLA). Their merged points are the reference. The example prints which share of it each camera, and front and rear
together, detect: the share of reference points within 0.4 m of one of their points.
"""

import argparse
from pathlib import Path

import torch

from torchcover import BevGrid, CoverageMetric, Region
from torchcover.cameras import Camera, convert_carla_pose, read_depth

YAWS_DEG = {"front": 0.0, "right": 90.0, "rear": 180.0, "left": 270.0}
REGION = Region("20 m around", (-20.0, 20.0), (-20.0, 20.0))


def read_clouds(image_paths, fov_deg, location_m):
    """Read the depth images; returns the (N, 3) points of each camera in the vehicle frame, by its name."""
    clouds = {}
    for (name, yaw_deg), path in zip(YAWS_DEG.items(), image_paths, strict=True):
        depth = read_depth(path)  # z-depth in meters; the sky is infinite and yields no points
        height, width = depth.shape
        pose = convert_carla_pose(location_m, yaw_deg=yaw_deg)
        camera = Camera.from_fov(width, height, fov_deg, vehicle_T_camera=pose, name=name)
        clouds[name] = camera.to_vehicle(camera.unproject(depth))
    return clouds


def compute_detection_rates(sensor, reference):
    """Compute the detection rate of each height band at 0.4 m, averaged over cells of 0.25 m."""
    metric = CoverageMetric(BevGrid(x_m=REGION.x_m, y_m=REGION.y_m, cell_m=0.25))
    metric.update(sensor, reference)
    return {row.band: row.cell_averages["detection_0.4m"].value for row in metric.compute().summary([REGION])}


def main(arguments=None):
    """Print the detection rates."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("images", nargs=4, type=Path, metavar="IMAGE", help="images of the front, right, rear and left")
    parser.add_argument("--fov", type=float, default=90.0, help="horizontal field of view in degrees")
    parser.add_argument("--height", type=float, default=2.8, help="height of the cameras above ground in meters")
    options = parser.parse_args(arguments)

    clouds = read_clouds(options.images, options.fov, [0.0, 0.0, options.height])
    merged = torch.cat(list(clouds.values()))
    print(f"{len(merged):,} points of four cameras")
    sensors = {**clouds, "front and rear": torch.cat([clouds["front"], clouds["rear"]])}
    for name, cloud in sensors.items():
        rates = compute_detection_rates(cloud, merged)
        print(f"{name}: {', '.join(f'{band} {rate:.1%}' for band, rate in rates.items())}")


if __name__ == "__main__":
    main()
