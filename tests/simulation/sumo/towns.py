"""Small networks and floating car data that are written without SUMO."""

LANE = '<lane id="{edge}_{index}" index="{index}" {who} width="{width}" speed="13.9" length="9" shape="{shape}"/>'
XODR = """<OpenDRIVE><header revMajor="1" revMinor="4"/><road name="r" length="300" id="1" junction="-1"><planView>
<geometry s="0" x="0" y="0" hdg="0" length="200"><line/></geometry>
<geometry s="200" x="200" y="0" hdg="0" length="100"><arc curvature="0.01"/></geometry></planView>
<elevationProfile><elevation s="0" a="5" b="0.04" c="0" d="0"/></elevationProfile>
<lanes><laneSection s="0"><center><lane id="0" type="none" level="false"/></center><right>
<lane id="-1" type="driving" level="false"><width sOffset="0" a="3.5" b="0" c="0" d="0"/></lane>
<lane id="-2" type="driving" level="false"><width sOffset="0" a="3.5" b="0" c="0" d="0"/></lane>
<lane id="-3" type="sidewalk" level="false"><width sOffset="0" a="2" b="0" c="0" d="0"/></lane>
</right></laneSection></lanes></road></OpenDRIVE>"""
WALK, DRIVE = 'allow="pedestrian"', 'disallow="pedestrian"'


def places(line):
    return " ".join(",".join(map(str, place)) for place in line)


def edge(name, *lanes, function="normal"):
    """Format an edge; lanes are (permissions, width, line), from the outer side inwards."""
    rows = [
        LANE.format(edge=name, index=k, who=who, width=width, shape=places(line))
        for k, (who, width, line) in enumerate(lanes)
    ]
    return f'<edge id="{name}" function="{function}">{"".join(rows)}</edge>'


def write_net(path, *edges, junctions=(), more=""):
    shapes = "".join(f'<junction id="j{k}" shape="{places(shape)}"/>' for k, shape in enumerate(junctions))
    path.write_text(f"<net>{''.join(edges)}{shapes}{more}</net>")
    return path


def street(name="east", *, y=0.0, z=(0.0, 0.0), length=400.0, shift=(0.0, 0.0)):
    """Format a one-way street to the east, 3.5 m wide with its middle at y, and a sidewalk of 2 m on its right."""
    ends = [(shift[0], z[0]), (shift[0] + length, z[1])]
    line = lambda across: [(x, y + across + shift[1], height) for x, height in ends]  # noqa: E731
    return edge(name, (WALK, 2.0, line(-2.75)), (DRIVE, 3.5, line(0.0)))


def vehicle(name, x, y, angle=90.0, tag="vehicle", **more):
    attributes = {"id": name, "x": x, "y": y, "angle": angle, "type": "car", **more}
    rows = " ".join(f'{key}="{value}"' for key, value in attributes.items() if value is not None)
    return f"<{tag} {rows}/>"


def fcd(steps):
    """Format floating car data from {time: [rows]}."""
    return "<fcd-export>" + "".join(
        f'<timestep time="{time_s}">{"".join(rows)}</timestep>' for time_s, rows in steps.items()
    ) + "</fcd-export>"  # fmt: skip


def drive(name="ego", *, speed=10.0, start=50.0, y=0.0, until=4.0, shift=(0.0, 0.0), **more):
    """Format the rows by time of a vehicle that drives to the east."""
    times_s = [round(0.2 * k, 1) for k in range(round(until / 0.2) + 1)]
    return {t: vehicle(name, start + speed * t + shift[0], y + shift[1], **more) for t in times_s}


def together(*drives):
    times_s = sorted({t for rows in drives for t in rows})
    return {t: [rows[t] for rows in drives if t in rows] for t in times_s}
