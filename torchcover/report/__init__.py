"""What a run shows: a table and its renderers, maps, drawings, a page. Imports matplotlib and rich: import it late."""

from torchcover.report.drawings.film import check_film, write_film
from torchcover.report.drawings.four_views import draw_four_views
from torchcover.report.drawings.frame import ActorMark, StandingFaces, draw_depths, draw_scene
from torchcover.report.drawings.rig import draw_rig
from torchcover.report.drawings.search import (
    ChoiceSize,
    Slice,
    draw_choice,
    draw_fronts,
    draw_progress,
    draw_slices,
)
from torchcover.report.drawings.targets import draw_targets
from torchcover.report.drawings.vehicle import SkinPatch, draw_vehicle
from torchcover.report.drawings.work_precision import WorkPanel, draw_work_precision
from torchcover.report.maps.arrays import draw_map, draw_side_by_side
from torchcover.report.maps.colours import ColourScale, difference_scale, error_scale, scale_of
from torchcover.report.maps.figures import band_figures, file_stems, map_figures, write_figures
from torchcover.report.maps.overlay import SensorView
from torchcover.report.page.content import Line, Page, PageMap, PagePicture, PageRig, PageTable
from torchcover.report.page.maps_of import maps_of
from torchcover.report.page.writing import page_html
from torchcover.report.remarks import Remark, marks_on, notes_on, remarks_on
from torchcover.report.renderers import RENDERERS
from torchcover.report.renderers.json_file import json_record, table_dict
from torchcover.report.renderers.layout import BOLD_MARKS, PLACE_HEADINGS, Part, Words, parts_of
from torchcover.report.renderers.markdown_file import as_markdown
from torchcover.report.renderers.text_file import narrowest_width, print_table, text_table
from torchcover.report.table import CoverageTable, Row
from torchcover.report.wording import difference_heading, error_words, number_words, percent, shown_unit

__all__ = [
    "BOLD_MARKS",
    "PLACE_HEADINGS",
    "RENDERERS",
    "ActorMark",
    "ChoiceSize",
    "ColourScale",
    "CoverageTable",
    "Line",
    "Page",
    "PageMap",
    "PagePicture",
    "PageRig",
    "PageTable",
    "Part",
    "Remark",
    "Row",
    "SensorView",
    "SkinPatch",
    "Slice",
    "StandingFaces",
    "Words",
    "WorkPanel",
    "as_markdown",
    "band_figures",
    "check_film",
    "difference_heading",
    "difference_scale",
    "draw_choice",
    "draw_depths",
    "draw_four_views",
    "draw_fronts",
    "draw_map",
    "draw_progress",
    "draw_rig",
    "draw_scene",
    "draw_side_by_side",
    "draw_slices",
    "draw_targets",
    "draw_vehicle",
    "draw_work_precision",
    "error_scale",
    "error_words",
    "file_stems",
    "json_record",
    "map_figures",
    "maps_of",
    "marks_on",
    "narrowest_width",
    "notes_on",
    "number_words",
    "page_html",
    "parts_of",
    "percent",
    "print_table",
    "remarks_on",
    "scale_of",
    "shown_unit",
    "table_dict",
    "text_table",
    "write_figures",
    "write_film",
]
