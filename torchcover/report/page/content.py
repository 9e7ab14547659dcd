"""What a page is made of: tables, maps, rigs and facts with their names and units, whoever measured them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from torchcover.estimation import Number
from torchcover.report.maps.colours import NEVER_PROBED, ColourScale
from torchcover.report.maps.overlay import SensorView
from torchcover.report.renderers.layout import PageTable

Bounds = tuple[float, float]
Array = NDArray[np.floating]
Sides = NDArray[np.integer]


@dataclass(frozen=True, eq=False)
class Line:
    """A line over a map, in metres in the vehicle frame.

    Args:
        name: What it is, for the legend.
        points_m: (K, 2) x, y; NaN between two parts.
    """

    name: str
    points_m: Array


@dataclass(frozen=True, eq=False)
class PageMap:
    """One quantity of one rig in one band over the cells of a raster.

    Args:
        quantity: What the values are, without the unit.
        band: Where: a height band, or a target.
        rig: Whose.
        x: Bounds of the raster forward in metres.
        y: Bounds to the left.
        cell_m: Side of a cell.
        values: (Y, X) in the unit of the scale; NaN is unknown.
        scale: What the colours mean: the same for all bands and rigs.
        unknown: Why a cell is.
        errors: (Y, X) standard errors.
        weights: (Y, X) what each cell weighs where several are taken together.
        weight_name: What the weights are, with the unit.
        full_weight: That of an opaque cell; less is paler. 0 if all are alike.
        sides: (Y, X) how many cells wide the square is that each cell is drawn in; a power of 2.
        difference: Colours of the difference to the first rig; None for the first, and where nothing is compared.
        lines: What is drawn over it.
        bits: Of each number and weight in the file, 16 or 8.
    """

    quantity: str
    band: str
    rig: str
    x: Bounds
    y: Bounds
    cell_m: float
    values: Array
    scale: ColourScale
    unknown: str = NEVER_PROBED
    errors: Array | None = None
    weights: Array | None = None
    weight_name: str = ""
    full_weight: float = 0.0
    sides: Sides | None = None
    difference: ColourScale | None = None
    lines: Sequence[Line] = ()
    bits: int = 16


@dataclass(frozen=True, eq=False)
class PagePlan:
    """Where a body is seen beside a vehicle, from above and true to scale.

    Args:
        rig: Who sees it.
        words: A line above it.
        x: Bounds of the cells forward in metres.
        y: Bounds to the left.
        cell_m: Side of a cell.
        seen_by: (Y, X) by how many sensors; 0 where it is not seen, -1 where it has no room.
        vehicle_box_m: (4, 2) corners x, y of what distances are from.
        vehicle_outline_m: (K, 2) what the vehicle looks like.
        within_m: Up to which distance places count.
        losses_m2: Sensor -> how much more is not seen within it when this one fails.
    """

    rig: str
    words: str
    x: Bounds
    y: Bounds
    cell_m: float
    seen_by: Sides
    vehicle_box_m: Array
    vehicle_outline_m: Array
    within_m: float
    losses_m2: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class PageRange:
    """Shares of one kind, of one rig or of several below each other.

    Args:
        name: What they are of.
        of_rigs: Name of the rig -> its share, with its interval if there is one.
    """

    name: str
    of_rigs: Mapping[str, Number]


@dataclass(frozen=True, eq=False)
class PageRig:
    """A rig as a page shows it.

    Args:
        name: What tables and maps call it.
        sensors: Its sensors, if they are known.
        document: It as YAML; empty if it is unknown.
    """

    name: str
    sensors: Sequence[SensorView] = ()
    document: str = ""


@dataclass(frozen=True, eq=False)
class PagePicture:
    """A diagram.

    Args:
        title: What it shows, for those too who do not see it.
        png: The file.
    """

    title: str
    png: bytes


@dataclass(frozen=True, eq=False)
class Page:
    """All that a page shows.

    Args:
        title: Its name.
        lead: One line below.
        verdict: The answer in sentences, the first of which says most.
        plans: What shows it, at the top.
        ranges: How far it is seen, below.
        tables: The numbers.
        pictures: Above them.
        maps: In the order of the menus; differences are to the first rig.
        rigs: Drawn on the ego, and as YAML.
        ego_outline_m: (K, 2) corners x, y of the ego in metres.
        outlines: Regions that the maps show, by name: (K, 2) corners x, y.
        facts: Heading -> name -> what holds, such as settings.
        more_tables: Below the facts, such as what was left out.
    """

    title: str
    lead: str
    verdict: Sequence[str] = ()
    plans: Sequence[PagePlan] = ()
    ranges: Sequence[PageRange] = ()
    tables: Sequence[PageTable] = ()
    pictures: Sequence[PagePicture] = ()
    maps: Sequence[PageMap] = ()
    rigs: Sequence[PageRig] = ()
    ego_outline_m: Array | None = None
    outlines: Sequence[Line] = ()
    facts: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    more_tables: Sequence[PageTable] = ()
