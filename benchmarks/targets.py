"""A target at 10,000 places around a rig of eight sensors: processor time and memory."""

import resource
import time

from benchmarks.timing import table
from torchcover.evaluation import free_space
from torchcover.simulation import Rig, Scenario
from torchcover.targets import Raster, Target, survey

ROOF = {"name": "roof", "mount": {"z_m": 1.9}, "model": "ouster_os1_128", "max_range_m": 100.0}
CORNERS = [(2.5, 1.05, 45), (2.5, -1.05, -45), (-2.5, 1.05, 135), (-2.5, -1.05, -135)]
CAMERAS = [(0.2, 0.0, 0), (0.0, 1.0, 90), (0.0, -1.0, -90)]


def eight_sensors():
    corners = [
        {"name": f"corner_{k}", "mount": {"x_m": x, "y_m": y, "z_m": 0.8, "yaw_deg": yaw}, "model": "ouster_os1_64",
         "max_range_m": 100.0}
        for k, (x, y, yaw) in enumerate(CORNERS)
    ]  # fmt: skip
    cameras = [
        {"type": "camera", "name": f"camera_{k}", "mount": {"x_m": x, "y_m": y, "z_m": 1.7, "yaw_deg": yaw},
         "width": 640, "height": 480, "stride": 2, "fov_deg": 100.0, "max_range_m": 50.0}
        for k, (x, y, yaw) in enumerate(CAMERAS)
    ]  # fmt: skip
    return Rig.model_validate({"name": "eight", "sensors": [ROOF, *corners, *cameras]})


def main():
    rig, raster = eight_sensors(), Raster((-10.0, 10.0), (-10.0, 10.0), 0.2)
    print(f"{sum(sensor.rays for sensor in rig.sensors):,} rays of 8 sensors, 100 x 100 cells within 10 m\n")
    rows = []
    for world in (free_space(), Scenario.load("courtyard")):
        for name in ("child", "cyclist"):
            start = time.process_time()
            seen = survey(rig, world, Target.load(name), raster)
            seconds = time.process_time() - start
            peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
            rows.append((world.name, seen.target, seconds, peak_mb))
    table(("world", "target", "processor time (s)", "peak so far (MB)"), rows)


if __name__ == "__main__":
    main()
