"""The page of a result: what is on it, and that its rigs can be read back."""

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
    """All words of a page that a reader sees."""

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
def test_the_page_says_what_the_table_says_and_where_it_comes_from(result, tmp_path):
    assert tmp_path / "report.html" in result.save(tmp_path)
    text = Text((tmp_path / "report.html").read_text(encoding="utf-8"))
    words = " ".join(text.words)
    assert text.tags.count("script") == 3
    assert NASTY in words
    for row in result.table.rows[NASTY]:
        assert row.region.name in words
    for fact in ("courtyard", torchcover.__version__, "self hits, which end on the ego vehicle", "seed", "duration s"):
        assert fact in words


def test_the_page_has_what_was_asked_for(result):
    page = result.page
    assert [line.name for line in page.outlines] == [region.name for region in result.regions]
    quantities = dict.fromkeys(one.quantity for one in page.maps)
    assert "sensors that detect within 0.4 m" in quantities
    assert "mean blind spot radius, without roof" in quantities
    assert {one.rig for one in page.maps} == set(result.coverages)


@pytest.mark.parametrize("name", ["edgar", "kitti_cameras", "place3d_pyramid", "waymo"])
def test_the_rig_on_the_page_can_be_read_back(name, tmp_path):
    rig = Rig.load(name)
    text = html.unescape(html.escape(format_rig_yaml(name, rig.sensors)))
    (tmp_path / "rig.yaml").write_text(text, encoding="utf-8")
    again = Rig.load(tmp_path / "rig.yaml")
    assert [sensor.collect_content() for sensor in again.sensors] == [sensor.collect_content() for sensor in rig.sensors]


def test_the_page_of_a_target_draws_where_it_is_first_seen(tmp_path):
    seen = map_target_visibility("front_roof_128", "dog", raster=Raster((-6.0, 6.0), (-4.0, 4.0), 1.0))
    files = save_target_map(seen, tmp_path, Rig.load("front_roof_128").sensors)
    assert tmp_path / "report.html" in files
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    words = " ".join(Text(page).words)
    assert "Detection of dog_57cm by front_roof_128" in words
    assert len(re.findall("border of detection with 5 points", page)) == 4
