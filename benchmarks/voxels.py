"""Metrics of rays through voxels: processor time of the walk, of S-MIG and of the occupancy; voxels crossed."""

import time

import numpy as np
import torch

from torchcover.data import Frame
from torchcover.detection import Boxes
from torchcover.published import SMig
from torchcover.published.region_voxels import crossed_by
from torchcover.simulation import Lidar, Pose

from .timing import table

ROUNDS = 5
FRAMES, CARS = 300, 12
# The placements of Place3D 2024's table 7 (x forward, y to the right, z), with the LiDAR of its table 5.
PLACES = {
    "center": ((0, 0, 2.2), (0, 0, 2.4), (0, 0, 2.6), (0, 0, 2.8)),
    "line": ((0, -0.6, 2.2), (0, -0.4, 2.2), (0, 0.4, 2.2), (0, 0.6, 2.2)),
}


def sensors(name):
    pattern = {"channels": 16, "vertical_fov_deg": (-24.8, 2.0), "horizontal_fov_deg": 360.0, "columns": 250}
    return tuple(
        Lidar(name=str(number), mount=Pose(x_m=x, y_m=-y, z_m=z), **pattern, max_range_m=100.0)
        for number, (x, y, z) in enumerate(PLACES[name])
    )


def seconds(function):
    """Least processor time of some rounds, and what it gave."""
    times = []
    for _ in range(ROUNDS):
        start = time.process_time()
        result = function()
        times.append(time.process_time() - start)
    return min(times), result


def traffic(index):
    """A frame with some cars anywhere around."""
    generator = np.random.default_rng(index)
    places = generator.uniform((-30, -20, 0.75, 4.5, 1.8, 1.5, -3.1), (30, 20, 0.75, 4.5, 1.8, 1.5, 3.1), (CARS, 7))
    boxes = Boxes.from_rows(torch.from_numpy(places), categories=("car",) * CARS)
    return Frame({"rig": torch.zeros(0, 3)}, torch.zeros(0, 3), index, str(index), boxes=boxes)


def main():
    torch.set_num_threads(1)
    frames, rows = [traffic(index) for index in range(FRAMES)], []
    for voxel_m in (0.5, 0.2, 0.1, 0.05):
        for name in PLACES:
            metric = SMig(sensors(name), voxel_m, categories=("car",))
            metric.update(frames)
            walk, crossed = seconds(lambda metric=metric: crossed_by(metric.sensors, metric.grid))
            start = time.process_time()
            metric._occupancies()
            occupancy = time.process_time() - start
            # The number and the 16 that its error comes from; the occupancy is remembered.
            whole, estimate = seconds(metric.estimate)
            share = 100 * crossed.sum() / crossed.size
            rows.append(
                [voxel_m, name, int(crossed.sum()), round(share, 1), walk, whole, occupancy, float(estimate.value[0])]
            )
    print(f"16,000 rays, 60 x 40 x 4 m; {FRAMES} frames of {CARS} cars anywhere; seconds of one processor.\n")
    columns = "voxel m, rig, crossed, % of all, walk s, S-MIG with errors s, occupancy once s, S-MIG nats"
    table(columns.split(", "), rows)


if __name__ == "__main__":
    main()
