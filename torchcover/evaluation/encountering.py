"""In time or too late: names and defaults in, what rigs had of encounters and its files out."""

from collections.abc import Iterable, Sequence
from io import BytesIO
from pathlib import Path
from typing import Literal

from matplotlib.figure import Figure

from torchcover import __version__
from torchcover.encounters import Criterion, EncounterSet, Sightings, sight_encounter
from torchcover.encounters.sighting import MountedRig
from torchcover.evaluation.progress import Progress, held_back
from torchcover.evaluation.result_page import words_of
from torchcover.evaluation.settings import FILES, wanted_files
from torchcover.evaluation.target_survey import free_space
from torchcover.evaluation.task import AnyRig, as_called
from torchcover.files import Publication
from torchcover.report import Page, PagePicture, draw_encounters, json_record, page_html
from torchcover.simulation import Rig, with_ego


def encounter(
    rigs: AnyRig | Sequence[AnyRig],
    encounters: EncounterSet | str | Path = "crossing_like",
    criterion: Criterion | None = None,
    *,
    vehicle: str | Path | None = None,
    sensor_model: Literal["ideal", "real"] | None = None,
    phases: int = 10,
    seed: int = 0,
    progress: bool = False,
) -> Sightings:
    """When rigs detect whom their vehicle is about to collide with, and whether that is in time.

    Args:
        rigs: A rig or several: each one itself, its built-in name, or its YAML file.
        encounters: A set, the name of a built-in one, or a YAML file.
        criterion: What is detected, and what is in time.
        vehicle: What carries the rigs, as for `evaluate`; else each is on its own vehicle.
        sensor_model: What sensors make of their hits; as for `evaluate`.
        phases: At how many places of their period the looks begin, in turn.
        seed: Of noise and drop-out.
        progress: Whether to show a bar.

    Raises:
        FileNotFoundError: An unknown name or file.
        ValueError: A file that cannot be used, a number out of its bounds, an encounter that is none.

    Example:
        >>> crossing = {"name": "a", "ego": {"speed_kmh": 30}, "other": {"body": "child", "speed_kmh": 5, "from_m": 2}}
        >>> one = EncounterSet.model_validate({"name": "one", "encounters": [crossing]})
        >>> [(row.encounter, row.in_time) for row in encounter("front_roof_32", one, phases=2).rows]
        [('a', 1.0)]
    """
    if phases < 1:
        raise ValueError(f"phases: a number >= 1 is needed; got {phases}")
    if seed < 0:
        raise ValueError(f"seed: a number >= 0 is needed; got {seed}")
    criterion = Criterion() if criterion is None else criterion
    called = [as_called(rig) for rig in ([rigs] if isinstance(rigs, str | Path | Rig) else rigs)]
    sensing = {rig.name: rig.sensing(sensor_model) for rig in called}
    if len(sensing) < len(called):
        raise ValueError(f"rigs need different names; got {', '.join(rig.name for rig in called)}")
    these = encounters if isinstance(encounters, EncounterSet) else EncounterSet.load(encounters)
    sightings = []
    with Progress(len(sensing) * len(these.encounters), "encounters", shown=progress) as bar:
        for name, rig in sensing.items():
            mounted = MountedRig(rig, with_ego(free_space(), {name: rig}, vehicle))
            for one in these.encounters:
                sightings.append(sight_encounter(mounted, one, criterion, phases=phases, seed=seed))
                bar.advance(len(sensing) * len(these.encounters))
    sensors = {name: tuple(sensor.name for sensor in rig.sensors) for name, rig in sensing.items()}
    return Sightings(these.name, criterion, phases, seed, sensors, sightings)


def encounter_picture(found: Sightings) -> Figure:
    """Time to collision at detection against the speed, a band for each rig, and what is needed."""
    return draw_encounters(list(found.bands()), title=f"{found.name}: time to collision at detection")


def save_encounters(found: Sightings, folder: str | Path, *, files: str | Iterable[str] = FILES) -> list[Path]:
    """Write the files of the command line.

    Args:
        found: From `encounter`.
        folder: Where to write `encounters.csv`, `report.html`, `encounters.png` and `summary.json`; as `save_targets`.
        files: What to write beside `summary.json`, as in `Result.save`; "maps" is the picture.

    Returns:
        The files.
    """
    wanted = wanted_files(files)
    up_to = [
        {"encounter": name, "rig": rig, "in_time_up_to_kmh": kmh} for (name, rig), kmh in found.up_to_kmh().items()
    ]
    record = {
        **found.settings(),
        "rows": [json_record(row._asdict()) for row in found.rows],
        "speeds": list(map(json_record, up_to)),
    }
    with Publication(Path(folder)) as written:
        with held_back():
            if "numbers" in wanted:
                written.add("encounters.csv", found.write_csv)
            written.publish(record)
        if "page" in wanted:
            written.add_text("report.html", page_html(_page(found)))
        if "maps" in wanted:
            written.add_figure("encounters.png", encounter_picture(found))
        written.publish(record)
    return written.paths


def _page(found: Sightings) -> Page:
    png = BytesIO()
    encounter_picture(found).savefig(png, format="png")
    return Page(
        title=f"In time? {', '.join(found.sensors)}",
        lead=f"The encounters of {found.name}, measured by torchcover. In time is geometry: what was seen when, with "
        "the brakes and the latency that were assumed.",
        tables=found.tables(),
        pictures=[PagePicture("Time to collision at detection against the speed", png.getvalue())],
        facts={"Settings": words_of(found.settings()), "Run": {"torchcover": __version__}},
    )
