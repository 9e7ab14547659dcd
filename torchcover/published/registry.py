"""The metrics of others, by the names that `torchcover compare --metrics` takes."""

from collections.abc import Iterable, Mapping

from torchcover.published.false_visible import FalseVisible
from torchcover.published.k_cover import KCover
from torchcover.published.m_sog import MSog
from torchcover.published.object_coverage import ObjectCoverage
from torchcover.published.perception_entropy import PerceptionEntropy
from torchcover.published.places import coarse_grid
from torchcover.published.point_density import PointDensity
from torchcover.published.s_mig import SMig
from torchcover.published.setup import Published, Setup

# Of smaller cells most are empty whatever the rig.
UNIFORMITY_CELL_M = 1.0


def _object_coverage(setup: Setup) -> ObjectCoverage:
    return ObjectCoverage(setup.threshold_m, **setup.of_frames)


def _perception_entropy(setup: Setup) -> PerceptionEntropy:
    return PerceptionEntropy(setup.sensors, **setup.of_frames)


def _k_cover(setup: Setup) -> KCover:
    return KCover(setup.grid, setup.regions, setup.threshold_m, square_metres=setup.square_metres, **setup.of_frames)


def _point_density(setup: Setup) -> PointDensity:
    # A region that is smaller than a cell of 1 m needs the cells of the run.
    coarse = coarse_grid(setup.grid, UNIFORMITY_CELL_M)
    fits = all(region.mask(coarse).any() for region in setup.regions)
    grid = coarse if fits else setup.grid
    return PointDensity(grid, setup.regions, rig=setup.rig, sync_on_compute=setup.sync_on_compute)


def _false_visible(setup: Setup) -> FalseVisible:
    return FalseVisible(setup.sensors, setup.ego, setup.grid, setup.threshold_m, **setup.of_frames)


def _s_mig(setup: Setup) -> SMig:
    return SMig(setup.sensors, **setup.of_frames)


def _s_mig_occluded(setup: Setup) -> SMig:
    return SMig(setup.sensors, occlusion=True, **setup.of_frames)


def _m_sog(setup: Setup) -> MSog:
    return MSog(setup.sensors, **setup.of_frames)


PUBLISHED: Mapping[str, Published] = {
    "object_coverage": Published(
        _object_coverage, frozenset({"boxes"}), "share of an object within the threshold; objects with 1, 5, 10 points"
    ),
    "perception_entropy": Published(
        _perception_entropy, frozenset({"boxes"}), "nats of a detector's error, from points on objects (Ma 2021)"
    ),
    "k_cover": Published(_k_cover, frozenset({"sensor_points"}), "share of the surface seen by 1, 2, 3 sensors"),
    "point_density": Published(_point_density, frozenset(), "points, for each square metre, and how evenly"),
    "false_visible": Published(
        _false_visible, frozenset({"sensors"}), "blind cells that the field of view promised (Börger 2022)"
    ),
    "s_mig": Published(
        _s_mig, frozenset({"boxes", "sensors"}), "minus the entropy of objects along the rays, in nats (Hu 2022)"
    ),
    "s_mig_occluded": Published(
        _s_mig_occluded, frozenset({"boxes", "sensors", "sensor_points"}), "the same, up to what the rays hit"
    ),
    "m_sog": Published(
        _m_sog, frozenset({"boxes", "sensors"}), "minus the mean entropy of labels along the rays (Place3D 2024)"
    ),
}


def metric_names(given: str | Iterable[str]) -> tuple[str, ...]:
    """The metrics that a user asks for; "all" is all of them.

    Raises:
        ValueError: No such metric.
    """
    names = [name.strip() for name in given.split(",")] if isinstance(given, str) else list(given)
    if names == ["all"]:
        return tuple(PUBLISHED)
    for name in names:
        if name not in PUBLISHED:
            raise ValueError(f"metrics: all, or some of {', '.join(PUBLISHED)}, separated by commas; got {name!r}")
    return tuple(dict.fromkeys(names))
