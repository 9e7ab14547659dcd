"""The sides of streets that were not recorded: a little beside what was driven, and not where anybody was."""

from collections.abc import Sequence

import numpy as np
import shapely

from torchcover.simulation.traffic.assemble import HORIZON_M
from torchcover.simulation.traffic.frontage import Side, sides_around
from torchcover.simulation.world import Actor

# From the middle of a track to the kerb; what lies between tracks that are nearer to each other is street, too.
TO_KERB_M, BETWEEN_M, SIDEWALK_M = 5.0, 12.0, 3.0
# Nothing stands nearer to where somebody was, and labels tremble by centimetres.
CLEAR_M, TREMBLE_M = 0.5, 0.3


def sides_of(
    ego: Actor, others: Sequence[Actor], built_share: float, generator: np.random.Generator
) -> tuple[list[Side], list[shapely.Geometry], list[shapely.Geometry]]:
    """The sides of what was driven, as far as the ego sees; where nothing may stand at kerbs, and behind sidewalks."""
    everybody = (ego, *others)
    places_m = [actor.trajectory.positions_m[:, :2] for actor in everybody]
    ways = [shapely.LineString(np.concatenate([way_m, way_m[-1:]])).simplify(TREMBLE_M) for way_m in places_m]
    radius_m = [np.linalg.norm(np.ptp(actor.mesh.vertices_m[:, :2], axis=0)) / 2 + CLEAR_M for actor in everybody]
    was_m = shapely.buffer(ways, radius_m, quad_segs=4)
    driven = [
        way
        for actor, way in zip(everybody, ways, strict=True)
        if actor is ego or (actor.category != "pedestrian" and way.length > CLEAR_M)
    ]
    street = shapely.union_all(shapely.buffer(driven, TO_KERB_M)).buffer(BETWEEN_M / 2).buffer(-BETWEEN_M / 2)
    seen = ways[0].buffer(HORIZON_M)
    sides = sides_around(
        street, (0.0, SIDEWALK_M), lambda places_m: shapely.contains_xy(seen, *places_m.T), built_share, generator
    )
    return sides, [street, *was_m], [street.buffer(SIDEWALK_M - TREMBLE_M), *was_m]
