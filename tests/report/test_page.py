"""The page: what a browser shows of it, what is in the file, and how exact its numbers are."""

import base64
import hashlib
import html
import json
import re
import shutil
import subprocess
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure

from torchcover.coverage import BevGrid, Coverage, CoverageMetric
from torchcover.coverage.quantities import RADIUS
from torchcover.geometry import build_transform, convert_euler_to_rotation
from torchcover.notebooks import build_result_html
from torchcover.report import (
    MapLine,
    Page,
    PageMap,
    PagePicture,
    PageRig,
    PageTable,
    SensorView,
    TextCell,
    build_color_scale,
    build_page_maps,
    render_page,
)
from torchcover.report.page.content import Array
from torchcover.report.page.map_content import CellBuffer, encode_values
from torchcover.report.page.rendering import fit_maps

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
NASTY = "</script><script>document.title='broken'</script>"
GRID = BevGrid(x_m=(-8.0, 12.0), y_m=(-5.0, 5.0), cell_m=1.0)
EGO = np.array([[2.0, 1.0], [-2.0, 1.0], [-2.0, -1.0], [2.0, -1.0]])
SENSOR = SensorView("<b>front</b>", np.eye(4), 90.0, (-10.0, 10.0), 8.0)
SCALE = build_color_scale(RADIUS, torch.tensor([4.0]))
TITLE = "mean blind spot radius, by area"

# What a user does, and what is read then; `opened` is the page's own promise.
SCRIPT = """
(async () => {
  const found = {}, page = await opened, map = document.getElementById("map");
  const text = (id) => document.getElementById(id).textContent;
  const point = (kind, x, y) => {
    const [offsetX, offsetY] = page.view.toPixel(x, y), box = map.getBoundingClientRect();
    const place = { clientX: box.left + offsetX, clientY: box.top + offsetY };
    map.dispatchEvent(new PointerEvent(kind, { ...place, pointerId: 1 }));
  };
  map.setPointerCapture = () => {};
  const choose = (id, index) => {
    document.getElementById(id).selectedIndex = index;
    document.getElementById(id).dispatchEvent(new Event("change"));
  };
  const press = (key) => map.dispatchEvent(new KeyboardEvent("keydown", { key, cancelable: true }));
  const menu = (id) => [...document.getElementById(id).options].map((one) => one.textContent);
  found.menus = ["quantity", "band", "rig", "view"].map(menu);
  point("pointermove", 3.6, 2.4);
  found.hover = text("readout");
  found.label = map.getAttribute("aria-label");
  found.edge = [-5.5, -4.5].map((x) => { point("pointermove", x, 2.4); return text("readout"); });
  point("pointermove", 100.5, 100.5);
  found.beyond = text("readout");
  choose("band", 1);
  point("pointermove", 3.6, 2.4);
  found.other_band = text("readout");
  choose("rig", 1);
  found.other_rig = text("readout");
  choose("quantity", 1);
  found.kept = ["quantity", "band", "rig"].map((id) => document.getElementById(id).selectedIndex);
  found.other_quantity = text("readout");
  choose("rig", 2);
  found.difference = text("readout");
  found.drawn = page.shown(page.choice, true).values[7 * 20 + 11];
  found.difference_legend = text("legend");
  choose("quantity", 0); choose("band", 0); choose("rig", 0);
  const squares = map.toDataURL();
  document.getElementById("single").click();
  found.single = squares !== map.toDataURL();
  const centre = [...page.view.centre];
  point("pointerdown", 0, 0); point("pointermove", 1, 0.5); point("pointerup", 1, 0.5);
  found.dragged = centre.map((value, axis) => page.view.centre[axis] - value);
  press("0");
  const [far] = [page.view.metres, press("+")];
  found.closer = far / page.view.metres;
  const before = page.view.centre[0];
  press("ArrowRight");
  found.keyed = [page.view.centre[0] > before, text("readout")];
  const ends = () => [...document.querySelectorAll("#bar .ticks span")].map((one) => +one.textContent);
  choose("view", 2);
  const [whole] = [ends(), choose("view", 1)];
  found.ends = [whole, ends()];
  found.gallery = [...document.querySelectorAll("#gallery figcaption")].map((one) => one.textContent);
  document.querySelectorAll("#gallery button")[4].click();
  found.from_gallery = map.getAttribute("aria-label");
  const touch = (kind, pointerId, right) => {
    const box = map.getBoundingClientRect();
    map.dispatchEvent(new PointerEvent(kind, { clientX: box.left + 300 + right, clientY: box.top + 200, pointerId }));
  };
  const wide = page.view.metres;
  touch("pointerdown", 7, 0); touch("pointerdown", 8, 100); touch("pointermove", 8, 200);
  found.pinched = wide / page.view.metres;
  touch("pointercancel", 7, 0); touch("lostpointercapture", 8, 200);
  const held = [...page.view.centre];
  touch("pointermove", 7, 90); touch("pointermove", 8, 10);
  found.let_go = held.every((value, axis) => value === page.view.centre[axis]);
  const kept = new Kept();
  for (const name of ["a", "b", "a", "c"]) kept.get(name, () => name, () => 60e6);
  found.remembered = [[...kept.values.keys()].sort(), kept.bytes];
  found.title = document.title;
  found.scripts = document.scripts.length;
  found.bold = document.querySelectorAll("b").length;
  const pre = document.createElement("pre");
  pre.id = "found";
  pre.textContent = JSON.stringify(found);
  document.body.append(pre);
})();
"""


def browsed(page: str, path, script: str = "") -> tuple[str, list[str]]:
    """The page as a browser has it in the end, and what it wrote to its console."""
    if script:
        own = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
        page = page.replace("script-src 'sha256-", f"script-src 'sha256-{own}' 'sha256-", 1)
        page = page.replace("</body>", f"<script>{script}</script></body>")
    path.write_text(page, encoding="utf-8")
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--window-size=1300,1000"]
    logs = ["--enable-logging=stderr", "--virtual-time-budget=20000", "--dump-dom"]
    profile = f"--user-data-dir={path.parent / 'profile'}"
    command = [CHROMIUM, *options, *logs, profile, path.as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120)
    return done.stdout, [line for line in done.stderr.splitlines() if "CONSOLE" in line]


def page_of(coverages, **more) -> Page:
    rigs = [PageRig(name, [SENSOR], f"name: {name}") for name in coverages]
    table = PageTable(NASTY, ["region", "radius"], [[TextCell(NASTY), TextCell("1.0", "best")]], notes=[NASTY])
    given = {"tables": [table], "rigs": rigs, "ego_outline_m": EGO, "facts": {NASTY: {NASTY: NASTY}}, **more}
    outlines = [MapLine(NASTY, np.array([[0.0, 0.0], [5.0, 0.0], [5.0, 5.0]]))]
    return Page(NASTY, NASTY, maps=list(build_page_maps(coverages)), outlines=outlines, **given)


def over_surface(size: int, points) -> Coverage:
    """So many points of a rig in each of 16 steps, against the same surface points: many cells have errors."""
    metric = CoverageMetric(GRID, num_blocks=16, has_area_weights=True)
    for index in range(16):
        m2 = 0.1 + 0.8 * torch.rand(400, generator=torch.Generator().manual_seed(index))
        metric.update(points(size, 100 + index), points(400, 1000 + index), weights=m2, block_index=index)
    return metric.compute()


@pytest.fixture(scope="module")
def named(points):
    """A rig whose name is markup, and another."""
    return {NASTY: over_surface(100, points), "many": over_surface(400, points)}


@pytest.fixture(scope="module")
def seen(named, tmp_path_factory):
    """What a browser shows of two rigs, and its console."""
    if CHROMIUM is None:
        pytest.skip("no Chromium here: nobody looks at the page")
    dom, console = browsed(render_page(page_of(named)), tmp_path_factory.mktemp("page") / "page.html", SCRIPT)
    found = re.search(r'<pre id="found">(.*?)</pre>', dom, re.DOTALL)
    assert found, console
    return json.loads(html.unescape(found[1])), console


def numbers(words: str, unit: str) -> list[tuple[float, float]]:
    """Every number and its interval in this unit."""
    found = re.findall(rf"(−?[\d.]+) \[(−?[\d.]+), (−?[\d.]+)\] {unit}(?=$|[; ])", words)
    return [tuple(float(each.replace("−", "-")) for each in one) for one in found]


def close(said: tuple[float, float], value: float, error: float) -> bool:
    """Four digits of the value, two errors to either side, each of them coded; within the range of a length."""
    ends = max(value - 2 * error, min(value, 0.0)), value + 2 * error
    return said[0] == pytest.approx(value, rel=6e-4) and said[1:] == pytest.approx(ends, abs=0.06 * 2 * error)


def test_a_browser_has_nothing_to_complain_about(seen):
    assert seen[1] == []


def test_hover_shows_the_saved_cell(seen, named, tmp_path):
    found, row, column = seen[0], 7, 11  # of (3.6, 2.4)
    cells = []
    for name, coverage in zip(("few", "many"), named.values(), strict=True):
        coverage.save(tmp_path / f"{name}.npz")
        with np.load(tmp_path / f"{name}.npz") as file:
            keys = ("radius_area_m", "radius_area_m_error", "detection_area_0.4m", "detection_area_0.4m_error")
            number = np.arange(coverage.grid.num_cells).reshape(coverage.grid.shape)[:, row, column]
            at = np.searchsorted(file["cell"], number)
            cells.append([file[key][at].tolist() for key in keys])
    (radius, error, *_), (of_many, its_error, detection, detection_error) = cells
    m2 = named["many"].area_sums.sum_blocks()[0][0, row, column].item()
    assert found["hover"].startswith("x 3 to 4 m, y 2 to 3 m: ")
    assert found["label"] == f"{TITLE}, ground, z -0.5 to 0.5 m, {NASTY}"
    assert close(*numbers(found["hover"], "m"), radius[0], error[0])
    assert float(re.search("in all frames: ([0-9.]+)", found["hover"])[1]) == pytest.approx(m2, rel=6e-4)
    unobserved, observed = found["edge"]  # nothing was ever probed behind x = -5 m
    assert unobserved.endswith(": no visible surface")
    assert "no visible surface" not in observed
    assert found["beyond"] == "x 100 to 101 m, y 100 to 101 m: beyond the grid"
    assert close(*numbers(found["other_band"], "m"), radius[1], error[1])
    assert close(*numbers(found["other_rig"], "m"), of_many[1], its_error[1])
    assert close(*numbers(found["other_quantity"], "%"), 100 * detection[1], 100 * detection_error[1])


def test_a_difference_says_what_both_are(seen, named):
    few, many = named.values()
    key, at = "detection_area_0.4m", (1, 7, 11)
    values = [100 * one.layers[key].values[at].item() for one in (few, many)]
    errors = [100 * one.errors[key][at].item() for one in (few, many)]
    words = seen[0]["difference"]
    difference, *each = numbers(words, "percentage points") + numbers(words, "%")
    assert difference[0] == pytest.approx(values[1] - values[0], rel=2e-3)
    assert seen[0]["drawn"] == pytest.approx(values[1] - values[0], rel=2e-3)
    assert difference[2] - difference[1] == pytest.approx(4 * np.hypot(*errors), rel=0.06)
    assert close(each[0], values[1], errors[1])
    assert close(each[1], values[0], errors[0])
    assert f"blue: many is better; red: {NASTY} is better" in seen[0]["difference_legend"]


def test_menus_list_all_choices_and_keep_them(seen):
    quantities, bands, rigs, views = seen[0]["menus"]
    assert quantities == [TITLE, "detection within 0.4 m, by area"]
    assert bands == ["ground, z -0.5 to 0.5 m", "obstacle, z 0.5 to 2 m"]
    assert rigs == [NASTY, "many", f"many minus {NASTY}"]
    assert views == ["two vehicle lengths", NASTY, "all observed cells"]
    assert seen[0]["kept"] == [1, 1, 1]
    assert len(seen[0]["gallery"]) == 12
    assert seen[0]["from_gallery"] == f"{TITLE}, obstacle, z 0.5 to 2 m, many"


def test_map_responds_to_pointer_and_keys(seen):
    found = seen[0]
    assert found["single"]
    assert np.allclose(found["dragged"], [-1.0, -0.5], atol=0.05)
    assert found["closer"] == pytest.approx(1.4)
    moved, words = found["keyed"]
    assert moved
    assert words.startswith("x ")


def test_length_colors_follow_the_view(seen, named):
    whole, region = (ends[-1] for ends in seen[0]["ends"])
    largest = max(coverage.layers["radius_area_m"].values.nan_to_num().max().item() for coverage in named.values())
    assert 0 < region < whole <= 1.05 * largest


def test_wide_table_fits_the_paper(tmp_path):
    """Eight sensors on A4 with margins of 12 mm: 186 mm."""
    if CHROMIUM is None:
        pytest.skip("no Chromium here: nobody looks at the page")
    sensors = [f"{what}_{side}" for what in ("camera", "lidar") for side in ("front", "rear", "left", "right")]
    headings = ["region", "band", "sensors that see\nit", "by two or more\n(%)", *sensors, "most lost with"]
    row = [TextCell("behind"), TextCell("ground"), *[TextCell("unknown")] * 10, TextCell("camera_right")]
    text = render_page(Page("rig", "lead", tables=[PageTable("", headings, [row])])).replace(
        "@media print", "@media all"
    )
    script = """
      const [table, first] = [document.querySelector("table"), document.querySelector("thead th")];
      document.body.style.width = "186mm";
      const words = document.createRange();
      words.selectNodeContents(first);
      document.title = [table.scrollWidth <= document.body.clientWidth, words.getClientRects().length].join();
    """
    dom, console = browsed(text, tmp_path / "page.html", script)
    assert console == []
    assert "<title>true,1</title>" in dom


def test_page_map_shows_the_tilted_field_of_view(named, tmp_path):
    """Points of all lines and arcs, in metres, of a LiDAR on its side, a camera that looks down, and a level LiDAR."""
    if CHROMIUM is None:
        pytest.skip("no Chromium here: nobody looks at the page")
    script = """
      opened.then((page) => {
        const drawn = [[], [], []], pen = CanvasRenderingContext2D.prototype, { lineTo, arc } = pen;
        let sensor = 0;
        pen.lineTo = function (x, y) { drawn[sensor].push(page.view.toMetres(x, y)); lineTo.call(this, x, y); };
        pen.arc = function (x, y, r, ...angles) {
          for (const at of [0, 1, 2, 3].map((k) => (k * Math.PI) / 2)) {
            if (r > 3.5) drawn[sensor].push(page.view.toMetres(x + r * Math.cos(at), y + r * Math.sin(at)));
          }
          arc.call(this, x, y, r, ...angles);
        };
        const context = page.view.canvas.getContext("2d");
        for (; sensor < 3; sensor++) page.view.drawSensor(context, page.content.rigs[0].sensors[sensor], 1, true);
        const pre = document.createElement("pre");
        pre.id = "found";
        pre.textContent = JSON.stringify(drawn);
        document.body.append(pre);
      });
    """
    poses = [
        build_transform(convert_euler_to_rotation(0.0, pitch, 0.0), (1.0, -1.0, 2.0)) for pitch in (90.0, 90.0, 0.0)
    ]
    fields = (360.0, (-15.0, 15.0), 50.0), (60.0, (-20.0, 20.0), 50.0), (360.0, (-15.0, 15.0), 50.0)
    sensors = [SensorView("tilted", pose, *field) for pose, field in zip(poses, fields, strict=True)]
    page = page_of({"rig": named["many"]}, rigs=[PageRig("rig", sensors)])
    dom, console = browsed(render_page(page), tmp_path / "page.html", script)
    found = re.search(r'<pre id="found">(.*?)</pre>', dom, re.DOTALL)
    assert found, console
    sizes_m = [np.abs(np.array(points) - (1.0, -1.0)).max(axis=0).tolist() for points in json.loads(found[1])]
    twenty, thirty = np.deg2rad([20.0, 30.0])
    down_m = [2.0 * np.tan(twenty) / np.cos(thirty), 2.0 * np.tan(thirty)]
    assert sizes_m[0] == pytest.approx([50.0 * np.sin(np.deg2rad(15.0)), 50.0], rel=0.02)
    assert sizes_m[1] == pytest.approx(down_m, rel=0.03)
    assert sizes_m[2] == pytest.approx([50.0, 50.0])


def test_two_fingers_zoom_and_lost_pointers_release(seen):
    assert seen[0]["pinched"] == pytest.approx(2.0)
    assert seen[0]["let_go"]


def test_oldest_views_leave_the_memory_budget(seen):
    assert seen[0]["remembered"] == [["a", "c"], 120e6]


def test_names_are_text(seen):
    found = seen[0]
    assert found["title"] == NASTY
    assert found["scripts"] == 4  # content, cells, the page's, this one
    assert found["bold"] == 0


def test_page_is_one_file_without_requests(named):
    text = render_page(page_of(named))
    without_names = text.replace("http-equiv", "")
    assert re.findall(r"(?:src|href)=|https?:|url\((?!#)|@import", without_names) == []
    assert text.count("<script") == 3
    assert "default-src 'none'" in text


def test_a_page_without_maps_or_sensors(tmp_path):
    text = render_page(Page("rig", "lead", rigs=[PageRig("rig")]))
    assert "Sensors unknown" in text
    if CHROMIUM is None:
        pytest.skip("no Chromium here: nobody looks at the page")
    dom, console = browsed(text, tmp_path / "page.html")
    assert console == []
    assert re.search(r'<section id="maps"[^>]* hidden', dom)


def decoded(codes, bits, scale):
    """Numbers as the page's script reads them."""
    top = 2**bits - 1
    share = (codes.astype(np.float64) - 1) / (top - 2)
    low, high = scale["low"], scale["high"]
    values = low * (high / low) ** share if scale["is_logarithmic"] else low + share * (high - low)
    return np.where(codes == top, np.inf, np.where(codes == 0, 0.0, values))


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize(
    "values",
    [np.geomspace(1e-4, 300, 999), np.linspace(0, 100, 999), np.linspace(-5, 3, 999), np.full(9, 2.0), np.zeros(3)],
    ids=["wide", "share", "signed", "alike", "nothing"],
)
def test_codes_keep_what_a_reader_can_read(values, bits):
    values = np.append(values, [0.0, np.inf])
    codes, scale = encode_values(values, bits)
    read = decoded(codes, bits, scale)
    assert read[-2:].tolist() == [0.0, np.inf]
    finite = values[:-1]
    step = (np.log(3e6) if scale["is_logarithmic"] else np.ptp(finite)) / (2**bits - 3)
    allowed = step / 2 * (np.abs(finite) if scale["is_logarithmic"] else 1.0) * 1.1 + 1e-12
    assert (np.abs(read[:-1] - finite) <= allowed).all()


def test_the_same_is_kept_once():
    cells, values = CellBuffer(), np.arange(200.0).reshape(10, 20)
    first = cells.add(values, 16)
    alone = len(cells.text)
    assert cells.add(values, 16) == first
    cells.add(values.copy(), 16)
    assert len(cells.text) == alone


def noisy(rigs: int) -> list[PageMap]:
    """Every cell of the usual grid known, and none like another."""
    random = np.random.default_rng(0)

    def one(quantity: str, band: str, rig: int, weights: Array) -> PageMap:
        values = random.lognormal(0, 1, weights.shape)
        return PageMap(
            quantity,
            band,
            f"rig {rig}",
            (-40.0, 160.0),
            (-40.0, 40.0),
            0.25,
            values,
            SCALE,
            errors=values * random.uniform(0.01, 0.5, values.shape),
            weights=weights,
            opaque_weight=1.0,
            sides=np.ones(weights.shape, dtype=np.int64),
        )

    each = {band: random.gamma(2, 1, (320, 800)) for band in ("ground", "obstacle")}
    return [one(what, band, rig, w) for what in "ab" for band, w in each.items() for rig in range(rigs)]


@pytest.mark.parametrize("rigs", [1, 3])
def test_no_page_has_more_than_half_a_megabyte(rigs):
    pictures = [PagePicture("a", bytes(150_000))]
    for given in ({}, {"pictures": pictures}):
        assert len(render_page(Page("rig", "lead", maps=noisy(rigs), **given))) < 0.5e6


def test_merged_cells_have_weighted_means():
    whole = noisy(1)[0]
    known = replace(whole, values=np.where(np.arange(800) < 700, whole.values, np.nan))
    (same,), _, silence = fit_maps([known], max_chars=10**7)
    assert same is known
    assert silence == []
    (rounded,), _, notes = fit_maps([known], max_chars=950_000)
    assert rounded.values is known.values
    assert (rounded.num_bits, rounded.errors is known.errors, notes[0][:7]) == (8, True, "Numbers")
    few = replace(known, values=known.values[:8, :12], errors=None, weights=None, sides=None, cell_m=1.0)
    (coarse, still_few), _, notes = fit_maps([known, few], max_chars=200_000)
    assert still_few.cell_m == 1.0  # it takes next to nothing, and would have nothing left
    assert coarse.errors is None
    assert coarse.cell_m == 0.5
    assert coarse.values.shape == (160, 400)
    four = np.s_[10:12, 20:22]
    assert coarse.values[5, 10] == pytest.approx(np.average(known.values[four], weights=known.weights[four]))
    assert np.isnan(coarse.values[:, 350:]).all()
    assert "standard errors of single cells are omitted; some maps merge 2 x 2 cells" in notes[-1]
    assert re.search(r"merge \d x \d cells, to keep", render_page(Page("rig", "lead", maps=noisy(1))))


def test_words_between_backticks_are_code_everywhere():
    told = "Add `--num-frames`; 5 % of <b> are `a<b`."
    table = PageTable(told, (told, told), [[TextCell(told), TextCell(told)]], notes=[told])
    parts = {"tables": [table], "more_tables": [table], "pictures": [PagePicture(told, b"png")]}
    rigs = [PageRig(told, [replace(SENSOR, name=told)], "name: rig")]
    page = Page(told, told, findings=(told, told), rigs=rigs, facts={told: {told: told}}, **parts)
    text = render_page(page).partition('<script type="application/json"')[0]
    assert text.count("Add <code>--num-frames</code>; 5&nbsp;% of &lt;b&gt; are <code>a&lt;b</code>.") == 23
    assert "<title>Add --num-frames; 5 % of &lt;b&gt; are a&lt;b.</title>" in text
    assert 'alt="Add --num-frames; 5 % of &lt;b&gt; are a&lt;b."' in text
    assert "`" not in text.partition("</style>")[2]


class ElementNames(HTMLParser):
    """Names of all elements of a page, and of all of their attributes."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements, self.attributes = set(), set()
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.elements.add(tag)
        self.attributes.update(name for name, _ in attrs)


@pytest.mark.parametrize("words", [NASTY, f"`{NASTY}`", '`" onerror="alert(1)`', "`<`/code`><img src=x>`", "``&lt;b``"])
def test_backticks_do_not_break_escaping(words):
    def names(words: str) -> ElementNames:
        table = PageTable(words, (words,), [[TextCell(words, words)]], notes=[words])
        parts = {"tables": [table], "pictures": [PagePicture(words, b"")], "facts": {words: {words: words}}}
        page = Page(words, words, findings=[words, words], **parts)
        return ElementNames(render_page(page) + build_result_html([words, words], Figure(figsize=(1, 1))))

    hostile, harmless = names(words), names("a `b` c")
    assert hostile.elements <= harmless.elements
    assert hostile.attributes <= harmless.attributes
