"""SUMO at work: a simulation, and roads of OpenDRIVE turned into its networks."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from xml.etree import ElementTree

from torchcover.files import parse_xml, reads
from torchcover.simulation.sumo.floating import ATTRIBUTES
from torchcover.simulation.sumo.programs import output_of, run
from torchcover.simulation.traffic.assemble import HORIZON_M

# Of the simulation; bodies move straight on in between.
STEP_S = 0.2
# A lane change takes a moment, instead of none.
LANE_CHANGE_S = 3.0
# Places are those of fronts, of bodies that may be as long as this.
BEYOND_M = 50.0


def simulate(
    network: Path, routes: Sequence[Path], begin_s: float, seed: int, *, around: str | None, drawn: bool
) -> Iterator[bytes]:
    """Floating car data of a simulation, from a time on and for as long as they are asked for.

    Args:
        network: A `.net.xml`.
        routes: Who drives and walks.
        begin_s: From when on it is told where they are.
        seed: Of the simulation.
        around: Only those near to this vehicle are told of.
        drawn: Whether the traffic was drawn: then nobody is taken out of a jam, and ways may end anywhere.

    Raises:
        ImportError: SUMO is not installed.
        ValueError: It fails; with its own message.
    """
    options = ["--time-to-teleport", "-1", "--ignore-route-errors"] if drawn else []
    if around is not None:
        options += ["--device.fcd.explicit", around, "--person-device.fcd.explicit", around]
        options += ["--device.fcd.radius", str(HORIZON_M + BEYOND_M)]
    return output_of(
        "sumo", "--net-file", network, "--route-files", ",".join(map(str, routes)), "--seed", str(seed),
        "--step-length", str(STEP_S), "--device.fcd.begin", str(begin_s), "--fcd-output", "stdout",
        "--fcd-output.attributes", ATTRIBUTES, "--precision", "4", "--lanechange.duration", str(LANE_CHANGE_S),
        "--collision.action", "warn", "--no-step-log", "--duration-log.disable", *options,
    )  # fmt: skip


@reads("an OpenDRIVE road")
def from_opendrive(path: Path, folder: Path) -> Path:
    """Let SUMO turn an OpenDRIVE file into a network in a folder.

    Raises:
        FileNotFoundError: No such file.
        BadFileError: Entities, or what SUMO's netconvert refuses, with its own message.
        ImportError: SUMO is not installed.
    """
    root = parse_xml(path)
    if root.tag != "OpenDRIVE":
        raise ValueError(f"an OpenDRIVE file begins with <OpenDRIVE>; got <{root.tag}>")
    network = folder / "converted.net.xml"
    run(
        "netconvert", "--opendrive-files", path, "--output-file", network, "--precision", "3",
        "--opendrive.import-all-lanes", "--opendrive.curve-resolution", "2", "--walkingareas", "--crossings.guess",
    )  # fmt: skip
    converted = parse_xml(network)
    for lane in converted.iter("lane"):
        if lane.get("type") == "sidewalk" and lane.get("allow") is None:
            lane.set("allow", "pedestrian")  # netconvert lets cars onto sidewalks that lead to no crossing
    ElementTree.ElementTree(converted).write(network)
    return network
