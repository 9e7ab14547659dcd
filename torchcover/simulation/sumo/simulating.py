"""Runs of SUMO's programs: simulations, and conversion of OpenDRIVE roads to networks."""

import math
import os
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
from typing import IO, NamedTuple
from xml.etree import ElementTree

from torchcover.files import (
    end_with_parent,
    find_memory_limit_gb,
    guard_reader,
    parse_xml,
    report_stopped_processes,
    start_program,
)
from torchcover.files.bad_file import VARIABLE
from torchcover.simulation.sumo.checked_inputs import check_attribute_count, check_projection, copy_checked
from torchcover.simulation.sumo.floating import ATTRIBUTES
from torchcover.simulation.traffic.assemble import HORIZON_M

MAX_CPU_S = 600.0  # processor time of a program that converts or generates a file
NUM_LISTED = 5  # number of links, roads or kinds that a message lists


def run_program(program: str, *options: str | Path) -> None:
    """Run a program of SUMO on trusted inputs; it may write files.

    Args:
        program: Name of the program.
        options: Its command line.

    Raises:
        ImportError: SUMO is not installed.
        ValueError: The program failed; the message is its own.
    """
    for _ in stream_output(program, *options, max_cpu_s=MAX_CPU_S, can_write=True):
        pass


def stream_output(
    program: str, *options: str | Path, max_cpu_s: float = math.inf, can_write: bool = False
) -> Iterator[bytes]:
    """Run a program of SUMO and yield chunks of its standard output; closing the iterator ends the program.

    Args:
        program: Name of the program.
        options: Its command line.
        max_cpu_s: Processor time after which it is ended.
        can_write: Whether it may write files; False for programs that read files of users.

    Raises:
        ImportError: SUMO is not installed.
        ValueError: The program failed; the message is its own.
    """
    sumo_home = find_sumo_home()
    # Validation would look for schemas on the network.
    command = [str(sumo_home / "bin" / program), "--xml-validation", "never", *(str(option) for option in options)]
    with TemporaryDirectory() as working_folder:
        process = start_program(
            command,
            f"SUMO's {program}",
            cwd=working_folder,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            env={**os.environ, "SUMO_HOME": str(sumo_home), "PROJ_NETWORK": "OFF"},
            preexec_fn=end_with_parent(find_memory_limit_gb(), max_cpu_s, can_write=can_write),
        )
        assert process.stdout is not None  # because of PIPE
        assert process.stderr is not None
        # A second thread empties the pipe of messages, so that the program never waits for it.
        messages = bytearray()
        reader = Thread(target=_read_last_messages, args=(process.stderr, messages), daemon=True)
        reader.start()
        try:
            with closing(process.stdout):
                while True:
                    with report_stopped_processes([process.pid], f"SUMO's {program}"):
                        chunk = process.stdout.read(1 << 18)
                    if not chunk:
                        break
                    yield chunk
            status = process.wait()
        finally:
            process.kill()
            process.wait()
            reader.join()
        if status:
            raise ValueError(_explain_failure(program, status, messages, max_cpu_s))


def _read_last_messages(pipe: IO[bytes], messages: bytearray) -> None:
    """Empty a pipe, and keep the end of its content, since errors come last."""
    max_bytes = 1 << 16
    with pipe:
        while chunk := pipe.read(max_bytes):
            messages += chunk
            del messages[:-max_bytes]


def _explain_failure(program: str, status: int, messages: bytearray, max_cpu_s: float) -> str:
    """Explain why a program failed, from its exit status and the end of its messages."""
    if status == -signal.SIGXCPU:
        return f"SUMO's {program} took more than {max_cpu_s:g} s of processor time; is the file damaged?"
    if status == -signal.SIGXFSZ:
        return f"SUMO's {program} tried to write a file; its inputs must not make it write"
    text = extract_errors(messages.decode("utf-8", "replace").splitlines())
    if "bad_alloc" in text:
        limit_gb = find_memory_limit_gb()
        text += f"; it may take {limit_gb:g} GB: take a piece of the network, or set {VARIABLE} to more"
    return f"SUMO's {program} fails: {text}"


def extract_errors(lines: Sequence[str]) -> str:
    """Extract the errors from the messages of a program.

    Args:
        lines: Messages; a line that is indented continues the line before.

    Returns:
        The text after each "Error:" in one line, or the last message without one; at most 500 characters.
    """
    errors: list[str] = []
    is_error = False
    for line in lines:
        is_error = line.startswith("Error:") or (is_error and line.startswith(" "))
        if is_error:
            errors.append(line.removeprefix("Error:").strip())
    max_chars = 500
    return " ".join(errors or lines[-1:] or ["without a message"])[:max_chars]


def find_sumo_home() -> Path:
    """Find the folder of SUMO: the installed package, or the program on the search path of the shell.

    Raises:
        ImportError: SUMO is not installed.
    """
    package = find_spec("sumo")
    if package is not None and package.origin is not None:
        return Path(package.origin).parent
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
    """Simulate traffic and yield chunks of floating car data.

    Args:
        network_file: Network.
        route_files: Routes.
        begin_s: Time from which data are written.
        seed: Seed of the simulation.
        around_vehicle: Vehicle near which data are written; all data if None.
        is_sampled: Whether the traffic is sampled: then vehicles in a jam stay there, and routes may end anywhere.
    """
    time_step_s = 0.2
    lane_change_s = 3.0  # SUMO's default is an instantaneous change
    margin_m = 50.0  # the radius is measured between the fronts of long vehicles
    options = ["--time-to-teleport", "-1", "--ignore-route-errors"] if is_sampled else []
    if around_vehicle is not None:
        options += ["--device.fcd.explicit", around_vehicle, "--person-device.fcd.explicit", around_vehicle]
        options += ["--device.fcd.radius", str(HORIZON_M + margin_m)]
    with TemporaryDirectory() as folder:
        # The names of the copies have no comma, at which SUMO would split them.
        network_copy = copy_checked(network_file, Path(folder) / "checked.net.xml", "network")
        route_copies = []
        for index, path in enumerate(route_files):
            route_copies.append(str(copy_checked(path, Path(folder) / f"{index}.rou.xml", "routes")))
        yield from stream_output(
            "sumo", "--net-file", network_copy, "--route-files", ",".join(route_copies), "--seed", str(seed),
            "--step-length", str(time_step_s), "--device.fcd.begin", str(begin_s), "--fcd-output", "stdout",
            "--fcd-output.attributes", ATTRIBUTES, "--precision", "4", "--lanechange.duration", str(lane_change_s),
            "--collision.action", "warn", "--no-step-log", "--duration-log.disable", *options,
        )  # fmt: skip


class MissingLink(NamedTuple):
    """Link of an OpenDRIVE file to a road or junction that is missing.

    Args:
        parent: Element that contains the link.
        link: The link.
        description: Text for messages.
    """

    parent: ElementTree.Element
    link: ElementTree.Element
    description: str


@guard_reader("an OpenDRIVE road")
def convert_opendrive(path: Path, folder: Path, *, omit_missing_links: bool) -> Path:
    """Convert an OpenDRIVE file to a network by SUMO's netconvert.

    Args:
        path: OpenDRIVE file.
        folder: Folder of the network.
        omit_missing_links: Whether links to missing roads and junctions are removed.

    Returns:
        The network file.

    Raises:
        BadFileError: The file is no OpenDRIVE file, or netconvert failed.
    """
    root = parse_xml(path)
    if root.tag != "OpenDRIVE":
        raise ValueError(f"an OpenDRIVE file begins with <OpenDRIVE>; got <{root.tag}>")
    check_losses(root)
    for element in root.iter():
        check_attribute_count(element.tag, len(element.attrib))
        if element.tag == "geoReference":
            check_projection(element.text or "")
    missing_links = list(_iterate_missing_links(root))
    if omit_missing_links:
        for missing in missing_links:
            missing.parent.remove(missing.link)
    copy = folder / "checked.xodr"  # without declarations, under a name without a comma
    ElementTree.ElementTree(root).write(copy, encoding="utf-8")
    chunks = stream_output(
        "netconvert", "--opendrive-files", copy, "--output-file", "stdout", "--precision", "3",
        "--opendrive.import-all-lanes", "--opendrive.curve-resolution", "2", "--walkingareas", "--crossings.guess",
        max_cpu_s=MAX_CPU_S,
    )  # fmt: skip
    try:
        output = b"".join(chunks)
    except ValueError as error:
        if not missing_links or omit_missing_links:
            raise
        raise ValueError(f"{error}; {_describe_missing_links(missing_links)}") from error
    network_file = folder / "converted.net.xml"
    network_file.write_bytes(output[: output.rindex(b">") + 1])  # without "Success."
    network = parse_xml(network_file)
    for lane in network.iter("lane"):
        if lane.get("type") == "sidewalk" and lane.get("allow") is None:
            lane.set("allow", "pedestrian")  # netconvert admits cars to sidewalks without a crossing
    ElementTree.ElementTree(network).write(network_file)
    return network_file


def _describe_missing_links(missing_links: Sequence[MissingLink]) -> str:
    """Describe the first missing links, and how to go on without them."""
    descriptions = "; ".join(missing.description for missing in missing_links[:NUM_LISTED])
    if len(missing_links) > NUM_LISTED:
        descriptions += f"; and {len(missing_links) - NUM_LISTED} more"
    return f"links lead to missing roads or junctions: {descriptions}; `omit_missing_links: true` removes them"


def check_losses(root: ElementTree.Element) -> None:
    """Check an OpenDRIVE file for content that netconvert does not convert.

    Args:
        root: Root element of the file.

    Raises:
        ValueError: A road has left-hand traffic.

    Warns:
        UserWarning: Banked roads, lanes given by borders, or roadside objects.
    """
    left_hand = [road.get("id", "") for road in root.findall("road") if road.get("rule", "RHT").upper() == "LHT"]
    if left_hand:
        raise ValueError(
            f"road {', '.join(left_hand[:NUM_LISTED])}: left-hand traffic (LHT), that SUMO's netconvert turns to "
            "right-hand traffic; convert the road with netconvert --lefthand and give the .net.xml"
        )
    losses = []
    # Profiles whose polynomials are all 0 change nothing.
    for name in ("superelevation", "crossfall", "shape"):
        num_banked = 0
        for profile in root.findall(f"road/lateralProfile/{name}"):
            num_banked += any(float(profile.get(key, "0")) for key in "abcd")
        if num_banked:
            losses.append(f"{name} of {num_banked} pieces of road (they are level across)")
    lanes = [lane for lane in root.iter("lane") if lane.find("border") is not None and lane.find("width") is None]
    if lanes:
        losses.append(f"{len(lanes)} lanes whose width is given by <border>")
    objects = Counter(item.get("type") or "untyped" for item in root.findall("road/objects/object"))
    if objects:
        counts = [f"{count} {name}" for name, count in objects.most_common(NUM_LISTED)]
        losses.append(f"objects ({', '.join(counts)})")
    if losses:
        warnings.warn(f"OpenDRIVE: SUMO's netconvert does not convert {'; '.join(losses)}", stacklevel=3)


def _iterate_missing_links(root: ElementTree.Element) -> Iterator[MissingLink]:
    """Iterate over links of roads and junctions to missing roads and junctions."""
    names = {kind: {element.get("id") for element in root.findall(kind)} for kind in ("road", "junction")}
    for road in root.findall("road"):
        for links in road.findall("link"):
            for link in [*links.findall("predecessor"), *links.findall("successor")]:
                kind, target = link.get("elementType", "road"), link.get("elementId")
                if target not in names.get(kind, ()):
                    yield MissingLink(links, link, f"road {road.get('id')}, {link.tag} {kind} {target}")
    for junction in root.findall("junction"):
        for link in junction.findall("connection"):
            missing = []
            for key in ("incomingRoad", "connectingRoad"):
                target = link.get(key)
                if target not in names["road"]:
                    missing.append(f"{key} {target or '(none)'}")
            if missing:
                description = f"junction {junction.get('id')}, connection {link.get('id')}, {', '.join(missing)}"
                yield MissingLink(junction, link, description)
