"""The page of what a rig sees of a target: where it is seen, the worst places, the verdicts."""

from collections.abc import Sequence

import numpy as np

from torchcover import __version__
from torchcover.evaluation.result_page import rig_document, words_of
from torchcover.evaluation.sensor_drawings import sensor_views
from torchcover.report import ColourScale, Line, Page, PageMap, PageRig, PageTable, Words, percent
from torchcover.simulation import Sensor
from torchcover.targets import Place, TargetMap, Verdict

NO_ROOM = "no room for it"
ROBUST_PERCENTILE = 98


def target_page(
    seen: TargetMap,
    verdicts: Sequence[Verdict] = (),
    sensors: Sequence[Sensor] = (),
    not_checked: Sequence[str] = (),
) -> Page:
    """All that is known of a target, on one page.

    Args:
        seen: From `survey_target`.
        verdicts: From `torchcover.targets.check`.
        sensors: Those of the rig.
        not_checked: Requirements that are about other targets, in words.
    """
    failed = [verdict for verdict in verdicts if not verdict.passed]
    tables = [*([_verdicts(verdicts)] if verdicts else []), _sides(seen), _places(seen.worst(), "The worst places")]
    tables += [_places(verdict.worst, f"Not met: {verdict.requirement.words}") for verdict in failed]
    return Page(
        title=f"{seen.rig}: would it see {seen.target}?",
        lead=f"In {seen.scenario}, measured by torchcover."
        + "".join(f" Not checked, as it is not about {seen.target}: {words}." for words in not_checked),
        tables=tables,
        maps=_maps(seen),
        rigs=[PageRig(seen.rig, sensor_views(sensors), rig_document(seen.rig, sensors))],
        ego_outline_m=seen.vehicle_outline_m,
        facts={"Settings": words_of(seen.settings()), "Run": {"torchcover": __version__}},
    )


def _maps(seen: TargetMap) -> list[PageMap]:
    some = seen.points[seen.points > 0]
    most = max(float(np.percentile(some, ROBUST_PERCENTILE)), 10.0) if len(some) else 10.0
    each = {
        "points on it": (seen.points, ColourScale("points on it", "points", "viridis", 1.0, most, logarithmic=True)),
        "seen": (100 * seen.seen, ColourScale(f"steps with {seen.hits} points or more", "%", "viridis", 0.0, 100.0)),
        "surface": (
            100 * seen.share,
            ColourScale(f"visible surface within {seen.threshold_m:g} m of a point", "%", "viridis", 0.0, 100.0),
        ),
        "sensors": (
            seen.sensors,
            ColourScale(
                f"sensors with {seen.hits} points or more", "sensors", "viridis", 0.0, float(len(seen.sensor_names))
            ),
        ),
    }
    first_seen = seen.first_seen_m()
    line = Line(f"first seen, with {seen.hits} points, on the way out", np.vstack([first_seen, first_seen[:1]]))
    return [
        PageMap(
            quantity=scale.quantity,
            band=seen.target,
            rig=seen.rig,
            x=seen.raster.x,
            y=seen.raster.y,
            cell_m=seen.raster.step_m,
            values=values,
            scale=scale,
            unknown=NO_ROOM,
            lines=[line],
        )
        for values, scale in each.values()
    ]


def _sides(seen: TargetMap) -> PageTable:
    sides, unseen_to_m = seen.sides(), seen.unseen_to_m()
    within = list(dict.fromkeys(side.within_m for side in sides))
    rows = []
    for name in dict.fromkeys(side.side for side in sides):
        shares = ["-" if one.cells == 0 else percent(one.seen) for one in sides if one.side == name]
        rows.append(tuple(map(Words, (name, *shares, _unseen(unseen_to_m[name])))))
    of_steps = ", mean over the steps" if seen.step_count > 1 else ""
    headings = ("side", *(f"within {limit_m:g} m\n(%)" for limit_m in within), "unseen to\n(m)")
    return PageTable(f"Free places with {seen.hits} points or more{of_steps}", headings, rows)


def _unseen(to_m: float) -> str:
    if np.isnan(to_m):
        return "-"
    return f"{to_m:.2f}" if to_m else "nowhere"


def _places(places: Sequence[Place], title: str) -> PageTable:
    headings = ("side", "x\n(m)", "y\n(m)", "distance\n(m)", "points", "sensors", "surface\n(%)")
    rows = [tuple(map(Words, _place(place))) for place in places]
    return PageTable(title, headings, rows)


def _place(place: Place) -> tuple[str, ...]:
    lengths = (f"{value:.2f}" for value in (place.x_m, place.y_m, place.distance_m))
    return place.side, *lengths, f"{place.points:.4g}", f"{place.sensors:.3g}", percent(place.share)


def _verdicts(verdicts: Sequence[Verdict]) -> PageTable:
    rows = []
    for verdict in verdicts:
        words = (
            "pass" if verdict.passed else "FAIL",
            f"{verdict.failed:,}",
            f"{verdict.unknown:,}",
            f"{verdict.cells:,}",
        )
        rows.append((Words(verdict.requirement.words), *map(Words, words)))
    return PageTable("Requirements", ("requirement", "", "places where not", "of them unknown", "of"), rows)
