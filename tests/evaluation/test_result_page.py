"""Page of a result: numbers, maps, settings, and rigs that can be loaded again."""

import html
import re
from html.parser import HTMLParser

import pytest

import torchcover
from torchcover.evaluation import map_target_visibility, save_target_map
from torchcover.evaluation.result_page import format_rig_yaml
from torchcover.simulation import Rig
from torchcover.targets import Raster

NASTY = "<script>alert(1)</script>"


class Text(HTMLParser):
    """Visible words and tags of a page."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.words: list[str] = []
        self.tags: list[str] = []
        self.feed(page)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)

    def handle_data(self, data):
        if not self.tags or self.tags[-1] not in ("script", "style"):
            self.words.append(data)


@pytest.fixture(scope="module")
def result():
    rig = Rig.load("front_roof_32")
    named = rig.model_copy(update={"name": NASTY})
    return torchcover.evaluate([named, rig], num_frames=2, num_rays=1024, cell_m=1.0, redundancy=True)


@pytest.mark.usefixtures("blank_maps")
def test_the_page_has_numbers_settings_and_versions(result, tmp_path):
    assert tmp_path / "report.html" in result.save(tmp_path)
    text = Text((tmp_path / "report.html").read_text(encoding="utf-8"))
    words = " ".join(text.words)
    assert text.tags.count("script") == 3
    assert NASTY in words
    for row in result.table.rows[NASTY]:
        assert row.region.name in words
    for fact in ("courtyard", torchcover.__version__, "self hits, which end on the ego vehicle", "seed", "duration s"):
        assert fact in words


def test_the_page_has_maps_of_all_quantities(result):
    page = result.page
    assert [line.name for line in page.outlines] == [region.name for region in result.regions]
    quantities = dict.fromkeys(page_map.quantity for page_map in page.maps)
    assert "sensors that detect within 0.4 m" in quantities
    assert "mean blind spot radius, without roof" in quantities
    assert {page_map.rig for page_map in page.maps} == set(result.coverages)


@pytest.mark.parametrize("name", ["edgar", "kitti_cameras", "place3d_pyramid", "waymo"])
def test_rigs_of_the_page_can_be_loaded(name, tmp_path):
    rig = Rig.load(name)
    text = html.unescape(html.escape(format_rig_yaml(name, rig.sensors)))
    (tmp_path / "rig.yaml").write_text(text, encoding="utf-8")
    loaded = Rig.load(tmp_path / "rig.yaml")
    assert [sensor.collect_content() for sensor in loaded.sensors] == [
        sensor.collect_content() for sensor in rig.sensors
    ]


def test_the_target_page_has_the_detection_border(tmp_path):
    target_map = map_target_visibility("front_roof_128", "dog", raster=Raster((-6.0, 6.0), (-4.0, 4.0), 1.0))
    files = save_target_map(target_map, tmp_path, Rig.load("front_roof_128").sensors)
    assert tmp_path / "report.html" in files
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    words = " ".join(Text(page).words)
    assert "Detection of dog_57cm by front_roof_128" in words
    assert len(re.findall("border of detection with 5 points", page)) == 4
