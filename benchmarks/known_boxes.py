"""How many objects a reference sensor knows something about: `python -m benchmarks.known_boxes`.

Over instants of built-in traffic, the share of the objects within 60 m in whose box a reference point fell, and the
median number of such points in those.
"""

from collections.abc import Iterator

import torch

from torchcover.data import SimulatedFrames
from torchcover.detection import box_visibility
from torchcover.simulation import EvenReference, PaperReference

WITHIN_M = 60.0
INSTANTS = 15
REFERENCES = {
    "the paper's, 1024 x 1024": PaperReference(),
    "the paper's, 512 x 512": PaperReference(rows=512, columns=512),
    "512 x 512, level": PaperReference(rows=512, columns=512, max_tilt_deg=0.0),
    "even, 65536 rays within 60 m": EvenReference(((((-60.0, 60.0), (-60.0, 60.0))),), rays=65_536),
}


def measure(scenario: str, reference: PaperReference | EvenReference) -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
    """Reference points and hits of the near boxes, instant by instant."""
    frames = SimulatedFrames(
        scenario, "front_roof_128", steps=INSTANTS, seed=0, every_s=2.0, reference_sensor=reference, boxes=True
    )
    for index in range(INSTANTS):
        frame = frames[index]
        near = frame.boxes.select(frame.boxes.centre_m[:, :2].norm(dim=1) < WITHIN_M)
        yield box_visibility(frame.sensor, frame.reference, near).reference_points, near.hits["front_roof_128"]


def main() -> None:
    """Print a line for each scenario and reference."""
    for scenario in ("urban", "highway"):
        for name, reference in REFERENCES.items():
            points, hits = (torch.cat(column) for column in zip(*measure(scenario, reference), strict=True))
            known = points > 0
            print(
                f"{scenario}, {name}: {known.double().mean():.0%} of {len(known)} objects known, median "
                f"{int(points[known].median())} points; {int((~known & (hits > 0)).sum())} unknown ones hit by the rig"
            )


if __name__ == "__main__":
    main()
