"""SUMO's programs at work: checked inputs, simulations, OpenDRIVE roads turned into networks, error messages."""

import math
import os
import re
import signal
import subprocess
import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import closing
from importlib.util import find_spec
from pathlib import Path
from shutil import which
from tempfile import TemporaryDirectory
from threading import Thread
from typing import IO, Literal
from xml.etree import ElementTree
from xml.sax.saxutils import quoteattr

from torchcover.files import end_with_parent, find_memory_limit_gb, guard_reader, parse_xml, report_stopped_processes
from torchcover.files.bad_file import VARIABLE
from torchcover.simulation.sumo.floating import ATTRIBUTES
from torchcover.simulation.sumo.xml_stream import parse_xml_stream, read_chunks
from torchcover.simulation.traffic.assemble import HORIZON_M

# The elements of a network and of traffic demand. SUMO would take detectors, calibrators, rerouters, timed events and
# inclusions from the same files.
DEMAND = (
    "routes|additional|vType|vTypeDistribution|route|routeDistribution|vehicle|trip|flow|interval|stop|person|"
    "personFlow|personTrip|walk|ride|container|containerFlow|transport|tranship"
)
ELEMENTS = {
    "network": re.compile(
        "net|location|type|restriction|edge|lane|neigh|stopOffset|junction|request|connection|prohibition|roundabout|"
        "tlLogic|phase|conflict|condition|assignment|taz|tazSource|tazSink|param"
    ),
    "routes": re.compile(f"{DEMAND}|param"),
}
# Elements whose parameters SUMO obeys; those of edges, lanes and junctions are notes.
OBEYED = re.compile(f"{DEMAND}|tlLogic")
TRAFFIC_LIGHTS = frozenset({"", "static", "actuated", "delay_based", "NEMA", "off", "rail_signal", "rail_crossing"})
# Devices of vehicles without outputs of their own.
DEVICES = "battery|bluelight|driverstate|emissions|fcd|glosa|rerouting|routing|stationfinder|taxi|tripinfo|vehroute"
PARAMETERS = re.compile(
    rf"[^.:/]+|has\.(?:{DEVICES})\.device|(?:person-)?device\.(?:{DEVICES})\.[^:/]+"
    r"|(?:junctionModel|laneChangeModel|carFollowModel|parking)\.[^:/]+"
)
OUTPUT = re.compile(r"(?<!pro)file|output|href|^dest$|\bport$", re.IGNORECASE)
# A projection with a grid or a file by its path: PROJ would open it, also a pipe, which never ends.
PATH_OF_PROJECTION = re.compile(r"=\s*\S*[/\\]")
MAX_ATTRIBUTES = 1000  # of one element; SUMO compares each with each
# Attributes that change no movement: pictures for SUMO's own windows, and files of emission models.
LEFT_OUT = frozenset({"imgFile", "osgFile", "emissionClass"})


@guard_reader("a file of SUMO")
def copy_checked(path: Path, target_path: Path, kind: Literal["network", "routes"]) -> Path:
    """Copy a network or routes, as the parser understands them, if nothing in them names an output or an address.

    Args:
        path: The file.
        target_path: Where the copy goes. Text between the elements, pictures and emission classes are left out.
        kind: Which elements are allowed.

    Returns:
        `target_path`.

    Raises:
        BadFileError: Another element, parameter or attribute than SUMO needs for traffic, or not XML.
    """
    parents: list[str] = []
    with target_path.open("w", encoding="utf-8") as copy:

        def start(name: str, names_and_values: list[str]) -> None:
            attributes = list(zip(names_and_values[::2], names_and_values[1::2], strict=True))
            _check_element(kind, name, attributes, parents[-1] if parents else "")
            parents.append(name)
            kept = (f" {key}={quoteattr(value)}" for key, value in attributes if key not in LEFT_OUT)
            copy.write(f"<{name}{''.join(kept)}>")

        def end(name: str) -> None:
            parents.pop()
            copy.write(f"</{name}>\n")

        parse_xml_stream(read_chunks(path), start, end)
    return target_path


def _check_element(kind: str, name: str, attributes: Sequence[tuple[str, str]], parent: str) -> None:
    if not ELEMENTS[kind].fullmatch(name):
        raise ValueError(
            f"<{name}> is not read: only elements of {'a network' if kind == 'network' else 'traffic demand'} are, "
            "for others can write files or open connections; remove it"
        )
    _check_count(name, len(attributes))
    given = dict(attributes)
    if name == "tlLogic" and given.get("type", "") not in TRAFFIC_LIGHTS:
        raise ValueError(f"<tlLogic> of type {given['type'][:40]!r} is not read; take another type")
    if name == "param":
        key = given.get("key", "")
        if OUTPUT.search(key) or (OBEYED.fullmatch(parent) and not PARAMETERS.fullmatch(key)):
            raise ValueError(
                f"the parameter {key[:80]!r} of <{parent}> is not read, for it could make SUMO write files or open "
                "connections; remove it"
            )
    _check_projection(given.get("projParameter", ""))
    for key in given:
        if key not in LEFT_OUT and OUTPUT.search(key):
            raise ValueError(f"the attribute {key[:80]!r} of <{name}> names a file or an address; remove it")


def _check_count(name: str, attributes: int) -> None:
    if attributes > MAX_ATTRIBUTES:
        raise ValueError(f"<{name[:40]}> has {attributes} attributes; at most {MAX_ATTRIBUTES} are read")


def _check_projection(parameters: str) -> None:
    if PATH_OF_PROJECTION.search(parameters):
        raise ValueError(f"the projection {parameters.strip()[:80]!r} names a file; remove this parameter")


# Of the simulation; bodies move straight on in between.
STEP_S = 0.2
# A lane change takes a moment, instead of none.
LANE_CHANGE_S = 3.0
# Places are those of fronts, of bodies that may be as long as this.
BEYOND_M = 50.0
PIECE_BYTES = 1 << 18
# So many links are named.
SHOWN = 5
MAX_TOLD_CHARS = 500
# Errors come last, after any number of warnings.
KEPT_MESSAGE_BYTES = 1 << 16
# Processor time that a program may take which converts a file.
MOST_S = 600.0
# They would look for schemas on the network.
ALWAYS = ("--xml-validation", "never")


def run_program(program: str, *options: str | Path) -> None:
    """Run a program on inputs of our own, which writes its outputs into files.

    Raises:
        ImportError: SUMO is not installed.
        ValueError: The program fails; with its own message.
    """
    for _ in stream_output(program, *options, max_cpu_s=MOST_S, can_write=True):
        pass


def stream_output(
    program: str, *options: str | Path, max_cpu_s: float = math.inf, can_write: bool = False
) -> Iterator[bytes]:
    """Yield what a program writes to its standard output, piece by piece; closing the iterator ends the program.

    Args:
        program: One of SUMO's programs.
        options: Its command line.
        max_cpu_s: Processor time after which it is ended.
        can_write: Whether it may write files. Programs that read what users give must not.
    """
    folder = find_sumo_home()
    command = [str(folder / "bin" / program), *ALWAYS, *map(str, options)]
    with TemporaryDirectory() as working_folder:
        process = subprocess.Popen(
            command,
            cwd=working_folder,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env={**os.environ, "SUMO_HOME": str(folder), "PROJ_NETWORK": "OFF"},
            preexec_fn=end_with_parent(find_memory_limit_gb(), max_cpu_s, can_write=can_write),  # noqa: PLW1509  (system calls, no lock)
        )
        assert process.stdout is not None  # as asked for
        assert process.stderr is not None
        last = bytearray()
        messages = Thread(target=_keep_last, args=(process.stderr, last), daemon=True)
        messages.start()
        try:
            with closing(process.stdout):
                while True:
                    with report_stopped_processes([process.pid], f"SUMO's {program}"):
                        piece = process.stdout.read(PIECE_BYTES)
                    if not piece:
                        break
                    yield piece
            ended = process.wait()
        finally:
            process.kill()
            process.wait()
            messages.join()
        if ended == -signal.SIGXCPU:
            raise ValueError(f"SUMO's {program} took more than {max_cpu_s:g} s of processor time; is the file damaged?")
        if ended == -signal.SIGXFSZ:
            raise ValueError(f"SUMO's {program} tried to write a file, which what it reads must not make it do")
        if ended:
            told = _errors(last.decode("utf-8", "replace").splitlines())
            if "bad_alloc" in told:
                told += f"; it may take {find_memory_limit_gb():g} GB: take a piece of the network, or set {VARIABLE} to more"
            raise ValueError(f"SUMO's {program} fails: {told}")


def _keep_last(pipe: IO[bytes], last: bytearray) -> None:
    """Empty a pipe of messages, however many there are, and keep the last of them."""
    with pipe:
        while piece := pipe.read(KEPT_MESSAGE_BYTES):
            last += piece
            del last[:-KEPT_MESSAGE_BYTES]


def _errors(lines: Sequence[str]) -> str:
    """What follows "Error:", in one line; a line that is indented goes on with the one before."""
    told: list[str] = []
    goes_on = False
    for line in lines:
        goes_on = line.startswith("Error:") or (goes_on and line.startswith(" "))
        if goes_on:
            told.append(line.removeprefix("Error:").strip())
    return " ".join(told or lines[-1:] or ["it says nothing"])[:MAX_TOLD_CHARS]


def find_sumo_home() -> Path:
    """The folder of the installed package, else of the programs that the shell finds; ImportError if neither is."""
    found = find_spec("sumo")
    if found is not None and found.origin is not None:
        return Path(found.origin).parent
    program = which("sumo")
    if program is None:
        raise ImportError("traffic of type 'sumo' needs SUMO: pip install 'torchcover[sumo]'")
    return Path(program).resolve().parent.parent


def simulate(
    network_file: Path,
    route_files: Sequence[Path],
    begin_s: float,
    seed: int,
    *,
    around_vehicle: str | None,
    is_sampled: bool,
) -> Iterator[bytes]:
    """Floating car data of a simulation from `begin_s` on, of those near to the vehicle `around_vehicle` if one is given.

    Traffic that was `is_sampled` is not taken out of a jam, and its ways may end anywhere.
    """
    options = ["--time-to-teleport", "-1", "--ignore-route-errors"] if is_sampled else []
    if around_vehicle is not None:
        options += ["--device.fcd.explicit", around_vehicle, "--person-device.fcd.explicit", around_vehicle]
        options += ["--device.fcd.radius", str(HORIZON_M + BEYOND_M)]
    with TemporaryDirectory() as folder:
        # Copies, whose names hold no comma either, at which SUMO would split them.
        net = copy_checked(network_file, Path(folder) / "checked.net.xml", "network")
        demand = [copy_checked(path, Path(folder) / f"{k}.rou.xml", "routes") for k, path in enumerate(route_files)]
        yield from stream_output(
            "sumo", "--net-file", net, "--route-files", ",".join(map(str, demand)), "--seed", str(seed),
            "--step-length", str(STEP_S), "--device.fcd.begin", str(begin_s), "--fcd-output", "stdout",
            "--fcd-output.attributes", ATTRIBUTES, "--precision", "4", "--lanechange.duration", str(LANE_CHANGE_S),
            "--collision.action", "warn", "--no-step-log", "--duration-log.disable", *options,
        )  # fmt: skip


@guard_reader("an OpenDRIVE road")
def convert_opendrive(path: Path, folder: Path, *, omit_missing_links: bool) -> Path:
    """Let SUMO turn an OpenDRIVE file into a network in a folder; links to what is not there may be left out."""
    root = parse_xml(path)
    if root.tag != "OpenDRIVE":
        raise ValueError(f"an OpenDRIVE file begins with <OpenDRIVE>; got <{root.tag}>")
    _check_losses(root)
    for element in root.iter():
        _check_count(element.tag, len(element.attrib))
        if element.tag == "geoReference":
            _check_projection(element.text or "")
    network, lost = folder / "converted.net.xml", list(_lost_links(root))
    if lost and omit_missing_links:
        for parent, link, _ in lost:
            parent.remove(link)
    copy = folder / "checked.xodr"  # as the parser understands it: without declarations, under a name without a comma
    ElementTree.ElementTree(root).write(copy, encoding="utf-8")
    try:
        written = b"".join(stream_output(
            "netconvert", "--opendrive-files", copy, "--output-file", "stdout", "--precision", "3",
            "--opendrive.import-all-lanes", "--opendrive.curve-resolution", "2", "--walkingareas", "--crossings.guess",
            max_cpu_s=MOST_S,
        ))  # fmt: skip
    except ValueError as error:
        if not lost or omit_missing_links:
            raise
        told = "; ".join(words for *_, words in lost[:SHOWN]) + (
            f"; and {len(lost) - SHOWN} more" * (len(lost) > SHOWN)
        )
        raise ValueError(
            f"{error}; links lead to what is not there: {told}; `omit_missing_links: true` goes on without"
        ) from error
    network.write_bytes(written[: written.rindex(b">") + 1])  # "Success." follows
    converted = parse_xml(network)
    for lane in converted.iter("lane"):
        if lane.get("type") == "sidewalk" and lane.get("allow") is None:
            lane.set("allow", "pedestrian")  # netconvert lets cars onto sidewalks that lead to no crossing
    ElementTree.ElementTree(converted).write(network)
    return network


def _check_losses(root: ElementTree.Element) -> None:
    """Refuse left-hand roads, and warn of what netconvert leaves out of an OpenDRIVE file.

    Raises:
        ValueError: A road with left-hand traffic.

    Warns:
        UserWarning: Banked roads, lanes given by borders, objects beside the road.
    """
    left = [road.get("id", "") for road in root.findall("road") if road.get("rule", "RHT").upper() == "LHT"]
    if left:
        raise ValueError(
            f"road {', '.join(left[:SHOWN])}: left-hand traffic (LHT), that SUMO's netconvert turns to right-hand "
            "traffic; convert the road with netconvert --lefthand and give the .net.xml"
        )
    losses = []
    for name in ("superelevation", "crossfall", "shape"):
        profiles = root.findall(f"road/lateralProfile/{name}")
        count = sum(any(float(profile.get(key, "0")) for key in "abcd") for profile in profiles)
        if count:
            losses.append(f"{name} of {count} pieces of road (they are level across)")
    lanes = [lane for lane in root.iter("lane") if lane.find("border") is not None and lane.find("width") is None]
    if lanes:
        losses.append(f"{len(lanes)} lanes whose width is given by <border>")
    objects = Counter(item.get("type") or "untyped" for item in root.findall("road/objects/object"))
    if objects:
        losses.append(f"objects ({', '.join(f'{count} {name}' for name, count in objects.most_common(SHOWN))})")
    if losses:
        warnings.warn(
            f"OpenDRIVE: left out, for SUMO's netconvert does not keep them: {'; '.join(losses)}", stacklevel=3
        )


def _lost_links(root: ElementTree.Element) -> Iterator[tuple[ElementTree.Element, ElementTree.Element, str]]:
    """Links of roads and of junctions to roads and junctions that are not there: parent, link, words."""
    there = {kind: {one.get("id") for one in root.findall(kind)} for kind in ("road", "junction")}
    for road in root.findall("road"):
        for links in road.findall("link"):
            for link in [*links.findall("predecessor"), *links.findall("successor")]:
                kind, target = link.get("elementType", "road"), link.get("elementId")
                if target not in there.get(kind, ()):
                    yield links, link, f"road {road.get('id')}, {link.tag} {kind} {target}"
    for junction in root.findall("junction"):
        for link in junction.findall("connection"):
            ends = {key: link.get(key) for key in ("incomingRoad", "connectingRoad")}
            if lost := [f"{key} {target or '(none)'}" for key, target in ends.items() if target not in there["road"]]:
                yield junction, link, f"junction {junction.get('id')}, connection {link.get('id')}, {', '.join(lost)}"
