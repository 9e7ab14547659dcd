"""How many objects a reference sensor knows something about: `python -m benchmarks.known_boxes`.

Over instants of built-in traffic and the objects within 60 m: the share in whose box a reference point fell, the share
that is hidden from the reference's places too, the share that was not sampled, and the median number of points in those
that are known; and the time of a step, the rig included, by that of the default reference without points for objects.
"""

import time

import torch

from torchcover.data import SimulatedFrames, reference_called, reference_of_objects
from torchcover.detection import box_visibility
from torchcover.simulation import PaperReference

RIG = "front_roof_128"
WITHIN_M = 60.0
INSTANTS = 15
REFERENCES = {
    "surface": reference_called(),
    "surface, 64 points an object": reference_of_objects(),
    "the paper's, 1024 x 1024": PaperReference(),
    "the paper's, 512 x 512": PaperReference(rows=512, columns=512),
    "512 x 512, level": PaperReference(rows=512, columns=512, max_tilt_deg=0.0),
}


def main() -> None:
    """Print a line for each scenario and reference."""
    torch.set_num_threads(1)
    for scenario in ("urban", "highway"):
        first = SimulatedFrames(scenario, RIG, steps=INSTANTS, seed=0, every_s=2.0, boxes=True)
        frames = {name: first.with_reference_sensor(reference) for name, reference in REFERENCES.items()}
        found: dict[str, list[tuple[float, torch.Tensor, torch.Tensor, torch.Tensor]]] = {name: [] for name in frames}
        # All at one instant, then all at the next: what slows the machine down slows all of them.
        for index in range(INSTANTS):
            for name, dataset in frames.items():
                start = time.perf_counter()
                frame = dataset[index]
                seconds = time.perf_counter() - start
                near = frame.boxes.select(frame.boxes.centre_m[:, :2].norm(dim=1) < WITHIN_M)
                seen = box_visibility(frame.sensor, frame.reference, near, reference_weights=frame.reference_weights)
                found[name].append((seconds, seen.known, seen.hidden, seen.reference_points))
        for name, instants in found.items():
            seconds, *columns = zip(*instants, strict=True)
            known, hidden, points = (torch.cat(column) for column in columns)
            relative = torch.tensor(seconds)[1:] / torch.tensor([s for s, *_ in found["surface"]])[1:]
            print(
                f"{scenario}, {name}: {len(known)} objects, {known.double().mean():.0%} known, "
                f"{hidden.double().mean():.0%} hidden, {(~known & ~hidden).double().mean():.0%} not sampled; median "
                f"{int(points[known].median())} points; {relative.median():.2f} times the time of a step"
            )


if __name__ == "__main__":
    main()
