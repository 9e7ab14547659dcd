"""What a run shows: one table and its renderers, maps, and drawings. Imports matplotlib and rich, so import it late."""

from torchcover.report.drawings.depth import draw_depths
from torchcover.report.drawings.four_views import draw_four_views
from torchcover.report.drawings.rig import draw_rig
from torchcover.report.drawings.scene import ActorMark, draw_scene
from torchcover.report.drawings.work_precision import draw_work_precision
from torchcover.report.maps.figures import band_figures, map_figures, write_figures
from torchcover.report.maps.one_map import draw_map
from torchcover.report.maps.scale import ColourScale, difference_scale, error_scale, scale_of
from torchcover.report.maps.side_by_side import draw_side_by_side
from torchcover.report.parts import Part, Words, parts_of
from torchcover.report.remarks import Remark
from torchcover.report.renderers import RENDERERS
from torchcover.report.renderers.json_file import json_record, table_dict
from torchcover.report.renderers.markdown import as_markdown
from torchcover.report.renderers.text import narrowest_width, print_table
from torchcover.report.sensor_view import SensorView
from torchcover.report.study import WorkPoint, cheapest, pareto_front, study_records, study_table
from torchcover.report.table import CoverageTable, Row

__all__ = [
    "RENDERERS",
    "ActorMark",
    "ColourScale",
    "CoverageTable",
    "Part",
    "Remark",
    "Row",
    "SensorView",
    "Words",
    "WorkPoint",
    "as_markdown",
    "band_figures",
    "cheapest",
    "difference_scale",
    "draw_depths",
    "draw_four_views",
    "draw_map",
    "draw_rig",
    "draw_scene",
    "draw_side_by_side",
    "draw_work_precision",
    "error_scale",
    "json_record",
    "map_figures",
    "narrowest_width",
    "pareto_front",
    "parts_of",
    "print_table",
    "scale_of",
    "study_records",
    "study_table",
    "table_dict",
    "write_figures",
]
