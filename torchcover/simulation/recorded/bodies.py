"""The body that stands for a recorded box."""

import math
from pathlib import Path

import numpy as np

from torchcover.files import reads
from torchcover.geometry import BoundingBox
from torchcover.recordings.formats.tracks import check_gaps, read_box_tracks
from torchcover.recordings.objects import Track
from torchcover.simulation.bodies import Vehicle
from torchcover.simulation.shapes import Box, Mesh
from torchcover.simulation.traffic.fleet import CATEGORIES, load_bodies
from torchcover.simulation.traffic.vehicle_class import VehicleType
from torchcover.simulation.world import Actor

# A body is stretched or squeezed to a box by this at most; beyond, the box itself is shown. The boxes of people hold
# their stride and their arms, which the bodies do not have.
MOST_STRETCHED = 4.0
# Of what has no recorded height and no body.
USUAL_HEIGHT_M = 1.5


class Bodies:
    """The built-in bodies, scaled to recorded boxes; those of one size share one mesh."""

    def __init__(self) -> None:
        # A box is all of a truck.
        self._meshes = {**load_bodies(), "truck": Vehicle.load("truck").mesh()}
        self._sizes_m = {
            kind: np.array(BoundingBox.around(mesh.vertices_m).size_m) for kind, mesh in self._meshes.items()
        }
        self._lengths_m = {kind: float(size_m[0]) for kind, size_m in self._sizes_m.items()}
        self._made: dict[tuple[str | None, tuple[float, float, float]], Mesh] = {}

    def of(self, track: Track) -> tuple[str, Mesh]:
        """The category and the body of a track: of the kind whose length is nearest in its class, or a box."""
        kind = track.vehicle_class and VehicleType(track.vehicle_class, track.size_m[0]).body(self._lengths_m)
        length, width, height = track.size_m
        if kind and math.isnan(height):
            height = float(self._sizes_m[kind][2])
        if kind:
            stretch = np.array([length, width, height]) / self._sizes_m[kind]
            if stretch.max() > MOST_STRETCHED or stretch.min() < 1 / MOST_STRETCHED:
                kind = None
        size_m = (length, width, USUAL_HEIGHT_M if math.isnan(height) else height)
        if (kind, size_m) not in self._made:
            self._made[kind, size_m] = self._scaled(kind, size_m)
        return CATEGORIES[kind] if kind else track.category.lower(), self._made[kind, size_m]

    def _scaled(self, kind: str | None, size_m: tuple[float, float, float]) -> Mesh:
        if kind is None:
            return Box(type="box", size_m=size_m).mesh().made_of("car_paint")
        mesh = self._meshes[kind]
        return mesh._replace(vertices_m=mesh.vertices_m * (np.array(size_m) / self._sizes_m[kind]))


@reads("a file of boxes")
def read_boxes(path: Path) -> tuple[Actor, ...]:
    """Read recorded boxes as actors; see `read_box_tracks`."""
    tracks, bodies = read_box_tracks(path), Bodies()
    for track in tracks:
        try:
            check_gaps(track.trajectory.times_s)
        except ValueError as error:
            raise ValueError(f"id {track.name}: {error}") from error
    return tuple(Actor(track.name, *bodies.of(track), track.trajectory) for track in tracks)
