"""Measure all that requirements are about, and judge it: names in, verdicts and their files out."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, Literal
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from torchcover import __version__
from torchcover.coverage import AGGREGATIONS, Coverage
from torchcover.encounters import Staged
from torchcover.evaluation.encountering import encounter
from torchcover.evaluation.measuring import measured as measured_coverage
from torchcover.evaluation.requirements import (
    BodyPlaces,
    EncounterRequirement,
    Readings,
    RegionRequirement,
    Requirements,
    TargetRequirement,
    Verdict,
    verdicts,
)
from torchcover.evaluation.result import perfect_depth_words
from torchcover.evaluation.settings import DEFAULT_SCENARIO, Settings
from torchcover.evaluation.target_survey import free_space, in_world
from torchcover.evaluation.task import AnyRig, AnyScenario, distinct_names, loaded, spread_s, task_of
from torchcover.files import AtomicOutput
from torchcover.report import PageTable, Words, json_record
from torchcover.simulation import Rig, Scenario, with_ego
from torchcover.simulation.camera_sensor import CameraSensor
from torchcover.simulation.moving import Solid
from torchcover.targets import Target, survey_places
from torchcover.targets.survey import THRESHOLD_M

Float64 = NDArray[np.float64]
HEADINGS = ("requirement", "", "", "worst", "margin", "not kept", "not checked", "of", "no room", "the worst is")
NOTE = (
    "A number with an error keeps a bound if all of its 95 % interval does, and does not if none of it does; else it "
    "is not checked, until more steps decide it. What is unknown is never kept. "
    "Keeping all is geometry, and no homologation."
)


@dataclass(frozen=True)
class Checked:
    """What `check` returns.

    Args:
        requirements: What was asked.
        verdicts: By rig, in the order of the file.
        settings: They were measured with.
    """

    requirements: Requirements
    verdicts: Mapping[str, Sequence[Verdict]]
    settings: Mapping[str, Any]

    @property
    def is_met(self) -> bool:
        """Whether every rig meets every requirement; one that was not checked is not met."""
        return all(one.state == "kept" for each in self.verdicts.values() for one in each)

    @property
    def verdict(self) -> tuple[str, ...]:
        """How many of the requirements each rig keeps, in a sentence."""
        told = []
        for rig, each in self.verdicts.items():
            states = [one.state for one in each]
            others = [f"{states.count(s)} {s}" for s in ("not kept", "not checked") if s in states]
            told.append(", ".join([f"{rig} keeps {states.count('kept')}", *others]))
        return (f"Of the {len(each)} bounds of {self.requirements.name}: {'; '.join(told)}.",)

    def tables(self) -> list[PageTable]:
        """One for each rig, with what the requirements say about themselves."""
        asked, worlds = self.requirements, ", ".join(map(" ".join, self.settings["worlds"].items()))
        notes = [*filter(None, [asked.description]), f"Worlds: {worlds}.", *self.settings["notes"], NOTE]
        rows = {rig: [tuple(map(Words, _row(one))) for one in each] for rig, each in self.verdicts.items()}
        return [PageTable(f"{rig}: {asked.name}", HEADINGS, each, notes=notes) for rig, each in rows.items()]

    @property
    def record(self) -> dict[str, Any]:
        """All of it, for JSON."""
        rigs = {rig: [json_record(_record(one)) for one in each] for rig, each in self.verdicts.items()}
        about = {"requirements": self.requirements.name, "torchcover": __version__, **self.settings}
        return {**about, "met": self.is_met, "rigs": rigs}

    @property
    def junit(self) -> str:
        """For CI: a suite a rig, a case a bound; what is not kept is a failure, and what is not checked an error."""
        root = ElementTree.Element("testsuites", name=self.requirements.name)
        for rig, each in self.verdicts.items():
            states = [one.state for one in each]
            counts = {"tests": len(states), "failures": states.count("not kept"), "errors": states.count("not checked")}
            suite = ElementTree.SubElement(root, "testsuite", {"name": rig, **{k: str(v) for k, v in counts.items()}})
            for one in each:
                name = f"{one.requirement}: {one.bound.words}"
                case = ElementTree.SubElement(suite, "testcase", classname=rig, name=name)
                if one.state != "kept":
                    words = "; ".join(map(": ".join, zip(HEADINGS[3:], _row(one)[3:], strict=True)))
                    kind = "failure" if one.state == "not kept" else "error"
                    ElementTree.SubElement(case, kind, message=words).text = "\n".join(one.where)
        text = ElementTree.tostring(root, encoding="unicode", xml_declaration=True)
        return "".join(letter if letter.isprintable() or letter == "\n" else " " for letter in text)

    def save(self, folder: str | Path) -> list[Path]:
        """Write `junit.xml` and `summary.json` into a folder, which is made if it does not exist."""
        with AtomicOutput(Path(folder)) as written:
            written.add_text("junit.xml", self.junit)
            written.publish(self.record)
        return written.paths


def _record(one: Verdict) -> dict[str, Any]:
    bound = {"number": one.bound.key, "least" if one.bound.is_least else "most": one.bound.value}
    return {"requirement": one.requirement, **bound, **dict(zip(one._fields[2:], one[2:], strict=True))}


def _row(one: Verdict) -> tuple[str, ...]:
    ends = " or more" if one.high == np.inf else f" ({one.low:.4g} to {one.high:.4g})" if one.low < one.high else ""
    numbers = ("-" if each.endswith("nan") else each for each in (f"{one.value:.4g}{ends}", f"{one.margin:+.4g}"))
    counts = map(str, (one.failed, one.unknown, one.count, one.no_room))
    where = one.where[0] if one.where else "nowhere"
    return one.requirement, one.bound.words, one.state, *numbers, *counts, where


def check(
    rigs: AnyRig | Sequence[AnyRig],
    requirements: Requirements | str | Path,
    scenario: AnyScenario | None = None,
    *,
    vehicle: str | Path | None = None,
    sensor_model: Literal["ideal", "real"] | None = None,
    steps: int | None = None,
    seed: int = 0,
    workers: int | None = None,
    progress: bool = False,
) -> Checked:
    """Whether rigs see what they must.

    Args:
        rigs: A rig or several: each one itself, its built-in name, or its YAML file.
        requirements: What they must see: themselves, the name of a built-in set, or a YAML file.
        scenario: The world in place of the file's.
        vehicle: What carries the rigs, as for `evaluate`; else each is on its own vehicle.
        sensor_model: What sensors make of their hits; as for `evaluate`.
        steps: Steps that are looked at, as for `evaluate` and `survey_target`.
        seed: Of the simulation.
        workers: As of `evaluate`.
        progress: Whether to show bars.

    Raises:
        FileNotFoundError: An unknown name or file.
        ValueError: A file that cannot be used, or a requirement that names what there is not.

    Example:
        >>> child = {"target": "child", "at": {"points_m": [[5.0, 0.0]]}, "points": 5}
        >>> found = check("front_roof_128", Requirements.model_validate({"requirements": [child]}))
        >>> [one.state for one in found.verdicts["front_roof_128"]], found.is_met
        (['kept'], True)
    """
    asked = requirements if isinstance(requirements, Requirements) else Requirements.load(requirements)
    given = [rigs] if isinstance(rigs, str | Path | Rig) else rigs
    called = [loaded(rig).model_copy(update={"name": n}) for rig, n in zip(given, distinct_names(given), strict=True)]
    if not called:
        raise ValueError("check: at least one rig is needed; got none")
    targets = {one.target: Target.load(one.target) for one in asked.requirements if isinstance(one, TargetRequirement)}
    for rig, one in product(called, asked.requirements):  # before the work, not after it
        one.failing([sensor.name for sensor in rig.sensors])
        if isinstance(one, TargetRequirement):
            one.groups(rig.sensors)
        if isinstance(one, EncounterRequirement):
            _check_lasts(one, with_ego(free_space(), {rig.name: rig}, vehicle))
    own: dict[str, Any] = {"vehicle": vehicle, "sensor_model": sensor_model, "seed": seed}
    world, found = scenario or asked.scenario, dict[str, list[Verdict]]()
    for rig in called:
        coverage = _coverage(asked, rig, world, steps=steps, workers=workers, progress=progress, **own)
        measured = []
        for one in asked.requirements:
            if isinstance(one, RegionRequirement):
                assert coverage is not None  # as there is such a requirement
                measured.append({one.number: _of_region(one, coverage, rig)})
            elif isinstance(one, EncounterRequirement):
                measured.append(_of_encounters(one, rig, progress=progress, **own))
            else:
                place = asked.places[one.at] if isinstance(one.at, str) else one.at
                measured.append(_of_target(one, place, targets[one.target], rig, world, steps=steps, **own))
        found[rig.name] = verdicts(asked, measured)
    name, free = world.name if isinstance(world, Scenario) else str(world or ""), free_space().name
    worlds = {"region": name or DEFAULT_SCENARIO, "target": name or free, "encounters": free}
    kinds = [kind for kind in worlds if any(hasattr(one, kind) for one in asked.requirements)]
    told = {"worlds": {kind: worlds[kind] for kind in kinds}, "steps": steps, **own}
    told["notes"] = perfect_depth_words({rig.name: rig.sensors for rig in called}) if "region" in kinds else []
    return Checked(asked, found, {k: str(v) if isinstance(v, Path) else v for k, v in told.items()})


def _check_lasts(one: EncounterRequirement, world: Scenario) -> None:
    ego = Solid(world.ego_mesh())
    for case in one.encounters.encounters:
        if one.ttc_s and one.ttc_s > (lasts_s := Staged(case, ego).contact_s):
            raise ValueError(
                f"ttc_s: {one.ttc_s:g} s are required, and {case.words} of {one.encounters.name!r} lasts "
                f"{lasts_s:.2f} s; require less, or let it begin earlier (seconds, other.from_m)"
            )


def _coverage(asked: Requirements, rig: Rig, scenario: AnyScenario | None, **more: Any) -> Coverage | None:  # noqa: ANN401
    """With all numbers of regions that are required; None if none is."""
    of_regions = [one for one in asked.requirements if isinstance(one, RegionRequirement)]
    if not of_regions:
        return None
    keys = {one.number for one in of_regions}
    thresholds_m = sorted({one.threshold_m for one in of_regions if one.threshold_m})
    aggregations = [one for kind in AGGREGATIONS if (one := kind.of_keys(keys))]
    redundancy = any(one.without or one.number.startswith(("sensors", "seen")) for one in of_regions)
    settings = Settings(
        [rig], scenario, ask=asked, thresholds_m=thresholds_m or THRESHOLD_M, aggregations=aggregations,
        redundancy=redundancy, probe="none", **more,
    )  # fmt: skip
    result = measured_coverage(task_of(settings), settings)
    if result.run is not None:
        result.run.raise_failure()
    return result.coverage


def _of_region(one: RegionRequirement, coverage: Coverage, rig: Rig) -> Readings:
    (region,) = (region for region in coverage.regions if region.name == one.region)
    ends, where = [], []
    for words in ("", *(f"_without_{name}" for name in one.failing([sensor.name for sensor in rig.sensors]))):
        estimate = coverage.estimate_of(one.number + words, region, one.height)
        (number,) = estimate.numbers().values()
        agreed = np.isnan(number.error) and estimate.has_intervals[0]  # all blocks say the same
        ends.append((number.value,) * 3 if agreed else (number.value, number.low, number.high))
        where.append(f"{one.region} {one.height}{words.replace('_', ' ')}")
    value, low, high = np.array(ends).T
    return Readings(value, low, high, where)


def _of_encounters(one: EncounterRequirement, rig: Rig, **given: Any) -> dict[str, Readings]:  # noqa: ANN401
    """Of each encounter the latest detection of all phases; or earlier, if it is seen from the beginning."""
    found, names = encounter(rig, one.encounters, one.criterion, **given), [sensor.name for sensor in rig.sensors]
    times_s, where = [], []
    for case, each in zip(one.encounters.encounters, found.sightings, strict=True):
        lost = {f", without {name}": each.without_ttc_s[names.index(name)].min() for name in one.failing(names)}
        for words, ttc_s in ({"": each.ttc_s.min()} | lost).items():
            times_s.append((ttc_s, each.needed_s, np.inf if ttc_s >= each.open_s else ttc_s))
            where.append(f"{case.words}{words}")
    ttc_s, needed_s, high_s = np.array(times_s).T
    readings = {"ttc_s": Readings(ttc_s, ttc_s, high_s, where)}
    return readings | {"spare_s": Readings(ttc_s - needed_s, ttc_s - needed_s, high_s - needed_s, where)}


def _of_target(
    one: TargetRequirement, place: BodyPlaces, target: Target, given: Rig, scenario: AnyScenario | None, *,
    steps: int | None, vehicle: str | Path | None, sensor_model: Literal["ideal", "real"] | None, seed: int,
) -> dict[str, Readings]:  # fmt: skip
    rig, world, usual_steps = in_world(given, scenario, vehicle, sensor_model)
    at_m, groups = place.positions_m(world.ego_box()), one.groups(rig.sensors)
    own_steps = (usual_steps > 1 and steps) or usual_steps
    of_survey: dict[str, Any] = {"steps": own_steps, "every_s": spread_s(world, None), "seed": seed, "hits": one.hits}
    survey = partial(survey_places, rig, world, target, at_m, **of_survey)
    values: dict[str, list[Float64]] = {bound.key: [] for bound in one.bounds}
    where: list[str] = []
    for words, group in groups.items():
        seen = survey(counting=group)
        # A mean of the first two would hide a step in which nothing is seen.
        numbers = {"points": seen.least_points, "sensors": seen.least_sensors, "share": seen.share}
        there = (seen.state == 0) | (place.points_m is not None)
        for (x, y), n in zip(at_m[there].tolist(), seen.steps[there].tolist(), strict=True):
            room = f", room in {n} of {own_steps} steps" * (n < own_steps) if n else ", no room"
            where.append(f"x = {x:.2f}, y = {y:.2f} m{words}{room}")
        for key in ("pixels", "visual_angle_deg"):
            numbers[key] = np.where(seen.state == 0, 0.0, np.nan)
        for k in group if one.pixels or one.visual_angle_deg else ():  # of each sensor alone
            points, sensor = survey(counting=[k]).least_points, rig.sensors[k]
            x_m, y_m, z_m = sensor.mount.matrix()[:3, 3]
            away_m = np.hypot(*(at_m - (x_m, y_m)).T)
            low_m, high_m = (end_m[2] - z_m for end_m in (target.solid.box.lower_m, target.solid.box.upper_m))
            angle = np.arctan2(high_m, away_m) - np.arctan2(low_m, away_m)
            angle_deg = np.where(points >= one.hits, np.rad2deg(angle), 0.0)
            numbers["visual_angle_deg"] = np.fmax(numbers["visual_angle_deg"], angle_deg)
            if isinstance(sensor, CameraSensor):
                numbers["pixels"] = np.fmax(numbers["pixels"], points)
        for key, of_key in values.items():
            of_key.append(numbers[key][there])
    no_room = len(at_m) - len(where) // len(groups)
    exact = {key: np.concatenate(of_key) for key, of_key in values.items()}
    return {key: Readings(value, value, value, where, no_room) for key, value in exact.items()}
