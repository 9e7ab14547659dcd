"""What a run shows: tables, summaries and maps of a `Coverage`. Imports matplotlib and rich, so import it late."""

from torchcover.report.comparison import comparison_maps, draw_comparison, draw_side_by_side
from torchcover.report.comparison_records import comparison_dict, write_comparison
from torchcover.report.comparison_table import comparison_tables, narrowest_width
from torchcover.report.depth_view import draw_depths
from torchcover.report.four_views import draw_four_views
from torchcover.report.maps import coverage_maps, draw_map, draw_maps
from torchcover.report.overlay import SensorMark
from torchcover.report.rig_view import SensorView, draw_rig
from torchcover.report.scale import ColourScale, detection_scale, difference_scale, radius_scale
from torchcover.report.scene_view import ActorMark, draw_scene
from torchcover.report.table import coverage_table, summary_dict, write_csv
from torchcover.report.work_precision import WorkPoint, cheapest, draw_work_precision, study_records, study_table

__all__ = [
    "ActorMark",
    "ColourScale",
    "SensorMark",
    "SensorView",
    "WorkPoint",
    "cheapest",
    "comparison_dict",
    "comparison_maps",
    "comparison_tables",
    "coverage_maps",
    "coverage_table",
    "detection_scale",
    "difference_scale",
    "draw_comparison",
    "draw_depths",
    "draw_four_views",
    "draw_map",
    "draw_maps",
    "draw_rig",
    "draw_scene",
    "draw_side_by_side",
    "draw_work_precision",
    "narrowest_width",
    "radius_scale",
    "study_records",
    "study_table",
    "summary_dict",
    "write_comparison",
    "write_csv",
]
